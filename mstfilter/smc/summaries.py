"""Summaries of weighted particles: moments, quantiles, and means of angles.

They are methods of a population, and collectors of the same names record them at every step of a run
(`mstfilter.smc.history`):

>>> import numpy as np
>>> from mstfilter.smc import Population
>>> x, heading = np.array([0.0, 1.0, 4.0]), np.array([3.0, -3.0, -3.2])
>>> population = Population({"x": x, "heading": heading}, np.log([1, 2, 1]))
>>> population.mean()["x"], population.variance()["x"]
(array(1.5), array(2.25))
>>> population.quantiles([0.25, 0.5, 0.75])["x"]                       # one row for each level
array([0., 1., 1.])
>>> round(float(population.circular_mean()["heading"]), 3)             # and not -1.55, the mean of the numbers
-3.121

With weights W_i that sum to one, the mean is sum_i W_i x_i and the variance sum_i W_i (x_i - mean)^2, entry by entry.
The quantile of level p is the smallest particle such that it and all smaller ones have at least the weight p, so it
needs no assumption about what lies between the particles. The mean of angles is the direction of the mean of the
points (cos x, sin x) on the circle (Mardia and Jupp 2000, section 2.2).

A function of the particles says what is summarised if it is not the particles themselves:
``population.mean(lambda p: p["x"] ** 2)``. Particles that are objects need one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError


def by_variable(summary: Callable[..., Any], values: Any, *arguments: Any) -> Any:
    """The summary of an array (n, ...), or of each array of a mapping. Raises InputError for objects."""
    if isinstance(values, Mapping):
        return {name: by_variable(summary, a, *arguments) for name, a in values.items()}
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub":
        raise InputError(
            f"particles of type {type(values).__name__} have no moments or quantiles",
            "give a function from the particles to an array (n, ...): population.mean(lambda particles: ...)",
            "in a collector: mean=lambda state, info: state.population.mean(lambda particles: ...)",
        )
    return np.asarray(summary(values, *arguments))


def weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(...) mean of values (n, ...)."""
    return np.tensordot(weights, values, axes=1)


def weighted_variance(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(...) variances of the entries of values (n, ...)."""
    return np.tensordot(weights, np.square(values - weighted_mean(values, weights)), axes=1)


def weighted_covariance(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(d, d) covariance of rows (n, d)."""
    centred = columns - weighted_mean(columns, weights)
    return (weights * centred.T) @ centred


def weighted_quantiles(values: np.ndarray, weights: np.ndarray, levels: Sequence[float]) -> np.ndarray:
    """(levels, ...) quantiles of the entries of values (n, ...): the inverse of their distribution function."""
    order = np.argsort(values, axis=0)
    below = np.cumsum(weights[order], axis=0)
    total = below[-1]
    # Sums of weights have an error of rounding. A level of 0 is the smallest particle of positive weight.
    ranks = [(below < np.maximum(level - 1e-12, 1e-300) * total).sum(axis=0) for level in levels]
    return np.take_along_axis(np.take_along_axis(values, order, 0), np.stack(ranks), 0)


def weighted_circular_mean(values: np.ndarray, weights: np.ndarray, period: float) -> np.ndarray:
    """(...) mean directions of angles (n, ...), from -period / 2 to period / 2."""
    turn = 2j * np.pi / period
    return np.angle(np.tensordot(weights, np.exp(turn * values), axes=1)) * (period / (2 * np.pi))


def check_levels(levels: Any) -> tuple[float, ...]:
    """Levels of quantiles, one number or several. Raises InputError unless each is a probability."""
    found = tuple(float(level) for level in np.ravel(levels))
    if not found or not all(0 <= level <= 1 for level in found):
        raise InputError(f"levels of quantiles are {levels!r}, expected probabilities such as 0.05, 0.5, 0.95")
    return found


def flat_columns(arrays: Mapping[str, Any], axes: int = 1) -> dict[str, np.ndarray]:
    """Table columns from arrays. The first `axes` axes index the rows; array x has columns ``x_0``, ``x_1``, ..."""
    columns = {}
    for name, a in arrays.items():
        a = np.asarray(a)
        for k in np.ndindex(a.shape[axes:]):
            columns["_".join([name, *map(str, k)])] = a[(..., *k)].reshape(-1)
    return columns


def data_frame(columns: Mapping[str, np.ndarray]) -> Any:
    """A ``pandas.DataFrame``; MissingLibraryError if pandas is not installed."""
    return imported("pandas").DataFrame(dict(columns))


def inference_data(posterior: Mapping[str, np.ndarray], stats: Mapping[str, np.ndarray], **axes: Any) -> Any:
    """ArviZ's container of arrays (chain, draw, ...); MissingLibraryError if ArviZ is not installed.

    `axes` are the arguments `coords` and `dims` of ``arviz.from_dict``. ArviZ takes the groups by keyword up to
    version 0.x, and as a mapping since 1.0.
    """
    arviz, groups = imported("arviz"), {"posterior": dict(posterior), "sample_stats": dict(stats)}
    return arviz.from_dict(groups, **axes) if arviz.__version__[0] != "0" else arviz.from_dict(**groups, **axes)


def imported(library: str) -> Any:
    """A library of the user's for exports."""
    from importlib import import_module

    from mstfilter.base.errors import missing_library

    try:
        return import_module(library)
    except ImportError as error:
        raise missing_library(error, "this export", library=library) from error


def drawn_by_weight(weights: np.ndarray) -> np.ndarray:
    """(n,) ascending indices that occur floor or ceil of n W_i times: systematic resampling without noise."""
    points = (np.arange(len(weights)) + 0.5) / len(weights)
    return np.minimum(np.searchsorted(np.cumsum(weights), points), len(weights) - 1)
