"""Resampling by weight: schemes with equal output weights.

W_i is the normalised weight of particle i, N_i its number of copies among the n selected particles, f = frac(n W_i).
The schemes are unbiased, E[N_i] = n W_i, except `Metropolis` and `LargestWeights`. They differ in the variance of
N_i.

==================  =================================================  ====================================
scheme              N_i                                                variance of N_i
==================  =================================================  ====================================
Multinomial         n independent draws                                n W_i (1 - W_i)
Residual            floor(n W_i), the rest by another scheme           f (1 - f / R), R = sum of all f
Stratified          one draw in each of n equal strata of [0, 1)       sum over strata of p (1 - p)
Systematic          one draw, shifted to each stratum                  f (1 - f)
Ssp                 floor or ceil, fractions decided pair by pair      f (1 - f)
Killing, Rejection  survive with w_i / max w, else multinomial         see `Killing`
==================  =================================================  ====================================

>>> import numpy as np
>>> rng = np.random.default_rng(0)
>>> Systematic().select(rng, np.log([0.5, 0.25, 0.25]), 4)[0]
array([0, 0, 1, 2])

The variance of `Residual` is that of its default, the multinomial remainder. Weights need not sum to 1, may have any
float type, and may be zero (log weight -inf); n may differ from their number. A particle of weight zero is never
selected. `InputError` is raised if a log weight is NaN or +inf, or if all weights are zero.

Ties: the random schemes do not compare weights. Of particles with equal weights, `LargestWeights.select` (a stable
sort), `coalesce`, and the diverse schemes of `mstfilter.smc.diverse_resampling` take the first.

Residual-systematic resampling (Bolic, Djuric, Hong 2004) has no class: in exact arithmetic it selects the same
particles as `Systematic` and as ``Residual("systematic")`` if all use the same uniform number.

References: Douc, Cappe, Moulines (2005), "Comparison of resampling schemes for particle filtering"; Kitagawa (1996);
Liu and Chen (1998).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from mstfilter.errors import InputError, check_choice, check_component, check_integer, check_number
from mstfilter.smc.interfaces import Resampler, TransformResampler, WeightResampler


def checked_weights(log_weights: np.ndarray, n: int) -> np.ndarray:
    """(m,) float64 weights with maximum 1, from log weights of any float type.

    Raises InputError if the log weights are not one-dimensional, hold NaN or +inf, or are all -inf, or if n < 1.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    if lw.ndim != 1 or len(lw) == 0:
        raise InputError(f"log weights have shape {lw.shape}, expected one number per particle")
    if not isinstance(n, (int, np.integer)) or n < 1:
        raise InputError(f"resampling to {n} particles, expected an integer of at least 1")
    top = lw.max()
    if not -np.inf < top < np.inf:
        at = int(np.flatnonzero(~np.isfinite(lw) & ~np.isneginf(lw))[0]) if not np.isneginf(top) else 0
        raise InputError(f"log weights cannot be resampled: entry {at} is {lw[at]}, the largest is {top}")
    weights = lw - top
    return np.exp(weights, out=weights)


def _weights(log_weights: np.ndarray, n: int) -> np.ndarray:
    """`checked_weights`; those of a batch, (R, m), are not checked."""
    if np.ndim(log_weights) != 2:
        return checked_weights(log_weights, n)
    weights = log_weights - log_weights.max(axis=1, keepdims=True)
    return np.exp(weights, out=weights)


def certain_copies(weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, int]:
    """floor(n W_i) (m,) int64, the fractions frac(n W_i) (m,), and the sum of the fractions: the copies to draw."""
    fractions = weights * (n / weights.sum())
    floors = fractions * (1 + 1e-13)  # an integer up to rounding counts as that integer
    np.floor(floors, out=floors)
    fractions -= floors
    np.maximum(fractions, 0.0, out=fractions)
    copies = floors.astype(np.int64)
    return copies, fractions, n - int(copies.sum())


