"""Intervals and p values: against their formulas, against enumeration, and by simulation."""

from __future__ import annotations

import itertools
from statistics import NormalDist

import numpy as np
import pytest
import scipy.stats

from mstfilter.base.errors import InputError
from mstfilter.scoring.statistics import (
    Difference,
    compare,
    compare_arms,
    conclusion,
    holm,
    interval,
    sign_flip,
    slope,
)
from tests.experiments.scripts import import_script


def bca(values, n_resamples=20_000):
    """The BCa interval as Efron and Tibshirani (1993), section 14.3, write it, with resamples drawn anew."""
    normal, rng, n = NormalDist(), np.random.default_rng(1), len(values)
    means = np.sort(rng.choice(values, (n_resamples, n)).mean(axis=1))
    z0 = normal.inv_cdf(float(np.mean(means < values.mean()) + np.mean(means == values.mean()) / 2))
    left_out = np.array([np.delete(values, k).mean() for k in range(n)])
    away = left_out.mean() - left_out
    a = (away**3).sum() / (6 * (away**2).sum() ** 1.5)
    limits = []
    for z in (normal.inv_cdf(0.025), normal.inv_cdf(0.975)):
        limits.append(np.quantile(means, normal.cdf(z0 + (z0 + z) / (1 - a * (z0 + z)))))
    return limits


@pytest.mark.parametrize("kind", ["normal", "exponential"])
def test_the_interval_is_that_of_the_book(kind):
    values = getattr(np.random.default_rng(7), kind)(1.0, size=25)
    error = values.std(ddof=1) / 5
    assert interval(values) == pytest.approx(bca(values), abs=0.12 * error)
    assert interval(values) == interval(values.copy())


def test_the_interval_leans_with_the_skew_and_stays_among_the_values():
    values = np.random.default_rng(7).exponential(1.0, 15)
    low, high = interval(values)
    assert high - values.mean() > 1.3 * (values.mean() - low)
    low, high = interval(np.array([0.0] * 19 + [1.0]))
    assert 0 == low < 0.05 < high <= 1
    assert np.isnan(interval(values[:1])).all() and np.isnan(interval(values[:0])).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.0, 0.1, -1e9])
def test_equal_differences_are_their_own_interval(value):
    values = np.full(6, value)
    assert interval(values) == (pytest.approx(value), pytest.approx(value))
    assert sign_flip(values) == (1.0 if value == 0 else 2 / 2**6)


def test_the_interval_of_normal_values_holds_their_mean():
    """In 95 % of samples of 40 about .935; fewer than 265 of 300 have a probability of 10^-4."""
    samples = np.random.default_rng(3).normal(1.0, 2.0, (300, 40))
    held = sum(low <= 1.0 <= high for low, high in map(interval, samples))
    assert 265 <= held <= 297


@pytest.mark.parametrize("n", [2, 5, 8, 13])
def test_sign_flips_are_enumerated(n):
    values = np.random.default_rng(n).normal(0.5, 1, size=n)
    flipped = np.abs(np.array(list(itertools.product([1, -1], repeat=n))) @ values) / n
    assert sign_flip(values) == pytest.approx(np.mean(flipped >= abs(values.mean()) - 1e-12))


def test_sign_flips_of_many_and_of_no_values():
    values = np.random.default_rng(1).normal(0.4, 1, size=40)
    assert sign_flip(values) == sign_flip(values.copy()) == sign_flip(-4 * values)
    assert sign_flip(values) == pytest.approx(scipy.stats.ttest_1samp(values, 0).pvalue, abs=0.02)
    assert sign_flip(values + 9) == 2e-4  # the smallest p value of random flips
    assert np.isnan(sign_flip(np.ones(1))) and np.isnan(sign_flip(np.ones(0)))


def test_the_p_value_is_uniform_if_there_is_no_difference():
    """Of 400 symmetric samples, the number of p values below .05 is within 4 sd of 20."""
    samples = np.random.default_rng(5).laplace(size=(400, 10))
    assert abs(sum(sign_flip(one) < 0.05 for one in samples) - 20) <= 4 * np.sqrt(19)


def test_values_by_unit_of_any_type():
    found = compare({"a": np.uint8(1), "b": np.uint8(3), "c": None}, {"a": np.uint8(2), "b": np.uint8(1), "c": 2.0})
    assert (found.mean, found.n) == (0.5, 2)
    assert compare({"a": True}, {"a": False}).mean == 1


