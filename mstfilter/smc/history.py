"""Collectors, which record quantities of a run at every step.

A run returns its last state, because all populations of a long run would not fit into memory. What is wanted of the
others is computed as they come: a collector is a function ``(state, info) -> number or array`` that is called after
every step.

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap, collect, ess, quantiles
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, ys = model.simulate(50, seed=1)
>>> steps = bootstrap(model, n=100).iterate(ys)
>>> history = collect(steps, ess=ess, x=quantiles(), largest=lambda state, info: state.population.weights.max())
>>> history["x"].shape, sorted(history)
((50, 3), ['ess', 'largest', 'x'])
>>> figure = history.plot(band=0.9, x=states)                    # the band of x and the true states

`mstfilter.smc.run_many` takes the same collectors; then ``runs.plot()`` shows the spread over seeds, and
``runs.compare(...)`` says which filter has the smaller errors. ``history.to_pandas()`` makes a table, and
``history.to_xarray()`` a labelled data set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.lazy import late
from mstfilter.smc.interfaces import Info, State
from mstfilter.smc.population import Population
from mstfilter.smc.summaries import check_levels, data_frame, drawn_by_weight, flat_columns, imported, inference_data

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
    """Weighted mean of the particles (see `Population.mean`)."""
    return _population(state).mean()


def variance(state: State, info: Info) -> Any:
    """Weighted variances of the entries of the particles."""
    return _population(state).variance()


def covariance(state: State, info: Info) -> np.ndarray:
    """Weighted covariance (d, d) of the d entries of a particle."""
    return _population(state).covariance()


def circular_mean(state: State, info: Info) -> Any:
    """Weighted mean of particles that are angles in radians."""
    return _population(state).circular_mean()


def particles(state: State, info: Info) -> Any:
    """All particles, which needs much memory; for `History.to_arviz`."""
    return _population(state).particles


def weights(state: State, info: Info) -> np.ndarray:
    """(n,) weights of the particles, which sum to one."""
    return _population(state).weights


@dataclass(frozen=True)
class Quantiles:
    """The collector that `quantiles` makes."""

    levels: tuple[float, ...]
    function: Callable[[Any], Any] | None = None

    def __call__(self, state: State, info: Info) -> Any:
        return _population(state).quantiles(self.levels, self.function)


def quantiles(*levels: float, function: Callable[[Any], Any] | None = None) -> Quantiles:
    """A collector of weighted quantiles (levels, ...) of the particles, or of ``function(particles)``.

    The default levels are .05, .5 and .95: a band of 90 % and the median.
    """
    return Quantiles(check_levels(levels or (0.05, 0.5, 0.95)), function)


def _population(state: State) -> Population:
    assert state.population is not None
    return state.population


@dataclass(frozen=True, eq=False)
class History(Mapping[str, np.ndarray]):
    """The results of the collectors as arrays, by name."""

    values_: Mapping[str, np.ndarray]  #: name -> array whose first axes are `dims`
    dims: tuple[str, ...] = ("time",)  #: ("time",) for one run, ("seed", "time") or ("arm", "seed", "time") for many
    coords: Mapping[str, Any] = field(default_factory=dict)  #: labels along the axes
    state: State | None = None  #: the last state of a single run
    #: Seed or (arm, seed) -> why the run ended early: all weights became zero.
    lost: Mapping[Any, str] = field(default_factory=dict)
    #: Name -> levels of collected quantiles, along the first axis after `dims`.
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

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

    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame`` of `columns`; MissingLibraryError if pandas is not installed."""
        return data_frame(self.columns())

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with named dimensions; MissingLibraryError if xarray is not installed."""
        xarray, data, coords = imported("xarray"), {}, dict(self.coords)
        for name, a in self.values_.items():
            axes = [f"{name}_{k}" for k in range(a.ndim - len(self.dims))]
            if name in self.levels:
                axes[0] = f"{name}_level"
                coords[axes[0]] = list(self.levels[name])
            data[name] = ((*self.dims, *axes), a)
        return xarray.Dataset(data, coords=coords)

    def to_arviz(self, weights: str = "weights", resample: bool = True) -> Any:
        """The particles of all steps of one run as draws for ArviZ, with the dimension "time" after chain and draw.

        `weights` names the collected `weights`. What was collected for as many particles is exported. At each time,
        draws are particles selected by weight, because ArviZ's statistics do not use weights; so the draws at two
        times are no path. With ``resample=False`` they are the particles as they are. ``sample_stats`` holds the
        weight that each draw has.

        >>> history = collect(filter.iterate(observations), x=particles, weights=weights)    # doctest: +SKIP
        >>> arviz.plot_forest(history.to_arviz())                                             # doctest: +SKIP
        """
        if weights not in self.values_ or self.dims != ("time",):
            raise InputError(
                f"this history has no {weights!r} of one run",
                "collect(filter.iterate(observations), x=particles, weights=weights)",
            )
        w = self.values_[weights]
        step = np.arange(len(w))[:, None]
        rows = np.stack([drawn_by_weight(row) if resample else np.arange(len(row)) for row in w])
        posterior = {
            name: np.moveaxis(a[step, rows], 0, 1)[None]
            for name, a in self.values_.items()
            if name != weights and a.shape[:2] == w.shape and name not in self.levels
        }
        kept = np.full(w.shape, 1 / w.shape[1]) if resample else w
        dims = {name: ["time", *(f"{name}_{k}" for k in range(a.ndim - 3))] for name, a in posterior.items()}
        axes = {"dims": {**dims, "weight": ["time"]}, "coords": {"time": self.coords["time"]}}
        return inference_data(posterior, {"weight": kept.T[None]}, **axes)

    plot = late("mstfilter.app.report.charts:plot_history", "Collected quantities over time, with bands.")
    compare = late("mstfilter.scoring.statistics:compare_runs", "Which filter has the smaller errors.")


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
            rows[name].append(collector(state, info))
    values = {key: stacked(key, row) for name in rows for key, row in by_key(name, rows[name]).items()}
    time = {"time": np.array(times, dtype=np.int64)}
    return History(values, ("time",), time, state, levels=levels_of(collectors, values))


def by_key(name: str, rows: list[Any]) -> dict[str, list[np.ndarray]]:
    """Results of a collector as arrays. Those that are mappings, as of a program, give arrays ``name_variable``."""
    if rows and isinstance(rows[0], Mapping):
        return {f"{name}_{key}": [np.asarray(row[key]) for row in rows] for key in rows[0]}
    return {name: [np.asarray(row) for row in rows]}


def levels_of(collectors: Mapping[str, Collector], names: Iterable[str]) -> dict[str, tuple[float, ...]]:
    """Levels of the collected quantiles by the name of the array."""
    made = {name: collector.levels for name, collector in collectors.items() if isinstance(collector, Quantiles)}
    return {
        key: levels for key in names for name, levels in made.items() if key == name or key.startswith(f"{name}_")
    }


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
