"""Recording quantities of a run, and comparing filters over many runs.

A collector is a function ``(state, info) -> number or array``, called after every step. `ess`, `unique_ancestors`,
`weight_entropy`, `log_evidence`, `mean`, `resampled`, `n_particles` and `selection_distance` are collectors.

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
workers or on other arms. Each worker limits the numerical libraries to one thread. With ``folder="runs"``, finished
runs are stored, and the same call continues after an interruption.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from mstfilter.errors import InputError, LostRunError, check_integer, naming
from mstfilter.files import atomic_path, check_output, folder_name
from mstfilter.lazy import progress_of
from mstfilter.processes import environment
from mstfilter.reading import read_arrays
from mstfilter.smc.batching import batch, batched_slots
from mstfilter.smc.checkpoint import digest
from mstfilter.smc.export import Table, flat_columns, library
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.interfaces import Info, State
from mstfilter.smc.population import Population, as_matrix, union
from mstfilter.smc.transport_resampling import ResamplerWrapper

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
    return _mean(state.population)


def _mean(population: Population) -> Any:
    if not isinstance(population.particles, np.ndarray):
        raise InputError(
            f"the mean of particles of type {type(population.particles).__name__} is not defined",
            "write a collector: lambda state, info: state.population.weights @ state.population.particles['x']",
        )
    return np.tensordot(population.weights, population.particles, axes=1)


def energy_distance(
    first: Population, second: Population, distance: Callable[[Any], np.ndarray] | None = None
) -> float:
    """Energy distance between two weighted populations (Szekely and Rizzo 2013), in the units of the distance.

    2 E d(X, Y) - E d(X, X') - E d(Y, Y') for draws X, X' of the first and Y, Y' of the second; the square of
    `scipy.stats.energy_distance` for numbers. It is 0 if both represent the same distribution, else positive.

    ``distance(particles)`` is (n, n), such as ``lambda p: 1 - Gaussian().matrix(p)``, and must be of negative type
    (`mstfilter.forecasts.is_negative_type`); otherwise the result can be 0 for different distributions.
    Default: Euclidean, for arrays and mappings of arrays.
    """
    both = union(first.realised().labelled({}), second.realised().labelled({}))
    return _energy(both.particles, np.concatenate([first.weights, -second.weights]), distance)


def _energy(particles: Any, masses: np.ndarray, distance: Callable[[Any], np.ndarray] | None) -> float:
    """- sum_ij m_i m_j d(x_i, x_j) of signed masses that sum to 0."""
    if distance is not None:
        d = np.asarray(distance(particles), dtype=np.float64)
        if d.shape != (len(masses),) * 2:
            raise InputError(f"distances have shape {d.shape}, expected {(len(masses),) * 2}")
        return max(0.0, -float(masses @ d @ masses))
    x = as_matrix(particles)
    if x.shape[1] == 1:  # 2 times the integral of the squared difference of the distribution functions
        order = np.argsort(x[:, 0])
        gaps, below = np.diff(x[order, 0]), np.cumsum(masses[order])[:-1]
        return 2.0 * float(gaps @ (below * below))
    from scipy.spatial.distance import cdist

    some = masses != 0
    x, masses = x[some], masses[some]
    rows = max(1, 4_000_000 // max(1, len(x)))
    parts = [masses[k : k + rows] @ (cdist(x[k : k + rows], x) @ masses) for k in range(0, len(x), rows)]
    return max(0.0, -float(sum(parts)))


@dataclass(frozen=True)
class Measured(ResamplerWrapper):
    """Measures the energy distance between the weighted particles before a selection and the particles after it.

    The selection itself does not change. ``notes["energy_distance"]`` is the distance, which `selection_distance`
    collects. Its mean over seeds is the squared error that the selection adds: for numbers, twice the integral over z
    of the variance of the share of particles below z. `distance` is as for `energy_distance`.
    """

    distance: Callable[[Any], np.ndarray] | None = None

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        chosen = self.scheme.resample(rng, population, n)
        ancestors = chosen.parents.get("ancestor")
        if ancestors is None or (ancestors < 0).any():
            found = energy_distance(population, chosen, self.distance)
        else:  # all are particles of the population, so the distances of that suffice
            masses = population.weights - np.bincount(ancestors, chosen.weights, len(population))
            found = _energy(population.realised().particles, masses, self.distance)
        return chosen.labelled(chosen.parents, {**chosen.notes, "energy_distance": found})


def selection_distance(state: State, info: Info) -> float:
    """The distance that `Measured` notes; 0 if the step did not resample, NaN if the resampler is not `Measured`."""
    if not info.resampled:
        return 0.0
    return float(info.notes.get("resampler", {}).get("energy_distance", np.nan))


@dataclass(frozen=True, eq=False)
class History(Mapping[str, np.ndarray], Table):
    """Collected arrays by name."""

    values_: Mapping[str, np.ndarray]  #: name -> array whose first axes are `dims`
    dims: tuple[str, ...] = ("time",)  #: ``("time",)`` for one run, ``("arm", "seed", "time")`` for many
    #: Labels along the axes.
    coords: Mapping[str, Any] = None  # type: ignore[assignment]
    state: State | None = None  #: the last state of a single run
    lost: Mapping[tuple[str, int], str] = field(default_factory=dict)  #: (arm, seed) -> reason, of runs that are lost

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.values_:
            raise KeyError(f"nothing was collected as {name!r}; there are: {', '.join(self.values_) or 'no arrays'}")
        return self.values_[name]

    def __iter__(self) -> Any:
        return iter(self.values_)

    def __len__(self) -> int:
        return len(self.values_)

    def __repr__(self) -> str:
        shape = next(iter(self.values_.values()), np.zeros(0)).shape
        sizes = ", ".join(f"{name} {size}" for name, size in zip(self.dims, shape, strict=False))
        lines = [f"History: {sizes}" + f", {len(self.lost)} runs lost" * bool(self.lost)]
        lines += [_summary(name, a) for name, a in self.values_.items()]
        return "\n  ".join(lines if len(lines) <= 5 else [*lines[:4], "also " + ", ".join(list(self.values_)[3:])])

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of `to_pandas`: the labels of the axes and the collected values, one row per step."""
        shape = next(iter(self.values_.values()), np.zeros(0)).shape[: len(self.dims)]
        labels = np.meshgrid(*(np.asarray(self.coords[name]) for name in self.dims), indexing="ij")
        named = dict(zip(self.dims, labels, strict=True))
        return flat_columns({**named, **self.values_}, axes=len(shape))

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with named dimensions; MissingLibraryError if xarray is not installed."""
        xarray = library("xarray")
        data = {
            name: ((*self.dims, *(f"{name}_{k}" for k in range(a.ndim - len(self.dims)))), a)
            for name, a in self.values_.items()
        }
        return xarray.Dataset(data, coords=dict(self.coords or {}))


def _summary(name: str, a: np.ndarray) -> str:
    """One line: name, shape and range of an array."""
    found = a[np.isfinite(a)] if a.dtype.kind in "fiu" else a[:0]
    return f"{name} {a.dtype} {a.shape}" + (f", {found.min():.4g} to {found.max():.4g}" if found.size else "")


def collect(steps: Iterable[tuple[State, Info]], /, **collectors: Collector) -> History:
    """Iterate over a run, ``filter.iterate(observations, seed)``, and keep the results of the collectors.

    Each collector is a function of (state, info), whose result has the same shape at every step.
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
    seeds: Iterable[int] = range(10),
    workers: int = 1,
    folder: str | Path | None = None,
    progress: bool | Callable[[int, int | None], None] = False,
    **collectors: Collector,
) -> History:
    """Run each filter with each seed.

    Parameters
    ----------
    arms : mapping
        Name -> filter. All filters get the same observations and seeds.
    workers : int
        Number of processes. 1 uses the calling process; more are started by joblib's loky, as new interpreters that
        get the filters by cloudpickle. InputError if a worker dies, with the arm and the seed.
    folder : path, optional
        Every finished run is stored there, as ``arm/seed.npz``; characters of an arm other than lower-case letters,
        digits, ``_`` and ``-`` are replaced by a hash. The same call runs only those that are missing. InputError if
        a stored run was made by another filter, other observations or other collectors, or if its file is damaged.
    progress : bool or callable
        True shows a progress bar; a function is called as ``progress(done, total)`` when runs finish.
    **collectors
        As for `collect`; default `log_evidence`. If they are `log_evidence`, `ess` and `mean` only, `batch` runs many
        seeds at once where the filter allows it.

    Returns
    -------
    History
        Arrays (arm, seed, time, ...). A run is lost if no particle explains an observation (`LostRunError`). From
        that step on, its log evidence is -inf and other results are NaN; `History.lost` has the reasons.
    """
    if not arms:
        raise InputError("there are no filters to run")
    check_integer("workers", workers)
    if workers > 1:
        _check_caller()
    if folder is not None:
        check_output(Path(folder), folder=True, empty=False)
    observations, collectors = list(observations), collectors or {"log_evidence": log_evidence}
    hashes = {} if folder is None else {arm: digest((arms[arm], observations, collectors)) for arm in arms}
    job = _Job(dict(arms), observations, collectors, folder, hashes)
    seeds = [int(seed) for seed in seeds]
    found = job.load_all(seeds)
    total, chunks = len(arms) * len(seeds), []
    for arm in arms:
        missing = [seed for seed in seeds if (arm, seed) not in found]
        size = 1 if job.batched(arm) is False else -(-len(missing) // (4 * workers if workers > 1 else 1)) or 1
        chunks += [(arm, missing[k : k + size]) for k in range(0, len(missing), size)]
    with progress_of(progress, "runs") as advance:
        for done in _finished_chunks(job, chunks, workers):
            found.update(done)
            advance(len(found), total)
    lost = {task: run.lost for task, run in found.items() if run.lost}
    shape = (len(arms), len(seeds), len(job.observations))
    values = {
        name: job.joined(name, [found[task] for task in product(arms, seeds)], shape) for name in job.collectors
    }
    coords = {"arm": list(arms), "seed": np.asarray(seeds), "time": np.arange(shape[2])}
    return History(values, ("arm", "seed", "time"), coords, lost=lost)


@dataclass(frozen=True)
class _Run:
    """Collected rows of a run by name, and why it was lost ("" if it was not)."""

    rows: dict[str, np.ndarray]
    lost: str = ""


@dataclass(frozen=True)
class _Job:
    """What `run_many` runs."""

    arms: dict[str, ParticleFilter]
    observations: list[Any]
    collectors: dict[str, Collector]
    folder: str | Path | None
    hashes: dict[str, str]  # of all that the runs of an arm depend on, apart from the seed

    def batched(self, arm: str) -> bool:
        """Whether many seeds of an arm run at once."""
        return set(self.collectors.values()) <= {log_evidence, ess, mean} and bool(batched_slots(self.arms[arm]))

    def run(self, arm: str, seeds: list[int]) -> dict[tuple[str, int], _Run]:
        """Run some seeds of an arm, and store the results."""
        found = {}
        with naming(f"arm {arm!r}, seed {seeds[0]}"):
            if self.batched(arm):
                means: dict[str, Any] = {"mean": _mean} if mean in self.collectors.values() else {}
                runs = batch(self.arms[arm], self.observations, seeds, **means)
                tables: dict[Collector, np.ndarray] = {log_evidence: runs.log_evidence, ess: runs.ess}
                tables[mean] = runs.values.get("mean", np.zeros((len(seeds), 0)))  # all runs lost at the first step
                for r, seed in enumerate(seeds):
                    rows = {name: tables[collector][r] for name, collector in self.collectors.items()}
                    found[arm, seed] = _Run(rows, runs.lost.get(r, ""))
            else:
                found = {(arm, seed): self.single(arm, seed) for seed in seeds}
        for (_, seed), run in found.items():
            self.save(arm, seed, run)
        return found

    def single(self, arm: str, seed: int) -> _Run:
        """One run, up to the step at which it is lost."""
        lost: list[str] = []
        steps = _until_lost(self.arms[arm].iterate(self.observations, seed), lost)
        return _Run(dict(collect(steps, **self.collectors)), "".join(lost))

    def joined(self, name: str, runs: list[_Run], shape: tuple[int, ...]) -> np.ndarray:
        """(arm, seed, time, ...) values of a collector."""
        rows = [run.rows[name] for run in runs]
        longest = max(rows, key=len)
        complete = all(len(row) == shape[2] for row in rows)
        empty = -np.inf if self.collectors[name] is log_evidence else np.nan
        kind = longest.dtype if complete else np.result_type(longest.dtype, np.float64)
        values = np.full((len(rows), shape[2], *longest.shape[1:]), 0 if complete else empty, kind)
        for value, row in zip(values, rows, strict=True):
            if len(row):
                value[: len(row)] = row
        return values.reshape(*shape, *values.shape[2:])

    def path(self, arm: str, seed: int) -> Path:
        return Path(self.folder or ".") / folder_name(arm) / f"{seed}.npz"

    def save(self, arm: str, seed: int, run: _Run) -> None:
        if self.folder is None:
            return
        path = self.path(arm, seed)
        arrays: dict[str, Any] = {f"rows/{name}": row for name, row in run.rows.items()}
        arrays["head"] = json.dumps({"made_by": self.hashes[arm], "seed": seed, "lost": run.lost})
        with atomic_path(path) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)

    def load(self, arm: str, seed: int) -> _Run | None:
        """A stored run; None if there is none. InputError if the file is damaged, or of another run."""
        path = self.path(arm, seed)
        if self.folder is None or not path.exists():
            return None
        arrays = read_arrays(path, "a stored run", _DAMAGED)
        try:
            head = json.loads(str(arrays.pop("head")))
            made_by, lost = (head["made_by"], head["seed"]), str(head["lost"])
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path} is not a stored run of run_many", _DAMAGED) from None
        if made_by != (self.hashes[arm], seed):
            raise InputError(
                f"run {path} was made by another filter or seed, other observations or other collectors",
                "choose another folder, or remove this one",
            )
        rows = {name.removeprefix("rows/"): row for name, row in arrays.items()}
        lengths, steps = {np.shape(row)[:1] for row in rows.values()}, len(self.observations)
        if set(rows) != set(self.collectors) or (not lost and lengths != {(steps,)}):
            raise InputError(f"stored run {path} is not complete", _DAMAGED)
        return _Run(rows, lost)

    def load_all(self, seeds: list[int]) -> dict[tuple[str, int], _Run]:
        """All stored runs. The error states how many cannot be used."""
        found, errors = {}, []
        for task in product(self.arms, seeds):
            try:
                run = self.load(*task)
            except InputError as error:
                errors.append(error)
            else:
                found.update({} if run is None else {task: run})
        if errors:
            more = f"; {len(errors)} stored runs cannot be used" if len(errors) > 1 else ""
            raise InputError(f"{errors[0].message}{more}", *errors[0].hints) from errors[0]
        return found


