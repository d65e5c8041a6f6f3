"""Indices drawn by weight: the inverse of the cumulative weights, which all resampling schemes share.

- `inverse_cdf` takes one point in each of n equal strata: all of systematic and stratified resampling.
- `independent_draws` takes n independent points: multinomial resampling.
- `search` finds given points, and `draw_rows` takes one point for each row of a matrix of weights.

>>> import numpy as np
>>> inverse_cdf(np.array([0.5, 0.25, 0.25]), np.array([0.3]), 4)
array([0, 0, 1, 2])

Weights need not sum to 1. An index of weight zero is never drawn, also if a point falls on an end of its interval or
is rounded up to the total.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.errors import InputError

_BLOCK = 1 << 13  # arrays of so many numbers stay in cache


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


def weights_of_runs(log_weights: np.ndarray, n: int) -> np.ndarray:
    """`checked_weights` of a run; those of the runs of a batch, (R, m), are not checked."""
    if np.ndim(log_weights) != 2:
        return checked_weights(log_weights, n)
    weights = log_weights - log_weights.max(axis=1, keepdims=True)
    return np.exp(weights, out=weights)


def inverse_cdf(weights: np.ndarray, shifts: np.ndarray, n: int) -> np.ndarray:
    """(..., n) ascending indices at the points (k + shift_k) / n of the cumulative weights (..., m), k = 0 .. n - 1.

    The shifts, in [0, 1), are (..., n), or (..., 1) if all strata have the same.
    """
    ends = weights.cumsum(axis=-1)
    total = ends[..., -1:]
    last = ends == total
    ends *= n / total
    _subtract(ends, shifts)
    np.ceil(
        ends, out=ends
    )  # the number of points below each cumulative weight: greater than -1 before, so not negative
    ends[last] = n  # whatever the rounding
    return expanded(ends.astype(np.int64), n)


def _subtract(positions: np.ndarray, shifts: np.ndarray) -> None:
    """Subtract from each position (..., m) the shift of its stratum, in place."""
    if shifts.shape[-1] == 1:
        positions -= shifts
    elif positions.ndim == 2:
        for row, shift in zip(positions, shifts, strict=True):
            _subtract(row, shift)
    else:
        for begin in range(0, len(positions), _BLOCK):
            block = positions[begin : begin + _BLOCK]
            block -= shifts.take(block.astype(np.int64), mode="clip")  # the last position lies in stratum n


def expanded(ends: np.ndarray, n: int) -> np.ndarray:
    """(..., n) indices if i gets the places from ends[i - 1] to ends[i]: place k that of the number of ends <= k."""
    if ends.ndim == 1:
        counts = np.bincount(ends[:-1], minlength=n)[:n]
        return counts.cumsum(out=counts)
    rows, width = len(ends), n + 2  # rounding may give n + 1
    ends = ends[:, :-1] + width * np.arange(rows)[:, None]
    counts = np.bincount(ends.ravel(), minlength=rows * width).reshape(rows, width)
    return counts[:, :n].cumsum(axis=1)


def draw_rows(weights: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
    """(n,) indices, one for each row of (n, m) weights, by uniforms (n,) in [0, 1)."""
    cumulative = np.cumsum(weights, axis=-1)
    total = cumulative[:, -1:]
    index = (cumulative <= uniforms[:, None] * total).sum(axis=1)  # "at" a point skips weights of zero
    return np.minimum(index, (cumulative < total).sum(axis=1))


def independent_draws(rng: Any, weights: np.ndarray, n: int) -> np.ndarray:
    """(..., n) indices drawn independently by weights (..., m).

    Fewer than 2000 ascend. More are drawn in O(m + n), and ascend from one stratum of the weight to the next only.
    """
    if n < 2000:
        points = ordered_uniforms(rng, n, weights.shape[:-1])
        return search(weights, points) if weights.ndim == 1 else np.stack(list(map(search, weights, points)))
    if weights.ndim == 2:
        return np.stack([_draws_by_strata(g, w, n) for g, w in zip(rng.generators(), weights, strict=True)])
    return _draws_by_strata(rng, weights, n)


def ordered_uniforms(rng: np.random.Generator, n: int, rows: tuple[int, ...] = ()) -> np.ndarray:
    """``(*rows, n)`` uniforms on [0, 1], ascending in each row, in O(n): normalised exponential spacings."""
    points = rng.standard_exponential((*rows, n + 1))
    np.cumsum(points, axis=-1, out=points)
    points /= points[..., -1:]
    return points[..., :-1]


def search(weights: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) indices of the intervals of the cumulative weights (m,), scaled to [0, 1), that contain the points."""
    cumulative = weights.cumsum()
    index = cumulative.searchsorted(points * cumulative[-1], side="right")  # "right" skips weights of zero
    # A point rounded up to the total belongs to the last particle of positive weight.
    return np.minimum(index, cumulative.searchsorted(cumulative[-1]))


def _draws_by_strata(rng: np.random.Generator, weights: np.ndarray, n: int) -> np.ndarray:
    """(n,) indices of many points, distributed to strata of equal weight. Four times as fast as a search for 10^6.

    Inside a stratum, the number of cumulative weights in lower bins is a lower bound of the index of a point. It is
    increased where it is too small.
    """
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


def _fixed_point(weights: np.ndarray, total: int) -> np.ndarray:
    """(m,) int64 cumulative weights that end at `total`, at most 2^62.

    Integers are added exactly, and four times as fast as floats.
    """
    cumulative = np.empty(len(weights), np.int64)
    np.multiply(weights, total / weights.sum(), out=cumulative, casting="unsafe")
    np.cumsum(cumulative, out=cumulative)
    np.minimum(cumulative, total, out=cumulative)
    cumulative[cumulative.searchsorted(cumulative[-1]) :] = total  # ends at the last particle of positive weight
    return cumulative


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
