"""Energy distances against scipy and brute force; what selections add, against the form of independent draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from mstfilter.errors import InputError
from mstfilter.smc import (
    Always,
    FearnheadClifford,
    Gaussian,
    Measured,
    Multinomial,
    Population,
    Resampler,
    Ssp,
    Systematic,
    bootstrap,
    collect,
    energy_distance,
    selection_distance,
)
from tests.smc.models import AR1, BOXES, ar1_observations

RNG = np.random.default_rng(0)


def populations(shape, n=(7, 5)):
    return [Population(RNG.normal(size=(k, *shape)), RNG.normal(size=k)) for k in n]


def by_pairs(a, b):
    """2 E d(X, Y) - E d(X, X') - E d(Y, Y') by its definition."""

    def mean(p, q):
        d = np.linalg.norm(p.particles.reshape(len(p), 1, -1) - q.particles.reshape(1, len(q), -1), axis=2)
        return p.weights @ d @ q.weights

    return 2 * mean(a, b) - mean(a, a) - mean(b, b)


@pytest.mark.parametrize("shape", [(), (1,), (2,), (2, 3)])
def test_it_is_its_definition(shape):
    a, b = populations(shape)
    assert energy_distance(a, b) == pytest.approx(by_pairs(a, b), abs=1e-12)
    assert energy_distance(a, a) == pytest.approx(0.0, abs=1e-12)
    if shape == ():
        scipy = stats.energy_distance(a.particles, b.particles, a.weights, b.weights)
        assert energy_distance(a, b) == pytest.approx(scipy**2)


def test_mappings_objects_and_other_distances():
    a, b = populations((2,))
    split = [Population({"x": p.particles[:, 0], "y": p.particles[:, 1]}, p.log_weights) for p in (a, b)]
    assert energy_distance(*split) == pytest.approx(by_pairs(a, b))
    kernel = Gaussian(0.7).matrix  # 1 - kernel gives the squared maximum mean discrepancy
    k = kernel(np.concatenate([a.particles, b.particles]))
    masses = np.concatenate([a.weights, -b.weights])
    assert energy_distance(a, b, lambda p: 1 - kernel(p)) == pytest.approx(masses @ k @ masses)
    first, second = Population(BOXES[:2], np.log([0.3, 0.7])), Population(BOXES[1:], np.log([0.6, 0.4]))
    found = energy_distance(first, second, lambda p: np.array([[x != y for y in p] for x in p]))
    assert found == pytest.approx(0.3**2 + 0.1**2 + 0.4**2)
    with pytest.raises(InputError, match="Box objects"):
        energy_distance(first, second)
    with pytest.raises(InputError, match=r"distances have shape \(4,\), expected \(4, 4\)"):
        energy_distance(first, second, lambda p: np.zeros(len(p)))


@dataclass(frozen=True)
class Redrawn(Resampler):
    """Makes new particles, and so reports no ancestors."""

    def resample(self, rng, population, n):
        return Population(rng.normal(size=n))


@pytest.mark.parametrize("shape", [(), (2,)])
@pytest.mark.parametrize("scheme", [Systematic(), Multinomial(), FearnheadClifford(), Redrawn()])
def test_a_measured_selection_is_the_selection(scheme, shape):
    population = populations(shape, (9,))[0]
    plain = scheme.resample(np.random.default_rng(3), population, 4)
    if isinstance(scheme, Redrawn) and shape:
        return
    found = Measured(scheme).resample(np.random.default_rng(3), population, 4)
    np.testing.assert_array_equal(found.particles, plain.particles)
    np.testing.assert_array_equal(found.log_weights, plain.log_weights)
    assert found.notes["energy_distance"] == pytest.approx(by_pairs(population, plain), abs=1e-12)


@pytest.mark.parametrize("shape", [(), (2,)])
def test_independent_draws_add_w_d_w_over_n(shape):
    """The covariance of the shares is (diag W - W W') / n: mean distance W' D W / n. Within 4.5 errors (7e-6)."""
    population, rng = populations(shape, (12,))[0], np.random.default_rng(1)
    found = {
        scheme: np.array(
            [Measured(scheme).resample(rng, population, 6).notes["energy_distance"] for _ in range(1500)]
        )
        for scheme in (Multinomial(), Ssp())
    }
    x, w = population.particles.reshape(12, -1), population.weights
    expected = w @ np.linalg.norm(x[:, None] - x, axis=2) @ w / 6
    of_draws = found[Multinomial()]
    assert abs(of_draws.mean() - expected) < 4.5 * of_draws.std(ddof=1) / np.sqrt(1500)
    assert found[Ssp()].mean() < 0.8 * expected


def test_a_run_is_measured():
    ys = ar1_observations(6)
    filter = bootstrap(AR1, 30, Measured(Systematic()))
    history = collect(filter.iterate(ys, 2), distance=selection_distance, resampled=lambda s, info: info.resampled)
    assert ((history["distance"] > 0) == history["resampled"]).all() and history["resampled"].any()
    assert filter.run(ys, 2)[0].log_evidence == bootstrap(AR1, 30).run(ys, 2)[0].log_evidence
    unmeasured = collect(bootstrap(AR1, 30, trigger=Always()).iterate(ys, 2), distance=selection_distance)
    assert np.isnan(unmeasured["distance"][1:]).all() and unmeasured["distance"][0] == 0
