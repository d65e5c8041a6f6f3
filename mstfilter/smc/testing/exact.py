"""Compares weighted particles with exact draws: distributions, mean weights, and independence.

The author of a component often knows the answer for one case: draws of x_t given x_{t-1} and y_t, say. A contract
then draws many particles through the component, and compares the weighted distribution functions at several quantiles
with those of the exact draws. It also compares mean weights, since the evidence depends on them, and asks whether
particles are independent. For this, the test class has a method `exact`:

>>> import numpy as np
>>> from mstfilter.smc import Dynamics, Normal, Population, StateSpaceModel
>>> from mstfilter.smc.testing import TransitionContract, check_properties
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> class Moves(TransitionContract):
...     n_draws = 20_000
...     scale = 0.5
...     def exact(self, rng, n):
...         x = rng.standard_normal(n)
...         return Population(x), Population(0.9 * x + self.scale * rng.standard_normal(n)), None
>>> class Wrong(Moves):
...     scale = 0.6
>>> [any(r.name == "distribution_is_exact" and r.failure for r in check_properties(Dynamics(model), contract))
...  for contract in (Moves, Wrong)]
[False, True]
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from itertools import combinations
from typing import Any, ClassVar
from unittest import SkipTest

import numpy as np

from mstfilter.smc import Population
from mstfilter.smc.testing.contract import (
    FALSE_ALARM,
    Contract,
    OutOfTime,
    reports_errors,
    seeded,
    skip_unless_properly_weighted,
    statistical,
)
from mstfilter.smc.testing.copies import quantile

_TAILS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025)
_SMALL, _SMALL_CALLS = 3, 3000  # particles, and calls, of the test with small populations
WeightedRows = tuple[np.ndarray, np.ndarray]  # (n, d) rows, (n,) log weights
_LEVELS = np.array([*_TAILS, *np.arange(0.05, 1, 0.05), *(1 - p for p in reversed(_TAILS))])


class ExactContract(Contract):
    """Properties of components that are tested with exact draws.

    Define a method ``exact(self, rng, n)``, or a function ``exact(rng, n)`` in the module of the component. It
    returns three items: `n` particles before the call, the particles after the call (exact draws, or with exact
    weights), and the observation. An optional fourth item ``log_likelihood(particles) -> (n,)`` multiplies the
    weights of both compared samples, so that the weights f / q of a guided move vary less. The test is skipped if
    one particle has more than 1 % of the total weight.

    The rows of `exact` must be independent draws, but the states x_{t-1} may lie on a grid. With 200,000 rows, the
    tests detect a shift and an error of the standard deviation by 3 %, missing tails of probability 0.1 %, and a
    correlation of 0.02 between particles.
    """

    returns = Population
    columns: ClassVar[str] = "x"  #: name of the columns of compared rows, for messages
    exact: Callable[[np.random.Generator, int], tuple[Any, ...]] | None = None
    exact_types: ClassVar[tuple[Any, ...]] = (Population, Population)  #: what `exact` returns before the observation
    n_draws: ClassVar[int] = 200_000  #: rows of `exact` in a test. Fewer rows detect only larger faults

    def exact_case(self, seed: int, n: int) -> tuple[Any, ...]:
        """The result of `exact`. Skips the test if no `exact` is defined."""
        if self.exact is None:
            raise SkipTest("there are no exact draws to compare with: write exact(rng, n)")
        with reports_errors("exact(rng, n)"):
            found = self.exact(seeded(seed), n)
        k, items = len(self.exact_types), found if isinstance(found, tuple | list) else (found,)
        fits = len(items) > k and all(map(isinstance, items, self.exact_types))
        expected = f"a Population of {n} particles" if k == 1 else f"two Populations of {n} particles"
        assert fits and all(one is None or len(one) == n for one in items[:k]), (
            f"exact(rng, {n}) returned {', '.join(map(_kind, items))}; expected {expected} and the observation: "
            "Population(x) makes one of an array"
        )
        return tuple(items)

    def draws_in_time(self, call: Callable[[int], Any]) -> int:
        """`n_draws`, or as many as the component processes in the time left. ``call(n)`` uses n particles."""
        if self.until == math.inf:
            return self.n_draws
        start, few = time.monotonic(), 500
        call(few)
        each = (time.monotonic() - start) / few
        n = min(self.n_draws, int((self.until - time.monotonic()) / (8 * each)))  # a test makes up to six calls
        if n < 2000:
            raise OutOfTime(f"out of time: a call with 2000 particles takes about {2000 * each:.2g} s")
        if n < self.n_draws:
            self.remarks.append(f"with {n} of {self.n_draws} draws, for want of time")
        return n

    def compare_weighted(self, found: np.ndarray, lw: np.ndarray, exact: np.ndarray, exact_lw: np.ndarray) -> None:
        """Compare the weighted distributions of rows, for each column and for the sums of pairs of columns.

        Distribution functions are compared at several quantiles. A sum shows if its columns share a random number.

        The bounds assume that differences of weighted fractions are normal. The false-alarm rate is a twentieth of
        `FALSE_ALARM`. A tail is compared only if it is so probable that no single weight decides the test.
        """
        samples = []
        for log_weights in (lw, exact_lw):
            w = np.exp(log_weights - log_weights.max())
            w /= w.sum()
            if w.max() > 0.01:
                raise SkipTest(
                    f"the weights of the exact case are too uneven (effective sample size {1 / (w @ w):.3g}): "
                    "return log p(y | x_t) as a fourth item of exact"
                )
            samples.append(w)
        least = max(50 * len(w) * w.max() ** 2 for w in samples)
        d = found.shape[1]
        pairs = _pairs(d)
        found, exact = _with_sums(found, exact, samples[1], pairs)
        levels = _LEVELS[np.minimum(_LEVELS, 1 - _LEVELS) >= min(least, 0.05)]
        for j in range(found.shape[1]):
            order = np.argsort(exact[:, j])
            limits = exact[order[np.cumsum(samples[1][order])[:-1].searchsorted(levels)], j]
            (p, s), (q, r) = (
                _weighted_fractions(x[:, j], w, limits) for x, w in zip((found, exact), samples, strict=True)
            )
            what = " + ".join(f"coordinate {k} of {self.columns}" for k in ((j,) if j < d else pairs[j - d]))
            bound = quantile(4 * 20 * found.shape[1] * len(limits)) * np.hypot(s, r) + 1e-9
            excess = np.abs(p - q) - bound
            k = int(np.argmax(excess))
            assert excess[k] <= 0, (
                f"the weighted distribution is wrong: {what} is below {limits[k]:.3g} with probability {p[k]:.4f}, "
                f"expected {q[k]:.4f}; it has mean {samples[0] @ found[:, j]:.4g} and sd "
                f"{_sd(found[:, j], samples[0]):.4g}, expected {samples[1] @ exact[:, j]:.4g} and "
                f"{_sd(exact[:, j], samples[1]):.4g}"
            )

    def check_independent(self, x: np.ndarray) -> None:
        """Check rank correlations between neighbouring particles, between halves, and between mirrored positions."""
        half = len(x) // 2
        pairs = {
            "neighbours": (x[::2], x[1::2]),
            f"particles {half} positions apart": (x[:half], x[half:]),
            "particles at mirrored positions": (x[:half], x[::-1][:half]),
        }
        n_tests = 20 * len(pairs) * x.shape[1]
        for j in range(x.shape[1]):
            for who, (a, b) in pairs.items():
                n = min(len(a), len(b))
                check_uncorrelated(a[:n, j], b[:n, j], n_tests, f"coordinate {j} of {self.columns} of {who}")


class DrawsContract(ExactContract):
    """Properties of components that draw or move particles: their results have the exact distribution.

    A contract defines what is compared: `rows_of`, the results of a call, and `exact_rows`, the same of exact draws.
    """

    independent: ClassVar[bool] = True  #: False if the rows of a call may be drawn by strata, sorted or antithetic

    def rows_of(self, case: tuple[Any, ...], rows: np.ndarray, rng: np.random.Generator) -> WeightedRows:
        """Rows and log weights that the component makes of some rows of a case of `exact`."""
        raise NotImplementedError

    def exact_rows(self, case: tuple[Any, ...]) -> WeightedRows:
        """Rows and log weights of the exact draws of a case."""
        raise NotImplementedError

    @statistical
    def test_distribution_is_exact(self) -> None:
        """Weighted results have the exact distribution and mean weight, and particles are independent."""

        def drawn(n: int) -> WeightedRows:
            return self.rows_of(self.exact_case(1, n), seeded(4).permutation(n), seeded(2))

        skip_unless_properly_weighted(self.make())
        self.exact_case(1, 1)
        n = self.draws_in_time(drawn)
        found = drawn(n)
        self.compare_rows(found, self.exact_rows(self.exact_case(3, n)))
        if self.independent and len(found[0]) == n:
            self.check_independent(found[0])

    @statistical
    def test_small_populations_are_exact(self) -> None:
        """Populations of three particles have the exact distribution, over many calls.

        With many particles a fault of order 1 / n does not show, as that of a mean over the population.
        """
        skip_unless_properly_weighted(self.make())
        case, calls = self.exact_case(1, _SMALL * _SMALL_CALLS), []
        for k in range(_SMALL_CALLS):
            self.tested = f"out of time after {k} of {_SMALL_CALLS} small populations"
            calls.append(self.rows_of(case, np.arange(_SMALL * k, _SMALL * (k + 1)), seeded(k)))
        x, lw = map(np.concatenate, zip(*calls, strict=True))
        self.compare_rows((x, lw), self.exact_rows(self.exact_case(3, 50_000)))
        if self.independent and all(len(x) == _SMALL for x, _ in calls):
            pairs = np.array([x[:2] for x, _ in calls])
            for j in range(pairs.shape[2]):
                first, second = pairs[:, :, j].T
                what = f"coordinate {j} of {self.columns} of two of three"
                check_uncorrelated(first, second, 20 * pairs.shape[2], what)

    def compare_rows(self, found: WeightedRows, exact: WeightedRows) -> None:
        """Compare the distributions of weighted rows, and their mean weights."""
        self.compare_weighted(*found, *exact)
        check_mean_weight(np.exp(found[1]), np.exp(exact[1]))


def _kind(item: Any) -> str:
    """What `exact` returned, for messages."""
    return f"a Population of {len(item)}" if isinstance(item, Population) else type(item).__name__


def check_parents(result: Population, name: str, n: int) -> None:
    """Assert that the parents called `name`, if there are any, are indices of `n` particles, or -1 for no parent."""
    index = result.parents.get(name, np.array([-1]))
    wrong = index[(index < -1) | (index >= n)]
    assert not len(wrong), f'parents "{name}" contain {wrong[0]}, and there were {n} particles'


def _pairs(d: int) -> list[tuple[int, int]]:
    """At most 20 pairs of d columns, neighbouring columns first."""
    return sorted(combinations(range(min(d, 40)), 2), key=lambda pair: pair[1] - pair[0])[:20]


def _with_sums(
    found: np.ndarray, exact: np.ndarray, w: np.ndarray, pairs: list[tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Add sums of pairs of columns to two samples. Each summand is divided by its exact standard deviation."""
    scale = [_sd(column, w) or 1.0 for column in exact.T]
    first, second = (
        np.column_stack([x, *(x[:, j] / scale[j] + x[:, k] / scale[k] for j, k in pairs)]) for x in (found, exact)
    )
    return first, second


