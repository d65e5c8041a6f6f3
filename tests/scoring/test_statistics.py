"""Intervals and p values: against scipy, against enumeration, and by simulation."""

from __future__ import annotations

import itertools
from dataclasses import replace

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
    studentised_bootstrap,
)
from tests.experiments.scripts import import_script


def p_of(values):
    """The p value of the bootstrap."""
    return studentised_bootstrap(values)[2]


def test_t_interval_is_that_of_scipy():
    values = np.random.default_rng(0).normal(size=9)
    expected = scipy.stats.ttest_1samp(values, 0).confidence_interval(0.95)
    assert interval(values) == pytest.approx(tuple(expected))
    assert np.isnan(interval(values[:1])).all()


@pytest.mark.parametrize("n", [2, 5, 8])
def test_sign_flips_are_enumerated(n):
    values = np.random.default_rng(n).normal(0.5, 1, size=n)
    flipped = [abs(np.mean(values * signs)) for signs in itertools.product([1, -1], repeat=n)]
    expected = np.mean(np.array(flipped) >= abs(values.mean()) - 1e-12)
    assert sign_flip(values) == pytest.approx(expected)


def test_sign_flips_of_many_and_of_no_values():
    values = np.random.default_rng(1).normal(0.4, 1, size=40)
    assert sign_flip(values) == sign_flip(values)
    assert sign_flip(values) == pytest.approx(scipy.stats.ttest_1samp(values, 0).pvalue, abs=0.02)
    assert sign_flip(np.zeros(5)) == 1.0
    assert np.isnan(sign_flip(np.ones(1)))


def test_the_bootstrap_interval_of_rare_values_is_wide():
    """Resamples of equal values have an infinite t ratio, and most of them are such."""
    low, high, _ = studentised_bootstrap(np.array([0.0] * 19 + [1.0]))
    assert low < 0 and high == np.inf
    low, high, _ = studentised_bootstrap(-np.array([0.0] * 19 + [1.0]))
    assert low == -np.inf and high > 0


def test_the_bootstrap_interval_leans_with_the_skew():
    """As written in the book, drawn anew: the long tail of the values is on the side where the interval is long."""
    values = np.random.default_rng(7).exponential(1.0, 15)
    rng, ratios = np.random.default_rng(1), []
    for _ in range(4000):
        drawn = rng.choice(values, 15)
        ratios.append((drawn.mean() - values.mean()) / (drawn.std(ddof=1) / np.sqrt(15)))
    error = values.std(ddof=1) / np.sqrt(15)
    expected = values.mean() - np.quantile(ratios, 0.975) * error, values.mean() - np.quantile(ratios, 0.025) * error
    low, high, _ = studentised_bootstrap(values)
    assert (low, high) == pytest.approx(expected, abs=0.7 * error)  # the outer quantile of heavy tails
    assert high - values.mean() > values.mean() - low


def test_the_bootstrap_of_tied_values_is_symmetric():
    values = np.array([0.0] * 10 + [1, -1])
    low, high, _ = studentised_bootstrap(values)
    assert np.isclose(-low, high, rtol=0.05)


def test_values_by_unit_of_any_type():
    found = compare({"a": np.uint8(1), "b": np.uint8(3), "c": None}, {"a": np.uint8(2), "b": np.uint8(1), "c": 2.0})
    assert (found.mean, found.n) == (0.5, 2)
    assert compare({"a": True}, {"a": False}).mean == 1


def test_the_p_value_of_the_bootstrap():
    """As the docstring says, drawn anew; and above .05 where the interval of the same resamples holds the mean."""
    values = np.random.default_rng(7).exponential(1.0, 20) - 0.6
    rng, ratios = np.random.default_rng(1), []
    for _ in range(4000):
        drawn = rng.choice(values, 20)
        ratios.append((drawn.mean() - values.mean()) / drawn.std(ddof=1))
    observed, ratios = values.mean() / values.std(ddof=1), np.array(ratios)
    equal_tailed = 2 * min(np.mean(ratios >= observed), np.mean(ratios <= observed))
    assert p_of(values) == pytest.approx(max(equal_tailed, np.mean(abs(ratios) >= abs(observed))), abs=0.03)
    for seed in range(10):
        values = np.random.default_rng(seed).exponential(1.0, 20)
        low, high, _ = studentised_bootstrap(values)
        assert p_of(values - low - 0.02) > 0.05 and p_of(values - high + 0.02) > 0.05
        assert p_of(values) == p_of(-4 * values)
    assert np.isnan(p_of(values[:4]))
    assert p_of(np.zeros(6)) == 1.0 and p_of(np.ones(6)) < 0.001