def test_units_without_a_value_are_left_out_and_a_claim_has_no_unit():
    values = np.random.default_rng(2).exponential(1.0, 20)
    d, *scaled = (compare(c * values, c * np.full(20, 0.5)) for c in (1, 1e-15, 1e9))
    assert (d.p, d.p_holm) == (sign_flip(values - 0.5),) * 2
    assert [other.p for other in scaled] == [d.p] * 2
    table = {"a": [1.0] * 6, "one": [2.0, *[np.nan] * 5], "none": [np.nan] * 6, "b": [1.1, 1.3, 1.2, 1.4, 1.2, 1.3]}
    found = compare_arms(table, "a")
    assert np.isnan(found["one"].p_holm) and np.isnan(found["none"].p_holm)
    assert found["b"].p_holm == found["b"].p == 2 / 2**6
    assert not any(d.is_claim for d in found.values())


def test_the_simulation_of_error_rates_applies_the_rule():
    """The script computes p values of many columns at once; and false claims are as rare as the level says."""
    script = import_script("comparison/run.py")
    x = np.random.default_rng(3).chisquare(1, (20, 12)) - 0.6
    p = script.p_values(x)["flip"]
    assert p == pytest.approx([compare(column, 0 * column).p for column in x.T], abs=0.03)
    found = script.claims(script.CASES["normal"](np.random.default_rng(4), 20, (1000, 4)), 4)
    assert found["flip"] <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 1000)


def test_holm():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]).max() == pytest.approx(1.0)
    with_gap = holm([0.01, np.nan, 0.02])
    assert with_gap[[0, 2]] == pytest.approx([0.02, 0.02]) and np.isnan(with_gap[1])
    rng = np.random.default_rng(0)
    p = rng.random(6)
    for alpha in (0.05, 0.3, 0.7):  # the step-down rule itself
        order, rejected = np.argsort(p), set()
        for rank, k in enumerate(order):
            if p[k] > alpha / (len(p) - rank):
                break
            rejected.add(int(k))
        assert set(np.flatnonzero(holm(p) <= alpha).tolist()) == rejected


def test_slope_is_that_of_scipy():
    t, y = np.arange(5.0), np.random.default_rng(0).normal(size=5)
    assert slope(t, y) == pytest.approx(scipy.stats.linregress(t, y).slope)
    assert np.isnan(slope(t[:1], y[:1]))


def test_pairs_are_by_scene():
    a, b = {"x": 1.0, "y": 2.0, "z": 3.0, "only a": 9.0}, {"y": 1.0, "x": 0.5, "z": float("nan")}
    found = compare(a, b)
    assert (found.n, found.mean) == (2, pytest.approx(0.75))
    assert compare(b, a).mean == -found.mean
    assert compare({}, a).n == 0


def test_words_claim_no_more_than_they_may():
    words = conclusion(Difference(0.1, 0.01, 0.2, 0.01, 30, 0.06), "a", "b")
    assert words.startswith(
        "a and b: no difference can be claimed at n = 30 (+0.100, 95 % interval +0.0100 to +0.200"
    )
    words = conclusion(Difference(0.1, 0.05, 0.15, 0.01, 8, 0.01), "a", "b", "s1")
    assert words.startswith("a minus b on s1: ") and "claims need 20 scenes" in words and "above" not in words
    claimed = Difference(-0.1, -0.15, -0.05, 0.001, 25, 0.01)
    assert claimed.is_claim and conclusion(claimed, "a", "b").startswith("a is below b (-0.100")
    assert "n = 1" in conclusion(compare({"x": 1.0}, {"x": 2.0}), "a", "b")
    assert conclusion(compare({}, {}), "a", "b", unit="seed") == "a and b: no seed has both."


def test_a_table_of_any_units_is_compared_with_a_reference():
    """Arrays in one order of units, or mappings; lost units are left out; p values are adjusted over the table."""
    rng = np.random.default_rng(2)
    table = {arm: rng.normal(shift, 1.0, 9) for arm, shift in (("base", 0.0), ("same", 0.0), ("better", 3.0))}
    table["same"][4] = -np.inf
    found = compare_arms(table, "base")
    named = {arm: dict(zip("abcdefghi", values, strict=True)) for arm, values in table.items()}
    assert found == compare_arms(named, "base")
    d = np.delete(table["same"] - table["base"], 4)
    assert (found["same"].n, found["same"].mean) == (8, pytest.approx(d.mean()))
    assert (found["same"].low, found["same"].high) == interval(d)
    assert [found[arm].p_holm for arm in ("same", "better")] == pytest.approx(
        holm([sign_flip(d), sign_flip(table["better"] - table["base"])])
    )
    assert "claims need 20 seeds" in conclusion(found["better"], "better", "base", unit="seed")
    for wrong, message in (
        ({"base": [1.0], "b": [1.0, 2.0]}, r"shapes \(2,\) and \(1,\)"),
        ({"base": [[1.0]], "b": [[1.0]]}, "one number per unit"),
        ({"base": [1.0], "b": {"x": 1.0}}, "cannot be paired"),
        ({"b": [1.0]}, "no arm 'base'"),
    ):
        with pytest.raises(InputError, match=message):
            compare_arms(wrong, "base")
