"""Resampling schemes that use only the weights. The output weights are equal.

W_i is the normalised weight of particle i, N_i the number of its copies among the n selected particles, and f =
frac(n W_i). All schemes except `LargestWeights` are unbiased: E[N_i] = n W_i. The variances of N_i differ.

==============  =================================================  ====================================
scheme          N_i                                                variance of N_i
==============  =================================================  ====================================
Multinomial     n independent draws                                n W_i (1 - W_i)
Residual        floor(n W_i), the rest by independent draws        f (1 - f / R), R = sum of all f
Stratified      one draw in each of n equal strata of [0, 1)       sum over strata of p (1 - p)
Systematic      one draw, shifted to each stratum                  f (1 - f)
Ssp             floor or ceil, fractions decided pair by pair      f (1 - f)
Killing         survive with w_i / max w, else multinomial         0 if all weights are equal, see below
LargestWeights  the n largest, without draws                       0
==============  =================================================  ====================================

For `Killing` with n = m particles and p = w / max w, the variance of N_i is
``p_i (1 - p_i) (1 - 2 W_i) + W_i^2 sum p (1 - p) + (m - sum p) W_i (1 - W_i)``.

What matters for an estimate is also how the copies of different particles vary together. So for particles in an
unlucky order `Systematic` can be worse than `Multinomial`, though not for sorted ones (`Sorted`).

>>> import numpy as np
>>> from mstfilter.smc import Systematic
>>> rng = np.random.default_rng(0)
>>> Systematic().select(rng, np.log([0.5, 0.25, 0.25]), 4)[0]
array([0, 0, 1, 2])

Weights need not sum to 1, may have any float type, and may be zero (log weight -inf). n may differ from the number of
weights. A particle of weight zero is never selected. The `select` method of your own `WeightResampler` can use
`inverse_cdf`, `independent_draws` and `draw_rows`.

References: Douc, Cappe, Moulines (2005), "Comparison of resampling schemes for particle filtering"; Kitagawa (1996);
Liu and Chen (1998).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.interfaces import WeightResampler


@dataclass(frozen=True)
class Multinomial(WeightResampler):
    """Independent draws by weight (Gordon, Salmond, Smith 1993). N_i has the largest variance of all schemes."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        return independent_draws(rng, checked_weights(log_weights, n), n), None


@dataclass(frozen=True)
class Stratified(WeightResampler):
    """Draws one uniform point in each of n equal strata of [0, 1) (Kitagawa 1996)."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        return inverse_cdf(checked_weights(log_weights, n), rng.random(n), n), None


@dataclass(frozen=True)
class Systematic(WeightResampler):
    """Makes floor or ceil of n W_i copies, by one uniform number (Carpenter, Clifford, Fearnhead 1999)."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        return inverse_cdf(checked_weights(log_weights, n), rng.random(1), n), None


def certain_copies(weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, int]:
    """floor(n W_i) (m,) int64, the fractions frac(n W_i) (m,), and their sum, the number of copies to draw."""
    fractions = weights * (n / weights.sum())
    floors = fractions * (1 + 1e-13)  # an integer up to rounding counts as that integer
    np.floor(floors, out=floors)
    fractions -= floors
    np.maximum(fractions, 0.0, out=fractions)
    copies = floors.astype(np.int64)
    return copies, fractions, n - int(copies.sum())


def systematic_copies(rng: np.random.Generator, expected: np.ndarray, n: int) -> np.ndarray:
    """(m,) numbers of copies: `expected`, scaled to sum n, rounded up or down by systematic draws."""
    copies, fractions, rest = certain_copies(expected, n)
    if rest > 0:
        copies += np.bincount(inverse_cdf(fractions, rng.random(1), rest), minlength=len(copies))
    return copies


