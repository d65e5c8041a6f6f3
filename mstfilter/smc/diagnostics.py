"""Recording quantities of a run, and comparing filters over many runs.

A collector is a function ``(state, info) -> number or array``, called after every step. `ess`, `unique_ancestors`,
`weight_entropy`, `log_evidence`, `mean`, `resampled` and `n_particles` are collectors.

>>> history = collect(filter.iterate(observations, 0), ess=ess, mean=mean)
>>> history["ess"]                                   # (T,)
>>> history.to_xarray()                              # needs xarray

`run_many` runs several filters (arms) with several seeds, in parallel:

>>> runs = run_many(
...     {"systematic": bootstrap(model, 100), "multinomial": bootstrap(model, 100, Multinomial())},
...     observations, seeds=range(20), workers=4, ess=ess, log_evidence=log_evidence)
>>> runs["log_evidence"].shape                         # (arm, seed, time)
(2, 20, 50)

Run k of every arm has the same seed and so the same random streams, which makes differences between arms less noisy
than those of independent runs. A run depends on its filter, its seed and the observations only, not on the number of
workers or on other arms. Each worker limits the numerical libraries to one thread.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError, MissingLibraryError
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.interfaces import Info, State

Collector = Callable[[State, Info], Any]


def ess(state: State, info: Info) -> float:
    """Effective sample size after the update."""
    return info.ess


def unique_ancestors(state: State, info: Info) -> int:
    """Number of particles of the previous population that have descendants."""
    return info.unique_ancestors


def weight_entropy(state: State, info: Info) -> float:
    """Entropy of the normalised weights in nats: log n if they are equal, 0 if one particle has all weight."""
    assert state.population is not None
    w = state.population.weights
    w = w[w > 0]
    return float(-(w @ np.log(w)))


def log_evidence(state: State, info: Info) -> float:
    """Log evidence so far; NaN if the filter does not report it."""
    found = state.log_evidence
    return np.nan if found is None else found


def resampled(state: State, info: Info) -> bool:
    """Whether the step resampled."""
    return info.resampled


def n_particles(state: State, info: Info) -> int:
    """Particles after the step."""
    return info.n


def mean(state: State, info: Info) -> Any:
    """Weighted mean of array particles."""
    assert state.population is not None
    if not isinstance(state.population.particles, np.ndarray):
        raise InputError(
            f"the mean of particles of type {type(state.population.particles).__name__} is not defined",
            "write a collector: lambda state, info: state.population.weights @ state.population.particles['x']",
        )
    return np.tensordot(state.population.weights, state.population.particles, axes=1)


@dataclass(frozen=True, eq=False)
class History(Mapping[str, np.ndarray]):
    """Collected arrays by name.

    Parameters
    ----------
    values_ : mapping
        Name -> array whose first axes are `dims`.
    dims : tuple of str
        ``("time",)`` for one run, ``("arm", "seed", "time")`` for many.
    coords : mapping
        Labels along the axes.
    state : State or None
        The last state of a single run.
    """

    values_: Mapping[str, np.ndarray]
    dims: tuple[str, ...] = ("time",)
    coords: Mapping[str, Any] = None  # type: ignore[assignment]
    state: State | None = None

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.values_:
            raise KeyError(f"nothing was collected as {name!r}; there are: {', '.join(self.values_) or 'no arrays'}")
        return self.values_[name]

    def __iter__(self) -> Any:
        return iter(self.values_)

    def __len__(self) -> int:
        return len(self.values_)

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with named dimensions; MissingLibraryError if xarray is not installed."""
        try:
            import xarray
        except ImportError:
            raise MissingLibraryError(
                "to_xarray needs the library xarray, which is not installed", "pip install 'mstfilter[xarray]'"
            ) from None
        data = {
            name: ((*self.dims, *(f"{name}_{k}" for k in range(a.ndim - len(self.dims)))), a)
            for name, a in self.values_.items()
        }
        return xarray.Dataset(data, coords=dict(self.coords or {}))


