"""Comparison of weighted particles with exact draws: distributions, mean weights, and independence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations
from time import process_time
from typing import Any
from unittest import SkipTest

import numpy as np
from scipy.special import ndtri

from mstfilter.smc import Population
from mstfilter.smc.testing.contract import FALSE_ALARM, Contract, seeded, skip_unless_properly_weighted
from mstfilter.smc.testing.copies import quantile


class PopulationContract(Contract):
    """Common parts of contracts of components that return a population."""

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, Population), f"it returns {type(result).__name__}, expected a Population"

    def check_scale(self, inputs: dict[str, Any], name: str) -> None:
        """Check that adding a number to the log weights of the population `name` adds it to those of the result."""
        skip_unless_properly_weighted(self.make())
        for shift in (50.0, -50.0):
            shifted = inputs[name].reweighted(np.full(len(inputs[name]), shift))
            fault = f"log weights + {shift:g} in do not give log weights + {shift:g} out"
            self.check_relation(inputs, {name: shifted}, fault, partial(_shifted, shift=shift))


def _shifted(out: Population, shift: float) -> np.ndarray:
    return out.log_weights + shift


#: Numbers of exact draws. The second follows if a call with the first takes less than _FAST seconds.
_DRAWS, _FAST = (10_000, 200_000), 0.04
SINGLE = 400  # number of tests of a single particle
_TAILS = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025)
_LEVELS = np.array([*_TAILS, *np.arange(0.05, 1, 0.05), *(1 - p for p in reversed(_TAILS))])


class ExactContract(PopulationContract):
    """Properties of components with exact draws to compare with.

    Define a method ``exact(self, rng, n)``, or a function ``exact(rng, n)`` beside the component. `exact` returns
    three items. The first item is a population of `n` particles before the call. The second item is a population of
    exact draws, or with exact weights, after the call. The third item is the observation. An optional fourth item
    ``log_likelihood(particles) -> (n,)`` multiplies the weights on both sides. The factor makes the weights f / q of
    a guided move even. The test is skipped if one of 10,000 weights exceeds 1 % of the total.

    The rows of `exact` are independent draws, or x_{t-1} lies on a grid. With 200,000 rows, the tests detect a
    standard deviation that is wrong by 2 %, and a shift by 3 % of it. The tests also detect missing tails with 0.1 %
    of the probability, and a correlation of 0.02 between particles.
    """

    exact: Callable[[np.random.Generator, int], tuple[Any, ...]] | None = None

    def exact_case(self, seed: int, n: int) -> tuple[Any, ...]:
        """Exact draws. Skips the test if there are none."""
        if self.exact is None:
            raise SkipTest("there are no exact draws to compare with: write exact(rng, n)")
        return self.exact(seeded(seed), n)

    def numbers_of_draws(self, call: Callable[[int], Any]) -> Iterator[int]:
        """Numbers of draws of a test that calls ``call(n)``: 10,000, and 200,000 if this is fast."""
        yield _DRAWS[0]
        start = process_time()
        call(_DRAWS[0])
        if process_time() - start < _FAST:
            yield _DRAWS[1]

    def compare_weighted(self, found: np.ndarray, lw: np.ndarray, exact: np.ndarray, exact_lw: np.ndarray) -> None:
        """Compare the weighted distributions of rows, for each column and for the sums of pairs of columns.

        Probabilities of intervals, means and spreads are compared. Sums detect columns that share a random number.

        The difference of two weighted means is normal, up to errors that a twentieth of the level allows for. A tail
        is compared if its probability is at least that of 50 of the largest weights, so no rare weight decides.
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
            cumulative = np.cumsum(samples[1][order])[:-1]
            limits = exact[order[cumulative.searchsorted(levels)], j]
            (p, s), (q, r) = (
                _weighted_fractions(x[:, j], w, limits) for x, w in zip((found, exact), samples, strict=True)
            )
            what = self.columns(j, d) if j < d else " + ".join(self.columns(k, d) for k in pairs[j - d])
            bound = quantile(4 * len(_DRAWS) * 20 * found.shape[1] * len(limits)) * np.hypot(s, r) + 1e-9
            excess = np.abs(p - q) - bound
            k = int(np.argmax(excess))
            assert excess[k] <= 0, (
                f"the weighted distribution is wrong: {what} is below {limits[k]:.3g} with probability {p[k]:.4f}, "
                f"expected {q[k]:.4f}"
            )
            # The mean and the spread, by normal scores: they have more power against a shift and another scale.
            F = np.concatenate([[0.0], cumulative, [1.0]])
            (p, s), (q, r) = (
                _moments_of_scores(x[:, j], w, exact[order, j], F, min(max(least, 1e-4), 0.05))
                for x, w in zip((found, exact), samples, strict=True)
            )
            wrong = np.abs(p - q) > quantile(2 * len(_DRAWS) * 20 * found.shape[1] * 2) * np.hypot(s, r) + 1e-9
            assert not wrong.any(), (
                f"the weighted distribution is wrong: {what} has mean {samples[0] @ found[:, j]:.4g} and sd "
                f"{_sd(found[:, j], samples[0]):.4g}, expected {samples[1] @ exact[:, j]:.4g} and "
                f"{_sd(exact[:, j], samples[1]):.4g}"
            )

    def compare_changed(
        self, found: np.ndarray, change: np.ndarray, log_g: Any, exact: np.ndarray, exact_lw: np.ndarray
    ) -> None:
        """`compare_weighted` for the log weights ``log_g + change``. States whether -`change` would be correct."""
        try:
            self.compare_weighted(found, log_g + change, exact, exact_lw)
        except (AssertionError, SkipTest) as error:
            try:
                self.compare_weighted(found, log_g - change, exact, exact_lw)
            except (AssertionError, SkipTest):
                raise error from None
            if not np.ptp(change):
                raise
            raise AssertionError(
                "the weighted distribution is right if the change of the log weights has the opposite sign: "
                "is it log q - log f?"
            ) from error

    def check_independent(self, x: np.ndarray) -> None:
        """Check rank correlations between particles: of neighbours, of halves, and of mirrored positions."""
        half = len(x) // 2
        pairs = {
            "neighbours": (x[::2], x[1::2]),
            f"particles {half} positions apart": (x[:half], x[half:]),
            "particles at mirrored positions": (x[:half], x[::-1][:half]),
        }
        n_tests = len(_DRAWS) * 20 * len(pairs) * x.shape[1]
        for j in range(x.shape[1]):
            for who, (a, b) in pairs.items():
                n = min(len(a), len(b))
                check_uncorrelated(a[:n, j], b[:n, j], n_tests, f"{self.columns(j, x.shape[1])} of {who}")

    def check_single(self, find: Callable[[int], np.ndarray], exact: np.ndarray) -> None:
        """Check that particles alone, ``find(row)`` (d,), have the distribution of the rows of `exact`."""
        alone = np.array([find(row) for row in range(SINGLE)])
        check_same_law(alone, exact, 1, "a single particle (n = 1) has another distribution")

    #: Whether the second half of the columns are differences from the particles before.
    moves = False

    def columns(self, j: int, n_columns: int) -> str:
        """Description of column `j`."""
        if not self.moves:
            return f"coordinate {j} of x"
        half = n_columns // 2
        return f"coordinate {j} of x_t" if j < half else f"coordinate {j - half} of x_t - x_{{t-1}}"


