"""Collectors, which record quantities of a run at every step.

A run returns its last state, because all populations of a long run would not fit into memory. What is wanted of the
others is computed as they come: a collector is a function ``(state, info) -> number or array`` that is called after
every step.

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap, collect, ess, mean
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> steps = bootstrap(model, n=100).iterate([0.3, -0.1, 0.8], 0)
>>> history = collect(steps, ess=ess, mean=mean, largest=lambda state, info: state.population.weights.max())
>>> history["mean"].shape, sorted(history)
((3,), ['ess', 'largest', 'mean'])

`mstfilter.smc.run_many` takes the same collectors, and ``history.to_xarray()`` makes a labelled data set of the
arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, missing_library
from mstfilter.smc.interfaces import Info, State

Collector = Callable[[State, Info], Any]


def ess(state: State, info: Info) -> float:
    """Effective sample size of the particles after the update."""
    return info.ess


def unique_ancestors(state: State, info: Info) -> int:
    """Number of particles of the previous population that have descendants."""
    assert state.population is not None
    return state.population.unique_ancestors


def log_evidence(state: State, info: Info) -> float:
    """Log evidence of the observations so far; NaN if the filter reports no evidence."""
    found = state.log_evidence
    return np.nan if found is None else found


def resampled(state: State, info: Info) -> bool:
    """Whether the step resampled."""
    return info.resampled


def mean(state: State, info: Info) -> Any:
    """Weighted mean of array particles."""
    assert state.population is not None
    particles = state.population.particles
    if not isinstance(particles, np.ndarray):
        raise InputError(
            f"the mean of particles of type {type(particles).__name__} is not defined",
            "write a collector: lambda state, info: state.population.weights @ state.population.particles['x']",
        )
    return np.tensordot(state.population.weights, particles, axes=1)


@dataclass(frozen=True, eq=False)
class History(Mapping[str, np.ndarray]):
    """The results of the collectors as arrays, by name."""

    values_: Mapping[str, np.ndarray]  #: name -> array whose first axes are `dims`
    dims: tuple[str, ...] = ("time",)  #: ("time",) for one run, ("seed", "time") or ("arm", "seed", "time") for many
    coords: Mapping[str, Any] = field(default_factory=dict)  #: labels along the axes
    state: State | None = None  #: the last state of a single run
    #: Seed or (arm, seed) -> why the run ended early: all weights became zero.
    lost: Mapping[Any, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.values_:
            raise KeyError(f"nothing was collected as {name!r}; there are: {', '.join(self.values_) or 'no arrays'}")
        return self.values_[name]

    def __iter__(self) -> Any:
        return iter(self.values_)

    def __len__(self) -> int:
        return len(self.values_)

    @property
    def _shape(self) -> tuple[int, ...]:
        return next(iter(self.values_.values()), np.zeros(0)).shape[: len(self.dims)]

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name} {size}" for name, size in zip(self.dims, self._shape, strict=False))
        lines = [f"History: {sizes}" + f", {len(self.lost)} runs lost" * bool(self.lost)]
        lines += [_summary(name, a) for name, a in self.values_.items()]
        return "\n  ".join(lines if len(lines) <= 5 else [*lines[:4], "also " + ", ".join(list(self.values_)[3:])])

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of a table with one row per step of a run: the labels of the axes and the collected values."""
        labels = np.meshgrid(*(np.asarray(self.coords[name]) for name in self.dims), indexing="ij")
        named = dict(zip(self.dims, labels, strict=True))
        return flat_columns({**named, **self.values_}, axes=len(self._shape))

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with named dimensions; MissingLibraryError if xarray is not installed."""
        try:
            import xarray
        except ImportError as error:
            raise missing_library(error, "this export", library="xarray") from error
        data = {
            name: ((*self.dims, *(f"{name}_{k}" for k in range(a.ndim - len(self.dims)))), a)
            for name, a in self.values_.items()
        }
        return xarray.Dataset(data, coords=dict(self.coords))


def flat_columns(arrays: Mapping[str, Any], axes: int = 1) -> dict[str, np.ndarray]:
    """Table columns from arrays. The first `axes` axes index the rows; array x has columns ``x_0``, ``x_1``, ..."""
    columns = {}
    for name, a in arrays.items():
        a = np.asarray(a)
        for k in np.ndindex(a.shape[axes:]):
            columns["_".join([name, *map(str, k)])] = a[(..., *k)].reshape(-1)
    return columns


def _summary(name: str, a: np.ndarray) -> str:
    """Name, shape and range of an array, in one line."""
    found = a[np.isfinite(a)] if a.dtype.kind in "fiu" else a[:0]
    return f"{name} {a.dtype} {a.shape}" + (f", {found.min():.4g} to {found.max():.4g}" if found.size else "")


def collect(steps: Iterable[tuple[State, Info]], /, **collectors: Collector) -> History:
    """Run all steps of ``filter.iterate(observations, seed)`` and store the results of the collectors.

    Each collector is a function of (state, info). The result of a collector must have the same shape at every step.
    """
    check_collectors(collectors)
    rows: dict[str, list[Any]] = {name: [] for name in collectors}
    state, times = None, []
    for state, info in steps:
        times.append(info.t)
        for name, collector in collectors.items():
            rows[name].append(np.asarray(collector(state, info)))
    values = {name: stacked(name, row) for name, row in rows.items()}
    return History(values, ("time",), {"time": np.array(times, dtype=np.int64)}, state)


def check_collectors(collectors: Mapping[str, Any]) -> None:
    """Raise InputError if a collector is not a function. A misspelled parameter is taken for a collector."""
    for name, collector in collectors.items():
        if callable(collector):
            continue
        hints = ["a collector is a function (state, info) that is given by name, for example ess=ess or mean=mean"]
        if isinstance(collector, Iterable) and not isinstance(collector, (str, bytes)):
            named = [getattr(function, "__name__", "") for function in collector if callable(function)]
            hints = [f"give each collector by its name: {', '.join(f'{n}={n}' for n in named)}"] if named else hints
        elif isinstance(collector, Integral):
            hints.append(f"the number of runs is the number of seeds: seeds=range({collector})")
        raise InputError(f"{name} is {collector!r}, which is neither a parameter nor a collector", *hints)


def stacked(name: str, rows: list[np.ndarray]) -> np.ndarray:
    """The results of a collector at all steps, as one array."""
    check_one_shape(name, [row.shape for row in rows])
    return np.stack(rows) if rows else np.zeros(0)


def check_one_shape(name: str, shapes: list[tuple[int, ...]]) -> None:
    """Raise InputError if the results of a collector have different shapes."""
    if len(set(shapes)) > 1:
        raise InputError(
            f"collector {name!r} returned arrays of different shapes: {sorted(set(shapes))}",
            "reduce them to one shape, for example to a mean",
        )