_DAMAGED = "remove the file and call run_many again: it runs what is missing, with the same result"


def _until_lost(steps: Iterable[tuple[State, Info]], lost: list[str]) -> Iterable[tuple[State, Info]]:
    """The steps of a run; if it is lost, the reason is appended."""
    try:
        yield from steps
    except LostRunError as error:
        lost.append(error.message)


_Chunk = tuple[str, list[int]]  # an arm and some seeds


def _finished_chunks(job: _Job, chunks: list[_Chunk], workers: int) -> Iterator[dict[tuple[str, int], _Run]]:
    """Results of chunks of runs in the order in which they finish.

    Workers are new processes: a fork of a process with threads can deadlock.
    """
    if workers == 1:
        yield from (job.run(*chunk) for chunk in chunks)
        return
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    left = {(arm, seed) for arm, seeds in chunks for seed in seeds}
    try:
        for done in _parallel(job, chunks, workers):
            left -= done.keys()
            yield done
    except TerminatedWorkerError:
        rest = [(arm, [seed for seed in seeds if (arm, seed) in left]) for arm, seeds in chunks]
        rest = [chunk for chunk in rest if chunk[1]]
        # Chunks begin in order, so the worker died in one of the first of those that are left.
        for arm, seeds in rest[:workers]:
            yield from (_alone(job, arm, seed) for seed in seeds)
        yield from _finished_chunks(job, rest[workers:], workers)


