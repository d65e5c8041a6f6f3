"""Scores of weighted particles against the true state, by closed forms and by calibration of an exact filter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest, norm

from mstfilter.errors import InputError
from mstfilter.forecasts import is_negative_type
from mstfilter.smc import Population, log_score, pit, set_energy_score


def test_log_score_of_kernels_and_of_discrete_states():
    x, w = np.array([0.0, 1.0, 3.0]), np.array([0.2, 0.5, 0.3])
    population = Population(x, np.log(w))
    expected = -np.log(w @ norm.pdf(2.0, x, 0.7))
    assert log_score(population, lambda p: norm.logpdf(2.0, p, 0.7)) == pytest.approx(expected)
    assert log_score(population, lambda p: np.where(p == 1.0, 0.0, -np.inf)) == pytest.approx(-np.log(0.5))
    with pytest.raises(InputError, match=r"shape \(2,\)"):
        log_score(population, lambda p: np.zeros(2))


def test_energy_score_of_numbers_vectors_mappings_and_objects():
    rng = np.random.default_rng(0)
    x, w, y = rng.normal(size=(6, 2)), rng.dirichlet(np.ones(6)), np.array([0.3, -0.2])
    expected = w @ np.linalg.norm(x - y, axis=1) - 0.5 * sum(
        a * b * np.linalg.norm(p - q) for a, p in zip(w, x, strict=True) for b, q in zip(w, x, strict=True)
    )
    assert set_energy_score(Population(x, np.log(w)), y) == pytest.approx(expected)
    named = Population({"a": x[:, 0], "b": x[:, 1]}, np.log(w))
    assert set_energy_score(named, {"a": y[0], "b": y[1]}) == pytest.approx(expected)

    def differs(words):
        return np.array([[float(a != b) for b in words] for a in words])

    words = Population(("table", "cup", "cup", "box"), np.log([0.1, 0.2, 0.3, 0.4]))
    # For "equal or not", the energy score is the Brier score of the distribution over words, halved.
    assert is_negative_type(differs(("a", "b", "c")))
    assert set_energy_score(words, "cup", differs) == pytest.approx(((1 - 0.5) ** 2 + 0.1**2 + 0.4**2) / 2)
    with pytest.raises(InputError, match="distances have shape"):
        set_energy_score(words, "cup", lambda p: np.zeros((2, 2)))


def test_pit_is_uniform_for_weighted_draws_and_not_for_too_narrow_ones():
    """300 truths from normal distributions. Level of the test: 1 false alarm in 1,000."""
    rng = np.random.default_rng(1)
    honest, narrow = [], []
    for _ in range(300):
        mean, sd = rng.normal(), 0.5
        truth = rng.normal(mean, sd)
        draws = rng.normal(mean, 2 * sd, 400)
        log_w = norm.logpdf(draws, mean, sd) - norm.logpdf(draws, mean, 2 * sd)
        honest.append(pit(Population(draws, log_w), truth, rng)[0])
        narrow.append(pit(Population(mean + (draws - mean) / 8, np.zeros(400)), truth, rng)[0])
    assert kstest(honest, "uniform").pvalue > 1e-3
    assert kstest(narrow, "uniform").pvalue < 1e-3
    ties = Population(np.array([1.0, 1.0, 2.0]), np.log([0.25, 0.25, 0.5]))
    values = [pit(ties, 1.0, rng)[0] for _ in range(1000)]
    assert 0 <= min(values) < 0.02 and 0.48 < max(values) <= 0.5