@dataclass(frozen=True)
class Residual(WeightResampler):
    """Makes floor(n W_i) copies, and draws the rest independently by frac(n W_i) (Liu and Chen 1998)."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        copies, fractions, rest = certain_copies(checked_weights(log_weights, n), n)
        if rest > 0:
            copies += np.bincount(independent_draws(rng, fractions, rest), minlength=len(copies))
        return expanded(np.cumsum(copies), n), None


_SETTLED = 1e-12  # a fraction this close to 0 or 1 is 0 or 1 up to rounding


@dataclass(frozen=True)
class Ssp(WeightResampler):
    """Srinivasan sampling process: makes floor or ceil of n W_i copies; converges for any order of the particles.

    The fractions frac(n W_i) form pairs (a, b), with up = min(1 - a, b) and down = min(a, 1 - b). With probability
    down / (up + down), a increases and b decreases by `up`. Otherwise, a decreases and b increases by `down`. One of
    the fractions is then 0 or 1 and final; the other fraction is paired again. All pairs of a round are processed
    together, so m particles need log2(m) rounds, where the published loop takes m steps (Gerber, Chopin,
    Whiteley 2019, "Negative association, ordering and convergence of resampling methods").
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
    """One round of `Ssp`: adds final fractions to `copies` in place, and returns the remaining particles."""
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
    """(n,) particle at each position. A particle has floor(n / m) positions; n % m random ones have one more."""
    particles = np.arange(m) if n == m else np.tile(np.arange(m), n // m)
    if n % m:
        particles = np.concatenate([particles, np.sort(rng.choice(m, n % m, replace=False, shuffle=False))])
    return particles


@dataclass(frozen=True)
class Killing(WeightResampler):
    """A particle keeps its position with probability w_i / max w. Draws by weight fill the other positions.

    Most particles keep their positions if the weights are nearly equal. The reference for n = m is Del Moral (2004),
    "Feynman-Kac formulae", section 5.6. For n != m, each of the m particles has floor(n / m) of the n positions, or
    one more at random. The particle of each position is then kept or replaced. E[N_i] = n W_i for any n.
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
    """Selects the n particles of largest weight, with equal weights and without random draws.

    The scheme is not properly weighted.

    If several weights are equal, the first particle is selected (stable sort). If fewer than n particles have
    positive weight, these particles are repeated in turn.
    """

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        checked_weights(log_weights, n)
        # Sorted by log weight, because different weights may all underflow to zero.
        largest = np.argsort(-log_weights, kind="stable")[: np.isfinite(log_weights).sum()]
        return largest[np.arange(n) % len(largest)], None


# --- the inverse of the cumulative weights, for all schemes ---
_BLOCK = 1 << 13  # arrays of so many numbers stay in cache


def checked_weights(log_weights: np.ndarray, n: int) -> np.ndarray:
    """(m,) float64 weights with maximum 1, from log weights of any float type.

    Raises InputError if the log weights are not one-dimensional, contain NaN or +inf, or are all -inf, or if n < 1.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    if lw.ndim != 1 or len(lw) == 0:
        raise InputError(f"log weights have shape {lw.shape}, expected one number per particle")
    if not isinstance(n, (int, np.integer)) or n < 1:
        raise InputError(f"resampling to {n} particles, expected an integer of at least 1")
    top = np.maximum.reduce(lw)
    if not -np.inf < top < np.inf:
        at = int(np.flatnonzero(~np.isfinite(lw) & ~np.isneginf(lw))[0]) if not np.isneginf(top) else 0
        raise InputError(f"log weights cannot be resampled: entry {at} is {lw[at]}, the largest is {top}")
    weights = lw - top
    return np.exp(weights, out=weights)


def inverse_cdf(weights: np.ndarray, shifts: np.ndarray, n: int) -> np.ndarray:
    """(n,) ascending indices at which the cumulative weights (m,) reach the points (k + shift_k) / n, k = 0 .. n - 1.

    The shifts, in [0, 1), are (n,), or (1,) if all points have the same one.
    """
    ends = weights.cumsum()
    ends *= n / ends[-1]  # where the intervals of the particles end, in units of 1 / n
    if len(shifts) == 1:
        ends -= shifts[0]
    else:
        for begin in range(0, len(ends), _BLOCK):
            block = ends[begin : begin + _BLOCK]
            block -= shifts.take(block.astype(np.int64), mode="clip")  # the last end lies in stratum n
    np.ceil(ends, out=ends)  # the number of points below each end
    if ends[-1] != n:  # by rounding
        ends[ends == ends[-1]] = n
    return expanded(ends.astype(np.int64), n)


def expanded(ends: np.ndarray, n: int) -> np.ndarray:
    """(n,) indices. Index i fills the positions ends[i - 1] to ends[i] - 1."""
    counts = np.bincount(ends[:-1], minlength=n)[:n]
    return counts.cumsum(out=counts)


def draw_rows(weights: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
    """Draw one index for each row of weights (n, m), given uniforms (n,) in [0, 1)."""
    cumulative = np.cumsum(weights, axis=-1)
    total = cumulative[:, -1:]
    index = (cumulative <= uniforms[:, None] * total).sum(axis=1)  # "at" a point skips weights of zero
    return np.minimum(index, (cumulative < total).sum(axis=1))


def draw_log(rng: np.random.Generator, log_weights: np.ndarray) -> np.ndarray:
    """Draw one index for each row of log weights (n, m); InputError for a row without a finite maximum."""
    top = log_weights.max(axis=1, keepdims=True)
    if not np.isfinite(top).all():
        row = int(np.argmin(np.isfinite(top[:, 0])))
        raise InputError(f"the largest log weight of row {row} is {top[row, 0]}, so no index can be drawn")
    return draw_rows(np.exp(log_weights - top), rng.random(len(log_weights)))


def independent_draws(rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
    """(n,) indices, sorted, drawn independently by weights (m,)."""
    return search(weights, ordered_uniforms(rng, n), ascending=True)


def ordered_uniforms(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n,) ascending uniforms on [0, 1], in O(n) by normalised exponential spacings."""
    points = rng.standard_exponential(n + 1)
    points.cumsum(out=points)
    points /= points[-1]
    return points[:-1]


def search(weights: np.ndarray, points: np.ndarray, ascending: bool = False) -> np.ndarray:
    """(n,) index of the interval that contains each point. Interval i of [0, 1) has length weight i / total.

    A search for many points is faster if the points are `ascending`.
    """
    cumulative = weights.cumsum()
    find = _search_ascending if ascending else _search_any
    index = find(cumulative, points * cumulative[-1], side="right")  # "right" skips weights of zero
    # A point rounded up to the total belongs to the last particle of positive weight.
    return np.minimum(index, cumulative.searchsorted(cumulative[-1]), out=index)


def _search_any(edges: np.ndarray, points: np.ndarray, side: Literal["right"]) -> np.ndarray:
    """The result of `np.searchsorted`: half of the time or less for a thousand points and edges or more.

    The number of edges in lower bins than a point, from a table, is a lower bound of its index (Chen and Asau 1974).
    """
    n_bins = 2 * len(edges)
    if 2 * len(points) < n_bins or len(points) < 500:
        return np.searchsorted(edges, points, side)
    scale = n_bins / edges[-1]
    below = np.bincount(_bins(edges, scale, 0.0) + 1, minlength=n_bins + 2).cumsum()
    index = below.take(_bins(points, scale, 0.0))
    index += edges.take(index, mode="clip") <= points
    low = np.flatnonzero(edges.take(index, mode="clip") <= points)
    index[low] = np.searchsorted(edges, points.take(low), side)
    return index


def _search_ascending(edges: np.ndarray, points: np.ndarray, side: Literal["right"]) -> np.ndarray:
    """The result of `np.searchsorted` for ascending points: a quarter of the time for a million of each.

    The number of edges in lower bins than a point is a lower bound of its index. The bins, one for each edge and each
    point on average, are those of a block of points at a time, so that they stay in cache.
    """
    if len(points) < _BLOCK or 4 * len(points) < len(edges):
        return np.searchsorted(edges, points, side)
    index = np.empty(len(points), np.int64)
    scale = (len(edges) + len(points)) / edges[-1]
    begin, offset = 0, 0.0  # the first edge above the points of earlier blocks, and the bin of the last of them
    for start in range(0, len(points), 8 * _BLOCK):
        block, found = points[start : start + 8 * _BLOCK], index[start : start + 8 * _BLOCK]
        end = int(np.searchsorted(edges, block[-1], side))
        near = np.append(edges[begin:end], np.inf)
        bins = _bins(block, scale, offset)
        below = np.bincount(_bins(near[:-1], scale, offset), minlength=bins[-1] + 1)
        offset += float(bins[-1])
        below.cumsum(out=below)
        below[-1] = 0  # below bin 0, where the next line reads it
        bins -= 1
        below.take(bins, out=found, mode="wrap")
        found += near.take(found) <= block
        low = np.flatnonzero(near.take(found) <= block)
        found[low] = np.searchsorted(near, block[low], side)
        found += begin
        begin = end
    return index


def _bins(values: np.ndarray, scale: float, offset: float) -> np.ndarray:
    """The bin of each value. Bins have width 1 / scale and count from `offset`. int32 is faster than int64."""
    scaled = values * scale
    scaled -= offset
    return scaled.astype(np.int32)