def _parallel(job: _Job, chunks: list[_Chunk], workers: int) -> Iterable[dict[tuple[str, int], _Run]]:
    from joblib import Parallel, delayed, parallel_config

    with environment(), parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
        parallel = Parallel(batch_size=1, return_as="generator_unordered")
        yield from parallel(delayed(_in_worker)(job, *chunk) for chunk in chunks)


def _alone(job: _Job, arm: str, seed: int) -> dict[tuple[str, int], _Run]:
    """Run once more, in a process that does nothing else, what may have ended a worker."""
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    try:
        return next(iter(_parallel(job, [(arm, [seed])], 2)))  # one task of two workers; n_jobs=1 starts no process
    except TerminatedWorkerError as error:
        code = re.search(r"exit codes of the workers are {(.*?)}", str(error))
        how = f" ({code[1]})" if code else ""
        raise InputError(
            f"arm {arm!r}, seed {seed}: the worker process died{how}",
            "if memory ran out: use fewer workers or fewer particles",
            "workers=1 runs in this process and shows a crash of compiled code",
        ) from None


def _check_caller() -> None:
    """Raise InputError if a module that is being imported calls `run_many` with workers.

    Workers import the modules of the functions that they get. So they would call `run_many` again, or wait for the
    import to end.
    """
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        name = frame.f_globals.get("__name__")
        spec = getattr(sys.modules.get(str(name)), "__spec__", None)
        if frame.f_code.co_name == "<module>" and (name == "__mp_main__" or getattr(spec, "_initializing", False)):
            raise InputError(
                f"{frame.f_code.co_filename}, line {frame.f_lineno}: run_many with workers is called in an import",
                'put the call below `if __name__ == "__main__":`, or into a function',
            )
        frame = frame.f_back


def _in_worker(job: _Job, arm: str, seeds: list[int]) -> dict[tuple[str, int], _Run]:
    """Run a chunk with one thread in libraries that ignore the environment variables."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    return job.run(arm, seeds)