def test_a_claim_takes_the_larger_p_value_and_the_skewness():
    values = np.random.default_rng(2).exponential(1.0, 20)
    d = compare(values, np.full(20, 0.5))
    assert d.skewness == pytest.approx(scipy.stats.skew(values))
    assert (d.p, d.p_bootstrap) == (sign_flip(values - 0.5), p_of(values - 0.5))
    assert d.p_holm == d.p_claim == pytest.approx(max(d.p, d.p_bootstrap) * (1 + abs(d.skewness)))
    few = compare(values[:4], np.full(4, 0.5))
    assert np.isnan(few.p_bootstrap) and few.p_claim == pytest.approx(min(1, few.p * (1 + abs(few.skewness))))


def test_the_rule_for_claims_has_no_unit_and_leaves_out_what_is_missing():
    d, *scaled = (
        compare(c * np.random.default_rng(2).exponential(1.0, 20), c * np.full(20, 0.5)) for c in (1, 1e-15, 1e9)
    )
    for other in scaled:
        assert (other.p_claim, other.p_bootstrap, other.skewness) == pytest.approx(
            (d.p_claim, d.p_bootstrap, d.skewness)
        )
    table = {"a": [1.0] * 6, "one": [2.0, *[np.nan] * 5], "none": [np.nan] * 6, "b": [1.1, 1.3, 1.2, 1.4, 1.2, 1.3]}
    found = compare_arms(table, "a")
    assert np.isnan(found["one"].p_holm) and np.isnan(found["none"].p_holm)
    assert found["b"].p_holm == found["b"].p_claim < 1
    assert not found["none"].excludes_zero and not found["one"].excludes_zero


@pytest.mark.parametrize("case", ["squared errors", "chi-square", "lognormal, sd .5"])
def test_skewed_differences_rarely_lead_to_a_claim(case):
    """A true error rate of .06 fails here in 1 of 10^4: at most 60 + 4 sd of 1000 tables of four arms, n = 20."""
    script = import_script("comparison/run.py")
    found = script.claims(script.CASES[case](np.random.default_rng(4), 20, (1000, 4)), 4)
    assert found["claim"] <= 0.06 + 4 * np.sqrt(0.06 * 0.94 / 1000)
    assert case != "chi-square" or found["flip"] > 0.1  # what the rule is for


def test_the_simulation_applies_the_rule_of_conclusion():
    script = import_script("comparison/run.py")
    x = np.random.default_rng(3).chisquare(1, (20, 12)) - 0.6
    p = script.p_values(x)
    for k, d in enumerate(compare(column, 0 * column) for column in x.T):
        assert (d.p_bootstrap, d.p_claim) == pytest.approx((p["bootstrap"][k], p["claim"][k]), abs=0.03)
        both = max(p["t"][k], p["bootstrap"][k]) < 0.05
        assert d.excludes_zero == both or abs(p["bootstrap"][k] - 0.05) < 0.03


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
    d = Difference(0.1, -0.01, 0.2, -0.01, 0.2, 0.04, 30, 0.04)
    assert "no difference can be claimed at n = 30" in conclusion(d, "a", "b")
    d = Difference(0.1, 0.05, 0.15, 0.04, 0.16, 0.06, 5, 0.06)
    words = conclusion(d, "a", "b", "s1")
    assert words.startswith("a minus b on s1: ") and "claims need 20 scenes" in words and "above" not in words
    d = Difference(-0.1, -0.15, -0.05, -0.16, -0.04, 0.001, 25, 0.2)
    assert "no claim is left after adjustment" in conclusion(d, "a", "b") and "below" not in conclusion(d, "a", "b")
    d = Difference(-0.1, -0.15, -0.05, -0.16, -0.04, 0.001, 25, 0.01)
    assert conclusion(d, "a", "b").startswith("a is below b (") and "claim" not in conclusion(d, "a", "b")
    one_sided = replace(d, low_bootstrap=-0.3, high_bootstrap=0.01)
    words = conclusion(one_sided, "a", "b")
    assert "no difference can be claimed at n = 25" in words and "bootstrap interval -0.300 to +0.0100" in words
    assert "n = 1" in conclusion(compare({"x": 1.0}, {"x": 2.0}), "a", "b")


def test_a_table_of_any_units_is_compared_with_a_reference():
    """Arrays in one order of units, or mappings; lost units are left out; p values are adjusted over the table."""
    rng = np.random.default_rng(2)
    table = {arm: rng.normal(shift, 1.0, 9) for arm, shift in (("base", 0.0), ("same", 0.0), ("better", 3.0))}
    table["same"][4] = -np.inf
    found = compare_arms(table, "base")
    named = {arm: dict(zip("abcdefghi", values, strict=True)) for arm, values in table.items()}
    assert found == compare_arms(named, "base")
    d = np.delete(table["same"] - table["base"], 4)
    expected = scipy.stats.ttest_1samp(d, 0).confidence_interval(0.95)
    assert (found["same"].n, found["same"].mean) == (8, pytest.approx(d.mean()))
    assert (found["same"].low, found["same"].high) == pytest.approx(tuple(expected))
    assert [found[arm].p_holm for arm in ("same", "better")] == pytest.approx(
        holm([compare(d, 0 * d).p_claim, compare(table["better"], table["base"]).p_claim])
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
