"""Resampling by weight: schemes with equal output weights.

W_i is the normalised weight of particle i, N_i its number of copies among the n selected particles, f = frac(n W_i).
The schemes are unbiased, E[N_i] = n W_i, except `LargestWeights`. They differ in the variance of N_i.

==============  =================================================  ====================================
scheme          N_i                                                variance of N_i
==============  =================================================  ====================================
Multinomial     n independent draws                                n W_i (1 - W_i)
Residual        floor(n W_i), the rest by another scheme           f (1 - f / R), R = sum of all f
Stratified      one draw in each of n equal strata of [0, 1)       sum over strata of p (1 - p)
Systematic      one draw, shifted to each stratum                  f (1 - f)
Ssp             floor or ceil, fractions decided pair by pair      f (1 - f)
Killing         survive with w_i / max w, else multinomial         see `Killing`
==============  =================================================  ====================================

>>> import numpy as np
>>> rng = np.random.default_rng(0)
>>> Systematic().select(rng, np.log([0.5, 0.25, 0.25]), 4)[0]
array([0, 0, 1, 2])

The variance of `Residual` is that of its default, the multinomial remainder. Weights need not sum to 1, may have any
float type, and may be zero (log weight -inf); n may differ from their number. A particle of weight zero is never
selected. `InputError` is raised if a log weight is NaN or +inf, or if all weights are zero.

A user's scheme is a `WeightResampler` with such a `select`; `mstfilter.smc.inverse_cdf` has the draws.

Ties: the random schemes do not compare weights. Of particles with equal weights, `LargestWeights.select` (a stable
sort), `coalesce`, and the clusters of `mstfilter.smc.diverse_resampling` take the first.

Residual-systematic resampling (Bolic, Djuric, Hong 2004) has no class: in exact arithmetic it selects the same
particles as `Systematic` and as ``Residual("systematic")`` if all use the same uniform number.

References: Douc, Cappe, Moulines (2005), "Comparison of resampling schemes for particle filtering"; Kitagawa (1996);
Liu and Chen (1998).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from mstfilter.errors import InputError, check_choice, check_component
from mstfilter.smc.interfaces import Resampler, TransformResampler, WeightResampler
from mstfilter.smc.inverse_cdf import checked_weights, expanded, independent_draws, inverse_cdf, weights_of_runs


@dataclass(frozen=True)
class Multinomial(WeightResampler):
    """Independent draws by weight (Gordon, Salmond, Smith 1993). It has the largest variance; used as a reference."""

    batched: ClassVar[bool] = True

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        return independent_draws(rng, weights_of_runs(log_weights, n), n), None


@dataclass(frozen=True)
class Stratified(WeightResampler):
    """One uniform in each of n equal strata (Kitagawa 1996)."""

    batched: ClassVar[bool] = True

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = weights_of_runs(log_weights, n)
        return inverse_cdf(weights, rng.random((*weights.shape[:-1], n)), n), None


@dataclass(frozen=True)
class Systematic(WeightResampler):
    """One uniform for all strata (Carpenter, Clifford, Fearnhead 1999); N_i is floor or ceil of n W_i."""

    batched: ClassVar[bool] = True

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = weights_of_runs(log_weights, n)
        return inverse_cdf(weights, rng.random((*weights.shape[:-1], 1)), n), None


def certain_copies(weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, int]:
    """floor(n W_i) (m,) int64, the fractions frac(n W_i) (m,), and the sum of the fractions: the copies to draw."""
    fractions = weights * (n / weights.sum())
    floors = fractions * (1 + 1e-13)  # an integer up to rounding counts as that integer
    np.floor(floors, out=floors)
    fractions -= floors
    np.maximum(fractions, 0.0, out=fractions)
    copies = floors.astype(np.int64)
    return copies, fractions, n - int(copies.sum())


def systematic_copies(rng: np.random.Generator, expected: np.ndarray, n: int) -> np.ndarray:
    """(m,) numbers of copies with sum n and means `expected`, scaled to sum n: floor or ceil, by systematic draws."""
    copies, fractions, rest = certain_copies(expected, n)
    if rest > 0:
        copies += np.bincount(inverse_cdf(fractions, rng.random(1), rest), minlength=len(copies))
    return copies


@dataclass(frozen=True)
class Residual(WeightResampler):
    """floor(n W_i) copies of each particle; the rest is drawn by another scheme (Liu and Chen 1998).

    `remainder` is the scheme for the fractions frac(n W_i). Systematic has the least variance, f (1 - f).
    """

    remainder: Literal["multinomial", "stratified", "systematic"] = "multinomial"

    def __post_init__(self) -> None:
        check_choice("remainder", self.remainder, ("multinomial", "stratified", "systematic"))

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        copies, fractions, rest = certain_copies(checked_weights(log_weights, n), n)
        if rest > 0:
            copies += np.bincount(self._draws(rng, fractions, rest), minlength=len(copies))
        return expanded(np.cumsum(copies), n), None

    def _draws(self, rng: np.random.Generator, fractions: np.ndarray, rest: int) -> np.ndarray:
        if self.remainder == "multinomial":
            return independent_draws(rng, fractions, rest)
        return inverse_cdf(fractions, rng.random(1 if self.remainder == "systematic" else rest), rest)


_SETTLED = 1e-12  # a fraction this close to 0 or 1 is 0 or 1 up to rounding


@dataclass(frozen=True)
class Ssp(WeightResampler):
    """Srinivasan sampling process: N_i is floor or ceil of n W_i, for any order of the particles.

    Two fractions a and b form a pair, with up = min(1 - a, b) and down = min(a, 1 - b). With probability
    down / (up + down), a grows and b shrinks by `up`; otherwise a shrinks and b grows by `down`. Then one of the two
    is 0 or 1, which is final; the other one is paired again. Here all pairs of a round are
    processed together, so log2(n) rounds replace n steps (Gerber, Chopin, Whiteley 2019,
    "Negative association, ordering and convergence of resampling methods").
    """

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = checked_weights(log_weights, n)
        copies, value, _ = certain_copies(weights, n)
        index = np.flatnonzero(value > _SETTLED)
        value = value[index]
        while len(index) > 1:
            index, value = _settle_pairs(rng, copies, index, value)
        # The fractions sum to an integer, so the last one is 0 or 1 up to rounding.
        rest = n - int(copies.sum())
        if rest > 0 and len(index):
            copies[index[0]] += 1
            rest -= 1
        if rest > 0:  # a copy lost by rounding, probability of order 1e-12
            copies[np.argmax(weights)] += rest
        return expanded(np.cumsum(copies), n), None


def _settle_pairs(
    rng: np.random.Generator, copies: np.ndarray, index: np.ndarray, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One round of `Ssp`: adds settled fractions to `copies`, in place; returns the particles and fractions left."""
    a, b = value[:-1:2], value[1::2]
    total = a + b
    exceeds = total >= 1
    # One fraction of a pair becomes 0 and the other a + b, or one becomes 1 and the other a + b - 1.
    grows = rng.random(len(a)) * np.minimum(total, 2 - total) < np.minimum(a, 1 - b)
    left, right = index[:-1:2], index[1::2]
    open_one = np.where(grows != exceeds, left, right)
    copies[left + right - open_one] += exceeds
    total -= exceeds
    if len(index) % 2:
        open_one, total = np.concatenate((open_one, index[-1:])), np.concatenate((total, value[-1:]))
    if total.min() > _SETTLED and total.max() < 1 - _SETTLED:
        return open_one, total
    copies[open_one[total >= 1 - _SETTLED]] += 1
    alive = np.abs(total - 0.5) < 0.5 - _SETTLED
    return open_one[alive], total[alive]