def collect(steps: Iterable[tuple[State, Info]], /, **collectors: Collector) -> History:
    """Iterate over a run and keep the results of the collectors.

    Parameters
    ----------
    steps : iterable of (State, Info)
        ``filter.iterate(observations, seed)``.
    **collectors
        Name -> function of (state, info); its result has the same shape at every step.
    """
    rows: dict[str, list[Any]] = {name: [] for name in collectors}
    state, times = None, []
    for state, info in steps:
        times.append(info.t)
        for name, collector in collectors.items():
            rows[name].append(np.asarray(collector(state, info)))
    values = {name: _stack(name, row) for name, row in rows.items()}
    return History(values, ("time",), {"time": np.array(times, dtype=np.int64)}, state)


def _stack(name: str, rows: list[np.ndarray]) -> np.ndarray:
    shapes = {row.shape for row in rows}
    if len(shapes) > 1:
        raise InputError(
            f"collector {name!r} returned arrays of different shapes: {sorted(shapes)}",
            "reduce them to one shape, for example to a mean",
        )
    return np.stack(rows) if rows else np.zeros(0)


def run_many(
    arms: Mapping[str, ParticleFilter],
    observations: Iterable[Any],
    seeds: Sequence[int] = range(10),
    workers: int = 1,
    **collectors: Collector,
) -> History:
    """Run each filter with each seed.

    Parameters
    ----------
    arms : mapping
        Name -> filter.
    observations : iterable
        The same for all filters.
    seeds : sequence of int
        One per run; the same for all filters.
    workers : int
        Number of processes; 1 uses the calling process.
    **collectors
        As for `collect`; default `log_evidence`.

    Returns
    -------
    History
        Arrays (arm, seed, time, ...).
    """
    if not arms:
        raise InputError("there are no filters to run")
    if workers < 1:
        raise InputError(f"workers is {workers}, expected at least 1")
    wanted = collectors or {"log_evidence": log_evidence}
    job = {"arms": dict(arms), "observations": list(observations), "collectors": wanted}
    tasks = [(name, int(seed)) for name in arms for seed in seeds]
    if workers == 1:
        results = [_one(job, *task) for task in tasks]
    else:
        results = _in_pool(job, tasks, workers)
    shape = (len(arms), len(seeds))
    values = {}
    for name in wanted:
        stacked = np.stack([r[name] for r in results])
        values[name] = stacked.reshape(*shape, *stacked.shape[1:])
    coords = {"arm": list(arms), "seed": np.asarray(list(seeds)), "time": np.arange(len(job["observations"]))}
    return History(values, ("arm", "seed", "time"), coords)


def _one(job: Mapping[str, Any], arm: str, seed: int) -> dict[str, np.ndarray]:
    try:
        history = collect(job["arms"][arm].iterate(job["observations"], seed), **job["collectors"])
    except InputError as error:
        raise InputError(f"arm {arm!r}, seed {seed}: {error.message}", *error.hints) from error
    return dict(history)


def _in_pool(job: dict[str, Any], tasks: list[tuple[str, int]], workers: int) -> list[dict[str, np.ndarray]]:
    """Results in order, from new processes: a fork of a process with threads can deadlock.

    The job is sent once per batch, by cloudpickle, so closures and classes of a notebook can be sent.
    """
    from joblib import Parallel, delayed, parallel_config

    batches = [tasks[k :: 4 * workers] for k in range(min(4 * workers, len(tasks)))]
    with parallel_config("loky", n_jobs=min(workers, len(batches)), inner_max_num_threads=1):
        done = Parallel(batch_size=1)(delayed(_batch)(job, batch) for batch in batches)
    found = dict(pair for results in done for pair in results)
    return [found[task] for task in tasks]


def _batch(job: dict[str, Any], tasks: list[tuple[str, int]]) -> list[tuple[tuple[str, int], dict[str, np.ndarray]]]:
    """Run a batch in a worker, with one thread in libraries that ignore the environment variables."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    return [(task, _one(job, *task)) for task in tasks]
