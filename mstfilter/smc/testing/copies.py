"""Tests of the weights of particles after a resampling: test cases, statistics, and error messages.

If n of m particles are selected without bias, the copies of particle i carry the share W_i of the weight on average.
A `Case` is a list of weights and a number of particles to select. A `Sample` collects, over many resamplings, the
share that the copies of each particle and of each group of particles have, and bets against the expected share: for
an unbiased scheme the stakes multiply to a large number with small probability only (Waudby-Smith and Ramdas 2024).

>>> import numpy as np
>>> from mstfilter.smc import Systematic
>>> from mstfilter.smc.testing.copies import Case, Sample
>>> case = Case((0.7, 0.2, 0.1), n=5)
>>> rng, fair, greedy = np.random.default_rng(0), Sample(case), Sample(case)
>>> for _ in range(500):
...     fair.add(Systematic().select(rng, np.log(case.weights), 5)[0], np.ones(5))
...     greedy.add(np.array([0, 0, 0, 0, 1]), np.ones(5))                    # never the last one
>>> fair.evidence().max() < np.log(2e6), greedy.evidence().max() > np.log(2e6)
(np.True_, np.True_)

`fault_message` says how the mean weight differs from the expected one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from mstfilter.smc.testing.contract import FALSE_ALARM


@dataclass(frozen=True)
class Case:
    """Weights, number of particles to select, and initial number of calls."""

    weights: tuple[float, ...]
    n: int
    calls: int = 1000


def _mixed(m: int, heavy: float) -> tuple[float, ...]:
    """(m,) weights: one heavy weight, zeros, ties, light weights. The second half is heavier than the first.

    The first weight of the second half is the fraction `heavy` of the total. One in eight of the other weights is
    zero, and two in eight are at most 5e-4 of the heaviest weight.
    """
    kind = np.arange(m) % 8
    weights = np.select(
        [kind == 1, np.isin(kind, (2, 5)), np.isin(kind, (0, 6)), kind == 3],
        [0.0, 0.0, 1.0, 2.0],
        1.0 + np.linspace(0.0, 1.5, m),
    )
    weights[m // 2] = 0.0
    weights[m // 2 :] *= 1.6
    weights[m // 2] = weights.sum() * heavy / (1 - heavy)
    weights[kind == 2] = 5e-4 * weights[m // 2]
    weights[kind == 5] = 5e-5 * weights[m // 2]
    return tuple(weights.tolist())


_FIVE = (0.41, 0.24, 0.2, 0.1, 0.05)
CASES = (
    Case((0.11, 0.36, 0.15, 0.38), 3),
    Case(_FIVE, 7),
    Case((0.05, 0.1, 0.2, 0.24, 0.41), 2),
    Case((0.12, 0.05, 0.16, 0.08, 0.33, 0.26), 6),  # n = m, and below: ties, zeros
    Case((3.0, 1.0, 1.0, 3.0, 3.0, 1.0, 2.0, 2.0), 8),
    Case((0.0, 2.0, 0.0, 1.0, 1.5, 0.0, 0.6), 7),
    Case((0.0, 2.0, 2.0, 1.0, 1.0, 0.0, 0.6), 4),
    Case((0.05, 0.3, 0.25, 0.08, 0.32), 7),  # the sizes of a case above, other weights
    Case(_FIVE, 1),
    Case((0.8, 0.2), 1),
    Case((0.06, 0.7, 0.2, 0.04), 4),
    Case((0.06, 0.7, 0.2, 0.04), 101),
    Case((0.02, 0.95, 0.03), 3),
    Case((0.01, 0.02, 0.012, 0.95, 0.008), 401),
    Case(_mixed(32, 0.46), 32),
    Case(_mixed(32, 0.2), 31),
    Case(_mixed(125, 0.2), 5),
    Case(tuple(np.linspace(1.0, 3.0, 100).tolist()), 2),
    Case((1.0,), 2, 10),
    Case(_mixed(300, 0.3), 300, 500),  # more particles than 8 bits count
    # The fraction n W of the heaviest particle is not an integer. 1 % of its weight is nine standard errors of
    # multinomial copies.
    Case(_mixed(8, 0.4985), 2001, 1700),
    Case(_mixed(2000, 0.49983), 2000, 500),
)
#: A case with a deviation of this many standard errors gets more calls, up to `MOST_CALLS` times the first number.
_SUSPICIOUS = 4.0
MOST_CALLS = 16
#: Stakes of a test, as fractions of the largest stake.
_STAKES = 0.9 * 0.5 ** np.arange(10)


class Sample:
    """The weight of the copies of particles and of groups of particles in many resamplings of a case.

    Each mean is tested by betting (Waudby-Smith, Ramdas 2024, "Estimating means of bounded random variables by
    betting"). Let the results x_1, x_2, ... of calls in [0, b] have expectation mu, and let a stake s be any number
    from -1 / (b - mu) to 1 / mu. The product of 1 + s (x_k - mu) over the calls has expectation 1. By Ville's
    inequality, the largest product over any number of calls exceeds 1 / p with probability at most p. Calls may
    therefore be added until the result is clear. The test assumes no normal distribution, so an unbiased scheme
    passes even if it makes very many copies in rare calls.
    """

    def __init__(self, case: Case) -> None:
        W = np.asarray(case.weights) / np.sum(case.weights)
        self.case, self.expected, self.calls = case, np.concatenate([W, groups_of(case) @ W]), 0
        self._rows: list[np.ndarray] = []
        self._most = 1.0  # largest total weight of a call

    def add(self, ancestors: np.ndarray, weights: np.ndarray) -> None:
        """Add the ancestors of a call, and the output weights in units of the mean input weight."""
        self._rows.append(np.bincount(ancestors, weights, minlength=len(self.case.weights)) / len(weights))
        self.calls += 1
        self._most = max(self._most, float(weights.mean()))

    @property
    def carried(self) -> np.ndarray:
        """(calls, m + k) fraction of the total weight that the copies of each particle and each of k groups have."""
        rows = np.array(self._rows)
        return np.concatenate([rows, rows @ groups_of(self.case).T], axis=1)

    @property
    def largest(self) -> float:
        """Upper bound of a fraction: 1, or four times the largest total weight if the total is not constant."""
        return 1.0 if self._most <= 1 + 1e-9 else 4 * self._most

    def evidence(self) -> np.ndarray:
        """(m + k,) log evidence against the expected weight of each particle and group.

        For an unbiased scheme, the evidence exceeds log(2 / p) with probability at most p. It is 0 if the mean is
        near the expectation: within four standard errors, plus 16 copies over all calls.
        """
        x = self.carried
        found, sd = x.mean(axis=0), x.std(axis=0)
        beyond = np.abs(found - self.expected)
        clear = _SUSPICIOUS * sd / np.sqrt(len(x)) + _SUSPICIOUS**2 / (self.case.n * len(x))
        columns = np.flatnonzero(beyond > clear)
        result = np.zeros(x.shape[1])
        for j in columns.tolist():
            sign = np.sign(found[j] - self.expected[j])
            mean = self.expected[j]
            gains = sign * (x[:, j] - mean) / max(mean if sign > 0 else self.largest - mean, 1e-12)
            bets = np.log1p(_STAKES[:, None] * gains).sum(axis=1)
            result[j] = bets.max() + np.log(np.exp(bets - bets.max()).mean())
        return result


def quantile(n_tails: int) -> float:
    """The value z that a normal variable exceeds with probability FALSE_ALARM / n_tails."""
    return -NormalDist().inv_cdf(FALSE_ALARM / n_tails)


@lru_cache(maxsize=64)
def groups_of(case: Case) -> np.ndarray:
    """(k, m) masks of groups: all particles, the first half, light particles, and particles of each common weight."""
    w = np.asarray(case.weights)
    values, counts = np.unique(w, return_counts=True)
    masks = [np.ones(len(w), bool), np.arange(len(w)) < len(w) // 2, (w > 0) & (w < 1e-3 * w.max())]
    return np.array([*masks, *(w == value for value in values[counts > 1])], dtype=np.float64)


def fault_message(sample: Sample, column: int) -> str:
    """Error message that states how the mean weight of a particle or group differs from the expected weight."""
    case, expected, mean = sample.case, sample.expected[column], sample.carried[:, column].mean()
    m, n = len(case.weights), case.n
    who = f"particle {column}"
    if column == m:
        return (
            f"{m} particles to {n}: the mean weight after selection is {mean:.4g} of the one before, expected the "
            "same: divide sums of weights by the number of all particles"
        )
    if column > m:
        members = np.flatnonzero(groups_of(case)[column - m])
        who = f"the group of particles {', '.join(map(str, members[:3]))}, ..."
    return (
        f"{m} particles to {n}: copies are biased: {who} (W = {expected:.3g}) carries {n * mean:.3f} mean weights on "
        f"average, expected {n * expected:.3f}"
    )