def _weighted_fractions(x: np.ndarray, w: np.ndarray, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities that x is at most each limit, and their standard errors, for weights that sum to one."""
    bins = np.searchsorted(limits, x)  # the first limit that is not below x
    p, squares = (np.cumsum(np.bincount(bins, v, len(limits) + 1)) for v in (w, w * w))
    below, total = squares[:-1], squares[-1]
    p = p[:-1]
    return p, np.sqrt(np.maximum(below * (1 - 2 * p) + total * p * p, 0.0))


def _sd(x: np.ndarray, w: np.ndarray) -> float:
    """Weighted standard deviation."""
    return float(np.sqrt(w @ (x - w @ x) ** 2))


def check_uncorrelated(a: np.ndarray, b: np.ndarray, n_tests: int, what: str) -> None:
    """Check that two samples have no rank correlation, at the level `FALSE_ALARM` / `n_tests`."""
    from scipy.stats import spearmanr

    if np.ptp(a) > 0 and np.ptp(b) > 0:
        r, p = spearmanr(a, b)
        assert p >= FALSE_ALARM / n_tests, (
            f"particles do not move independently: {what} have correlation {r:.3g}; is a random number used for two "
            "particles?"
        )


def check_same_law(found: np.ndarray, expected: np.ndarray, n_tests: int, fault: str) -> None:
    """Check that columns of two samples have equal distributions, at the level `FALSE_ALARM` / `n_tests`."""
    from scipy.stats import ks_2samp

    for x, y in zip(found.T, expected.T, strict=True):
        assert ks_2samp(x, y, method="asymp").pvalue >= FALSE_ALARM / (n_tests * found.shape[1]), (
            f"{fault} (mean {x.mean():.3g} and {y.mean():.3g}, sd {x.std():.3g} and {y.std():.3g})"
        )


def check_mean_weight(w: np.ndarray, v: np.ndarray) -> None:
    """Check that two samples of weights have the same mean."""
    bound = quantile(2 * 20) * np.hypot(w.std() / len(w) ** 0.5, v.std() / len(v) ** 0.5) + 1e-9
    assert abs(w.mean() - v.mean()) <= bound, (
        f"the mean weight is {w.mean():.4g}, expected {v.mean():.4g}: constant factors change the evidence"
    )


def compare_factors(found: np.ndarray, exact: np.ndarray) -> None:
    """Check that the log weights of the same particles are equal, one by one."""
    wrong = ~np.isclose(found, exact, rtol=1e-6, atol=1e-6)
    i = int(np.argmax(wrong))
    assert not wrong.any(), (
        f"the log weight of a particle is {found[i]:.6g}, expected {exact[i]:.6g}; a constant factor changes the "
        "evidence"
    )
