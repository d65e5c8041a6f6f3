"""Classical resampling schemes, and triggers.

All are unbiased: particle i gets on average n W_i copies, W its normalised weight. They differ in how far the
number of copies N_i strays from that. Notation: f = frac(n W_i).

============  =============================================  ========================================
scheme        N_i                                            variance of N_i
============  =============================================  ========================================
multinomial   n independent draws                            n W_i (1 - W_i)
residual      floor(n W_i), the rest by another scheme       r_i (1 - r_i / R), r_i = f, R = sum of r
stratified    one draw in each of n equal strata of [0, 1)   sum over strata of p (1 - p)
systematic    one draw, shifted to each stratum              f (1 - f)
============  =============================================  ========================================

>>> import numpy as np
>>> rng = np.random.default_rng(0)
>>> Systematic().select(rng, np.log([0.5, 0.25, 0.25]), 4)[0]
array([0, 0, 1, 2])

(The variance of residual is that of its default, the multinomial remainder.) Weights may be unnormalised, of any
float type, and hold zeros (log weight -inf) anywhere; n may differ from their number. A particle of weight zero
is never chosen; NaN, +inf or nothing but zeros is an `InputError`.

More schemes: `mstfilter.smc.resampling_rounding` (SSP, residual-systematic, killing),
`mstfilter.smc.resampling_optimal` (Fearnhead-Clifford: no duplicates), `mstfilter.smc.resampling_clusters`,
`mstfilter.smc.resampling_dpp` and `mstfilter.smc.resampling_greedy` (diverse selections, which see the particles),
`mstfilter.smc.resampling_wrappers` (coalescing, tempering, shuffling).

References: Douc, Cappe, Moulines (2005), "Comparison of resampling schemes for particle filtering"; Kitagawa
(1996); Liu and Chen (1998).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import number, whole
from mstfilter.smc.interfaces import Resampler, Trigger
from mstfilter.smc.population import Population

__all__ = [
    "Always",
    "EssBelow",
    "Every",
    "Multinomial",
    "Never",
    "Residual",
    "Stratified",
    "Systematic",
    "checked_weights",
]


def checked_weights(log_weights: np.ndarray, n: int) -> np.ndarray:
    """(m,) float64 weights whose largest is 1, from log weights of any float type.

    Raises
    ------
    InputError
        Not one number a particle, a NaN, +inf, nothing but -inf, or n < 1.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    if lw.ndim != 1 or len(lw) == 0:
        raise InputError(f"log weights have shape {lw.shape}, expected one number a particle")
    if not isinstance(n, (int, np.integer)) or n < 1:
        raise InputError(f"resampling to {n} particles, expected a whole number of at least 1")
    top = lw.max()
    if not -np.inf < top < np.inf:
        at = int(np.flatnonzero(~np.isfinite(lw) & ~np.isneginf(lw))[0]) if not np.isneginf(top) else 0
        raise InputError(f"log weights cannot be resampled: entry {at} is {lw[at]}, the largest is {top}")
    weights = lw - top
    return np.exp(weights, out=weights)


def _cumulative(log_weights: np.ndarray, n: int) -> np.ndarray:
    """(m,) cumulative weights in float64, last entry exactly the total; checks the input."""
    weights = checked_weights(log_weights, n)
    return np.cumsum(weights, out=weights)


def whole_copies(weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, int]:
    """floor(n W_i) as (m,) int64, the fractions left (m,), and how many copies these are to make."""
    expected = weights * (n / weights.sum())
    # What is a whole number but for rounding counts as whole: else its copy would be left to chance.
    copies = np.floor(expected * (1 + 1e-13))
    return copies.astype(np.int64), np.clip(expected - copies, 0.0, None), n - int(copies.sum())


def ordered_uniforms(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n,) uniforms on [0, 1] in ascending order, in O(n): normalised exponential spacings."""
    spacings = np.cumsum(rng.standard_exponential(n + 1))
    return spacings[:-1] / spacings[-1]


def _from_points(cumulative: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Index whose interval of the cumulative weights holds each point of [0, total)."""
    index = np.searchsorted(cumulative, points, side="right")  # "right" skips weights of zero
    # A point rounded up to the total belongs to the last particle that has any weight.
    last = int(np.searchsorted(cumulative, cumulative[-1], side="left"))
    return np.minimum(index, last)


