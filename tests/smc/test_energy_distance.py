"""Energy distances against scipy and brute force; what selections add, against the form of independent draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mstfilter.errors import InputError
from mstfilter.smc import (
    Gaussian,
    Population,
    energy_distance,
)
from tests.smc.models import BOXES

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