def _pairs(d: int) -> list[tuple[int, int]]:
    """At most 20 pairs of d columns, with neighbours first."""
    return sorted(combinations(range(min(d, 40)), 2), key=lambda pair: pair[1] - pair[0])[:20]


def _with_sums(
    found: np.ndarray, exact: np.ndarray, w: np.ndarray, pairs: list[tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Two samples with sums of pairs of columns as additional columns, each divided by its exact spread."""
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


def _moments_of_scores(
    x: np.ndarray, w: np.ndarray, exact: np.ndarray, F: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means of z and z^2, and standard errors; z is the normal quantile of the rank of x in sorted draws.

    `F` (n + 1,) are the cumulative weights of the draws. Ranks nearer to 0 or 1 than `least` are moved there.
    """
    rank = (F[exact.searchsorted(x)] + F[exact.searchsorted(x, side="right")]) / 2
    z = ndtri(np.clip(rank, least, 1 - least))
    scores = np.array([z, z * z])
    means = scores @ w
    return means, np.sqrt((scores - means[:, None]) ** 2 @ (w * w))


def without_copies(x: np.ndarray, out: Population) -> tuple[np.ndarray, np.ndarray]:
    """Rows and log weights of a result, without copies of a parent "previous".

    The first copy gets the sum of the weights.

    Copies are not independent draws. Equal particles with different parents are independent draws.
    """
    parent = out.parents.get("previous")
    if parent is None or len(np.unique(parent)) == len(x):
        return x, out.log_weights
    _, first, which = np.unique(np.column_stack([parent, x]), axis=0, return_index=True, return_inverse=True)
    highest = out.log_weights.max()
    with np.errstate(divide="ignore"):
        return x[first], highest + np.log(np.bincount(which.ravel(), np.exp(out.log_weights - highest)))


def _sd(x: np.ndarray, w: np.ndarray) -> float:
    """Weighted standard deviation."""
    return float(np.sqrt(w @ (x - w @ x) ** 2))


def check_uncorrelated(a: np.ndarray, b: np.ndarray, n_tests: int, what: str) -> None:
    """Check that two samples have no rank correlation; `n_tests` share the false-alarm rate."""
    from scipy.stats import spearmanr

    if np.ptp(a) > 0 and np.ptp(b) > 0:
        r, p = spearmanr(a, b)
        assert p >= FALSE_ALARM / n_tests, (
            f"particles do not move independently: {what} have correlation {r:.3g}; is a random number used for two "
            "particles?"
        )


def check_same_law(found: np.ndarray, expected: np.ndarray, n_tests: int, fault: str) -> None:
    """Check that the columns of two samples have the same distributions; `n_tests` share the false-alarm rate."""
    from scipy.stats import ks_2samp

    for x, y in zip(found.T, expected.T, strict=True):
        assert ks_2samp(x, y, method="asymp").pvalue >= FALSE_ALARM / (n_tests * found.shape[1]), (
            f"{fault} (mean {x.mean():.3g} and {y.mean():.3g}, sd {x.std():.3g} and {y.std():.3g})"
        )


def check_mean_weight(w: np.ndarray, v: np.ndarray) -> None:
    """Check that two samples of weights have one mean."""
    bound = quantile(2 * len(_DRAWS) * 20) * np.hypot(w.std() / len(w) ** 0.5, v.std() / len(v) ** 0.5) + 1e-9
    assert abs(w.mean() - v.mean()) <= bound, (
        f"the mean weight is {w.mean():.4g}, expected {v.mean():.4g}: constant factors change the evidence"
    )


def compare_factors(found: np.ndarray, exact: np.ndarray) -> None:
    """Check log weights of the same particles one by one."""
    with np.errstate(invalid="ignore"):
        difference = np.where(found == exact, 0.0, found - exact)
    wrong = ~(np.abs(difference) <= 1e-6 * (1 + np.abs(exact)))
    if not wrong.any():
        return
    constant = np.isfinite(difference).all() and np.ptp(difference) <= 1e-6 * (1 + np.abs(exact).max())
    assert not constant, (
        f"all weights are {np.exp(difference[0]):.4g} times the exact ones: constant factors change the evidence"
    )
    i = int(np.argmax(wrong))
    raise AssertionError(f"the log weight of a particle is {found[i]:.6g}, expected {exact[i]:.6g}")