def _one_particle_per_position(rng: np.random.Generator, m: int, n: int) -> np.ndarray:
    """(n,) particle that each position belongs to: floor(n / m) positions for each, one more for a random subset."""
    particles = np.arange(m) if n == m else np.tile(np.arange(m), n // m)
    if n % m:
        particles = np.concatenate([particles, np.sort(rng.choice(m, n % m, replace=False, shuffle=False))])
    return particles


@dataclass(frozen=True)
class Killing(WeightResampler):
    """A particle keeps its position with probability w_i / max w; the others are replaced by draws by weight.

    Most particles keep their positions if the weights are nearly equal. Del Moral (2004), "Feynman-Kac formulae",
    section 5.6, for n = m. For n != m each of n positions belongs to one particle: floor(n / m) positions each, and
    one more for a random subset. Each position then survives or is replaced. E[N_i] = n W_i for any n. For n = m,
    with p = w / max w, var N_i = p_i (1 - p_i) (1 - 2 W_i) + W_i^2 sum p (1 - p) + (m - sum p) W_i (1 - W_i).
    """

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = checked_weights(log_weights, n)
        ancestors = _one_particle_per_position(rng, len(weights), n)
        killed = np.flatnonzero(rng.random(n) >= (weights if n == len(weights) else weights[ancestors]))
        if len(killed):
            ancestors[killed] = independent_draws(rng, weights, len(killed))
        return ancestors, None


@dataclass(frozen=True)
class LargestWeights(WeightResampler):
    """Selects the n particles of largest weight, with equal weights; draws nothing. Not properly weighted.

    Of particles with equal weights the first is selected: the sort in `select` is stable. If fewer than n particles
    have positive weight, they are repeated in turn.
    """

    properly_weighted: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        checked_weights(log_weights, n)
        # Sorted by log weight, because different weights may all underflow to zero.
        largest = np.argsort(-log_weights, kind="stable")[: np.isfinite(log_weights).sum()]
        return largest[np.arange(n) % len(largest)], None


def check_scheme(scheme: Resampler) -> None:
    """Raise InputError unless the scheme is a resampler that selects particles."""
    check_component("scheme", scheme, Resampler)
    if isinstance(scheme, TransformResampler):
        raise InputError(
            f"{type(scheme).__name__} makes new particles without ancestors",
            "use a scheme that selects",
        )