def _from_shifts(cumulative: np.ndarray, n: int, shift: float) -> np.ndarray:
    """Systematic selection: ancestors at the points (k + shift) / n, in O(m + n) without a search."""
    total = cumulative[-1]
    # Number of points below each cumulative weight; at the total it is n by definition, whatever rounding says.
    points = cumulative * (n / total)
    points -= shift
    np.ceil(points, out=points)  # above -1 before, so not negative now
    np.minimum(points, n, out=points)
    points[cumulative.searchsorted(total, side="left") :] = n
    # Place k has the particle before which k points lie: counting is quicker than repeating at random numbers.
    ends = points[:-1].astype(np.int64)
    return np.bincount(ends, minlength=n)[:n].cumsum()


@dataclass(frozen=True)
class Multinomial(Resampler):
    """Independent draws by weight (Gordon, Salmond, Smith 1993). The noisiest scheme; an oracle for the others."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Choose by n uniforms that are made in sorted order: O(m + n)."""
        cumulative = _cumulative(log_weights, n)
        return _from_points(cumulative, ordered_uniforms(rng, n) * cumulative[-1]), None


@dataclass(frozen=True)
class Stratified(Resampler):
    """One uniform in each of n equal strata (Kitagawa 1996)."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Choose."""
        cumulative = _cumulative(log_weights, n)
        points = (np.arange(n) + rng.random(n)) * (cumulative[-1] / n)
        return _from_points(cumulative, points), None


@dataclass(frozen=True)
class Systematic(Resampler):
    """One uniform for all strata (Carpenter, Clifford, Fearnhead 1999); N_i is floor or ceil of n W_i."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Choose."""
        cumulative = _cumulative(log_weights, n)
        return _from_shifts(cumulative, n, rng.random()), None


@dataclass(frozen=True)
class Residual(Resampler):
    """floor(n W_i) copies for certain, the rest by another scheme (Liu and Chen 1998).

    Parameters
    ----------
    remainder : {"multinomial", "stratified", "systematic"}
        How the fractions frac(n W_i) make the remaining copies. Systematic has the least variance, f (1 - f).
    """

    remainder: Literal["multinomial", "stratified", "systematic"] = "multinomial"

    def __post_init__(self) -> None:
        if self.remainder not in ("multinomial", "stratified", "systematic"):
            raise InputError(
                f"remainder is {self.remainder!r}", "there are: multinomial, stratified and systematic remainders"
            )

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        """Choose."""
        copies, fractions, rest = whole_copies(checked_weights(log_weights, n), n)
        if rest > 0:
            cumulative = np.cumsum(fractions)
            if self.remainder == "systematic":
                drawn = _from_shifts(cumulative, rest, rng.random())
            elif self.remainder == "stratified":
                drawn = _from_points(cumulative, (np.arange(rest) + rng.random(rest)) * (cumulative[-1] / rest))
            else:
                drawn = _from_points(cumulative, ordered_uniforms(rng, rest) * cumulative[-1])
            copies += np.bincount(drawn, minlength=len(copies))
        return np.repeat(np.arange(len(copies)), copies), None


@dataclass(frozen=True)
class EssBelow(Trigger):
    """Resample where the effective sample size falls below a share of the particles.

    Parameters
    ----------
    share : float
        Of the number of particles, in (0, 1].
    """

    share: float = 0.5

    def __post_init__(self) -> None:
        hint = "a share of the particles, not their number: 0.5 resamples below half of them"
        number("share", self.share, f"{hint}; the triggers Always and Never do one or the other", above=0, at_most=1)

    def wants(self, population: Population, t: int) -> bool:
        """True where ESS < share * n."""
        return population.ess < self.share * len(population)


@dataclass(frozen=True)
class Always(Trigger):
    """Resample at every step."""

    def wants(self, population: Population, t: int) -> bool:
        """True."""
        return True


@dataclass(frozen=True)
class Never(Trigger):
    """Resample only where there are more particles than the filter keeps."""

    def wants(self, population: Population, t: int) -> bool:
        """False."""
        return False


@dataclass(frozen=True)
class Every(Trigger):
    """Resample at every k-th step.

    Parameters
    ----------
    k : int
        Steps from one resampling to the next.
    """

    k: int = 2

    def __post_init__(self) -> None:
        whole("resampling at every k-th step: k", self.k)

    def wants(self, population: Population, t: int) -> bool:
        """True where t is a multiple of k."""
        return t % self.k == 0