def ordered_uniforms(rng: np.random.Generator, n: int, rows: tuple[int, ...] = ()) -> np.ndarray:
    """``(*rows, n)`` uniforms on [0, 1], ascending in each row, in O(n): normalised exponential spacings."""
    points = rng.standard_exponential((*rows, n + 1))
    np.cumsum(points, axis=-1, out=points)
    points /= points[..., -1:]
    return points[..., :-1]


def _fixed_point(weights: np.ndarray, total: int) -> np.ndarray:
    """(m,) int64 cumulative weights that end at `total`, at most 2^62.

    Integers are added exactly, and four times as fast as floats.
    """
    cumulative = np.empty(len(weights), np.int64)
    np.multiply(weights, total / weights.sum(), out=cumulative, casting="unsafe")
    np.cumsum(cumulative, out=cumulative)
    if cumulative[-1] > total:
        np.minimum(cumulative, total, out=cumulative)
    cumulative[cumulative.searchsorted(cumulative[-1]) :] = total  # ends at the last particle of positive weight
    return cumulative


_BLOCK = 1 << 13  # arrays of so many numbers stay in cache


def _searched(weights: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The index of the interval of the cumulative weights, scaled to [0, 1), that contains each of a few points."""
    if weights.ndim == 2:
        return np.stack([_searched(*row) for row in zip(weights, points, strict=True)])
    cumulative = weights.cumsum()
    index = cumulative.searchsorted(points * cumulative[-1], side="right")  # "right" skips weights of zero
    # A point rounded up to the total belongs to the last particle of positive weight.
    return np.minimum(index, cumulative.searchsorted(cumulative[-1]))


def independent_draws(rng: Any, weights: np.ndarray, n: int) -> np.ndarray:
    """(n,) indices drawn independently by weight, in O(m + n).

    Many draws are distributed to strata of equal weight, and ascend from one stratum to the next only. Inside a
    stratum, the number of cumulative weights in lower bins is a lower bound of the index of a point, which is
    increased where it is too small.
    """
    if n < 2000:
        return _searched(weights, ordered_uniforms(rng, n, weights.shape[:-1]))
    if weights.ndim == 2:
        return np.stack([independent_draws(g, w, n) for g, w in zip(rng.generators(), weights, strict=True)])
    # Strata have width 2^bits and up to 2^14 points, so that their tables stay in cache.
    bits = 62 - max(n.bit_length() - 14, 0)
    limits = [k << bits for k in range((1 << (62 - bits)) + 1)]
    cumulative = _fixed_point(weights, limits[-1])
    stops = cumulative.searchsorted(limits, side="right").tolist()
    stops[-1] = int(cumulative.searchsorted(limits[-1]))
    sizes = rng.multinomial(n, np.full(len(limits) - 1, 1 / (len(limits) - 1))).tolist()
    # log2 of the width of a bin; the largest stratum has one to two bins for each point.
    shift = bits - max(sizes).bit_length()
    n_bins = 1 << (bits - shift)
    below = np.empty(n_bins + 1, np.int64)
    index, begin = np.empty(n, np.int64), 0
    for k, size in enumerate(sizes):
        points = rng.bit_generator.random_raw(size)  # of 64 bits
        points >>= np.uint64(64 - bits)
        points = points.view(np.int64)
        bins = (cumulative[stops[k] : stops[k + 1]] >> shift) - (limits[k] >> shift)
        counts = np.bincount(bins, minlength=n_bins)
        below[0], below[1:] = stops[k], counts[:n_bins]  # an edge at the end of the stratum lies beyond its bins
        np.cumsum(below, out=below)
        found = index[begin : begin + size]
        below.take(points >> shift, out=found, mode="clip")
        points += limits[k]
        _increase(found, cumulative, points)
        begin += size
    return index


def _increase(index: np.ndarray, edges: np.ndarray, points: np.ndarray) -> None:
    """Increase lower bounds of ``searchsorted(edges, points, side="right")`` to these, in place."""
    low = np.flatnonzero(edges.take(index) <= points)
    at, points = index.take(low), points.take(low)
    for _ in range(6):
        at += 1
        index[low] = at
        more = np.flatnonzero(edges.take(at) <= points)
        if not len(more):
            return
        low, at, points = low.take(more), at.take(more), points.take(more)
    index[low] = edges.searchsorted(points, side="right")


def stratified_ancestors(weights: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
    """(n,) ancestors at the points (k + u_k) / n of the cumulative weights."""
    n = uniforms.shape[-1]
    if n < 1000:
        return _searched(weights, (np.arange(n) + uniforms) / n)
    if weights.ndim == 2:
        return np.stack([stratified_ancestors(*row) for row in zip(weights, uniforms, strict=True)])
    bits = 62 - n.bit_length()
    cumulative = _fixed_point(weights, n << bits)  # a stratum has width 2^bits
    for begin in range(0, len(weights), _BLOCK):
        edges = cumulative[begin : begin + _BLOCK]
        strata = edges >> bits
        edges &= (1 << bits) - 1
        below = uniforms.take(strata, mode="clip") < edges * 2.0**-bits  # the last edge lies at 0 of stratum n
        np.add(strata, below, out=edges)
    return _expanded(cumulative, n)


def systematic_ancestors(cumulative: np.ndarray, n: int, shift: float) -> np.ndarray:
    """(n,) ancestors at the points (k + shift) / n of the cumulative weights."""
    total = cumulative[-1]
    # Number of points below each cumulative weight; n at the total, whatever the rounding.
    points = cumulative * (n / total)
    points -= shift
    np.ceil(points, out=points)  # greater than -1 before, so not negative now
    np.minimum(points, n, out=points)
    points[cumulative.searchsorted(total) :] = n
    return _expanded(points.astype(np.int64), n)


def _expanded(ends: np.ndarray, n: int) -> np.ndarray:
    """(n,) ancestors if particle i gets the positions from ends[i - 1] to ends[i]: position k that many ends <= k."""
    counts = np.bincount(ends[:-1], minlength=n)[:n]
    return counts.cumsum(out=counts)


@dataclass(frozen=True)
class Multinomial(WeightResampler):
    """Independent draws by weight (Gordon, Salmond, Smith 1993). It has the largest variance; used as a reference."""

    batched: ClassVar[bool] = True

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        return independent_draws(rng, _weights(log_weights, n), n), None


@dataclass(frozen=True)
class Stratified(WeightResampler):
    """One uniform in each of n equal strata (Kitagawa 1996)."""

    batched: ClassVar[bool] = True

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = _weights(log_weights, n)
        return stratified_ancestors(weights, rng.random((*weights.shape[:-1], n))), None


@dataclass(frozen=True)
class Systematic(WeightResampler):
    """One uniform for all strata (Carpenter, Clifford, Fearnhead 1999); N_i is floor or ceil of n W_i."""

    batched: ClassVar[bool] = True

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        if log_weights.ndim == 2:  # one row per run of a batch
            return _systematic_rows(log_weights, n, rng.random((len(log_weights), 1))), None
        weights = checked_weights(log_weights, n)
        return systematic_ancestors(weights.cumsum(out=weights), n, rng.random()), None


def _systematic_rows(log_weights: np.ndarray, n: int, shifts: np.ndarray) -> np.ndarray:
    """(R, n) ancestors for (R, m) log weights and (R, 1) shifts: `systematic_ancestors` of every row."""
    rows, weights = len(log_weights), _weights(log_weights, n)
    cumulative = np.cumsum(weights, axis=1, out=weights)
    total = cumulative[:, -1:]
    points = cumulative * (n / total)
    points -= shifts
    np.ceil(points, out=points)
    np.minimum(points, n, out=points)
    points[cumulative == total] = n
    ends = points[:, :-1].astype(np.int64) + (n + 1) * np.arange(rows)[:, None]
    counts = np.bincount(ends.ravel(), minlength=rows * (n + 1)).reshape(rows, n + 1)
    return counts[:, :n].cumsum(axis=1)


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
            if self.remainder == "systematic":
                drawn = systematic_ancestors(np.cumsum(fractions), rest, rng.random())
            elif self.remainder == "stratified":
                drawn = stratified_ancestors(fractions, rng.random(rest))
            else:
                drawn = independent_draws(rng, fractions, rest)
            copies += np.bincount(drawn, minlength=len(copies))
        return _expanded(np.cumsum(copies), n), None


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
            index, value = open_one, total
            if value.min() <= _SETTLED or value.max() >= 1 - _SETTLED:
                copies[index[value >= 1 - _SETTLED]] += 1
                alive = np.abs(value - 0.5) < 0.5 - _SETTLED
                index, value = index[alive], value[alive]
        # The fractions sum to an integer, so the last one is 0 or 1 up to rounding.
        rest = n - int(copies.sum())
        if rest > 0 and len(index):
            copies[index[0]] += 1
            rest -= 1
        if rest > 0:  # a copy lost by rounding, probability of order 1e-12
            copies[np.argmax(weights)] += rest
        return _expanded(np.cumsum(copies), n), None


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
class Rejection(WeightResampler):
    """`Killing` without cumulative weights: a killed position tries particles until it accepts one.

    A position first tries its own particle, then particles drawn uniformly; it accepts with probability w / max w.
    The mean number of trials is max w / mean w. Positions that have accepted nothing after `max_trials` are drawn by
    weight, which does not change the law. Murray, Lee, Jacob (2016), "Parallel resampling in the particle filter",
    code 3.
    """

    max_trials: int = 100

    def __post_init__(self) -> None:
        check_integer("max_trials", self.max_trials)

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = checked_weights(log_weights, n)
        ancestors = _one_particle_per_position(rng, len(weights), n)
        left = np.flatnonzero(rng.random(n) >= weights[ancestors])
        for _ in range(self.max_trials - 1):
            if not len(left):
                break
            ancestors[left] = rng.integers(0, len(weights), len(left))
            left = left[rng.random(len(left)) >= weights[ancestors[left]]]
        if len(left):
            ancestors[left] = independent_draws(rng, weights, len(left))
        return ancestors, None


@dataclass(frozen=True)
class Metropolis(WeightResampler):
    """Each position follows a Metropolis chain over the particles, with uniform proposals. Not properly weighted.

    The law of a position differs from W by at most (1 - mean w / max w)^steps in total variation. The number of steps
    is the least for which this bound is at most `tolerance`, but at most `max_steps`. Murray, Lee, Jacob (2016),
    "Parallel resampling in the particle filter", code 2 and section 3.2.
    """

    tolerance: float = 0.01
    max_steps: int = 500

    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_number("tolerance", self.tolerance, above=0, below=1, unit="total variation")
        check_integer("max_steps", self.max_steps)

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = checked_weights(log_weights, n)
        ancestors = _one_particle_per_position(rng, len(weights), n)
        ancestors[weights[ancestors] == 0] = np.argmax(weights)  # a chain from weight zero could end there
        for _ in range(self.steps(weights)):
            tried = rng.integers(0, len(weights), n)
            accepted = rng.random(n) * weights[ancestors] < weights[tried]
            ancestors = np.where(accepted, tried, ancestors)
        return ancestors, None

    def steps(self, weights: np.ndarray) -> int:
        """Number of steps for weights with maximum 1."""
        acceptance = min(float(weights.mean()), 1 - 1e-9)
        return min(int(np.ceil(np.log(self.tolerance) / np.log1p(-acceptance))), self.max_steps)


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
