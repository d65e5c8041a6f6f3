"""Runs of one or several filters with many seeds.

A run is random, so a figure of one run says little: the error of a filter is that of its runs over seeds, and a
difference between two filters is best seen seed by seed, because both have the same data and the same streams:

>>> from mstfilter.smc import Multinomial, Normal, StateSpaceModel, bootstrap, ess, mean, run_many
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, observations = model.simulate(50, seed=1)
>>> runs = run_many(bootstrap(model, n=100), observations, seeds=range(200), ess=ess)
>>> runs["ess"].shape                                  # (seed, time)
(200, 50)
>>> arms = {"systematic": bootstrap(model, 100), "multinomial": bootstrap(model, 100, Multinomial())}
>>> runs = run_many(arms, observations, seeds=range(20), mean=mean)
>>> runs["mean"].shape                                 # (arm, seed, time)
(2, 20, 50)
>>> exact = bootstrap(model, n=100_000).run(observations)[0].population.mean()
>>> errors = (runs["mean"][:, :, -1] - exact) ** 2     # paired by seed

Runs of filters whose components process each particle alone, as those of all models do, are made in sweeps, as arrays
(see `mstfilter.smc.sweep`): independent runs with the law of single ones. With ``together=False``, or if a component
looks at several particles, run k equals ``filter.run(observations, seeds[k])`` bit for bit. Nothing depends on the
number of workers. `History.compare` tests the paired differences (`mstfilter.scoring.statistics`).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from itertools import islice, product
from numbers import Integral
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, LostRunError, check_component, check_integer, naming
from mstfilter.base.lazy import progress_of
from mstfilter.base.processes import environment
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.first_steps import unexamined
from mstfilter.smc.history import (
    Collector,
    History,
    check_collectors,
    check_one_shape,
    collect,
    levels_of,
    log_evidence,
)
from mstfilter.smc.inputs import check_observations
from mstfilter.smc.interfaces import Info, State
from mstfilter.smc.streams import Key
from mstfilter.smc.sweep import Collected, can_sweep, sweep_runs


def run_many(
    filters: ParticleFilter | Mapping[str, ParticleFilter],
    observations: Iterable[Any],
    seeds: Iterable[int] = range(10),
    *,
    workers: int = 1,
    together: bool = True,
    progress: bool | Callable[[int, int | None], None] = False,
    **collectors: Collector,
) -> History:
    """Run one filter, or each of several filters, with each seed.

    Parameters
    ----------
    filters : ParticleFilter or mapping
        A filter, or a mapping from names to filters. All filters get the same observations and seeds.
    observations : iterable
        T observations, the same for all runs. A missing observation is None. Use `WithInput` for an input.
    seeds : iterable of int
        Different non-negative integers, one for each run. ``seeds=range(100)`` makes 100 runs.
    workers : int
        Number of processes. With 1, all runs are made in the calling process. Otherwise joblib's loky starts workers,
        which get the filters by cloudpickle. If a worker dies, InputError names the runs that may have caused it.
    together : bool
        Whether runs are made in sweeps where possible. Otherwise each one is the single run with its seed.
    progress : bool or callable
        True shows a progress bar. A function is called as ``progress(done, total)`` whenever runs finish.
    **collectors
        Collectors by name, as in `collect`: ``mean=mean``. The default is `log_evidence`.

    Returns
    -------
    History
        Arrays (arm, seed, time, ...), or (seed, time, ...) for a single filter. Axis "arm" has one entry per filter.
        A run ends if all weights are zero (`LostRunError`). From this step on, the log evidence is -inf, and other
        results are NaN. `History.lost` gives the reason for each such run.
    """
    arms = _arms(filters)
    check_integer("workers", workers)
    check_collectors(collectors)
    job = _Job(
        arms,
        list(check_observations(observations)),
        _different_seeds(seeds),
        collectors or {"log_evidence": log_evidence},
        together,
    )
    found: dict[_Task, Collected] = {}
    with progress_of(progress, "runs") as advance:
        for runs in _finished(job, job.chunks(), workers):
            found.update(runs)
            advance(len(found), len(arms) * len(job.seeds))
    return job.history(found, isinstance(filters, Mapping))


def _arms(filters: Any) -> dict[str, ParticleFilter]:
    """The filters by name. Raises InputError if a filter is missing or is something else."""
    if isinstance(filters, ParticleFilter):
        return {_ALONE: filters}
    if not isinstance(filters, Mapping):
        hints = []
        if isinstance(filters, Sequence) and all(isinstance(filter, ParticleFilter) for filter in filters):
            hints = ['give each filter a name: {"small": bootstrap(model, 100), "large": bootstrap(model, 1000)}']
        raise InputError(
            f"filters are a {type(filters).__name__}, expected a ParticleFilter or a mapping from names to filters",
            *hints,
        )
    if not filters:
        raise InputError("there are no filters to run")
    for name, filter in filters.items():
        check_component(f"filter {name!r}", filter, ParticleFilter)
    return dict(filters)


def _different_seeds(seeds: Any) -> list[int]:
    """The seeds as a list. Raises InputError if they are not different non-negative integers."""
    if isinstance(seeds, Integral):
        raise InputError(
            f"seeds are {seeds}, expected one seed for each run",
            f"{seeds} runs: seeds=range({seeds})",
            f"one run with the seed {seeds}: seeds=[{seeds}]",
        )
    if isinstance(seeds, str) or not isinstance(seeds, Iterable):
        raise InputError(f"seeds are {seeds!r}, expected integers", "for example seeds=range(100)")
    found = list(seeds)
    for seed in found:
        check_integer("a seed", seed, "for example seeds=range(100)", at_least=0)
    if not found:
        raise InputError("there are no seeds")
    if len(set(found)) < len(found):
        raise InputError(f"a seed occurs twice in {found}", "every run has a seed of its own")
    return [int(seed) for seed in found]


_MOST_ROWS = 100_000  # particles of a sweep; more are not faster
_ALONE = "filter"  # the arm of a single filter


_Task = tuple[str, int]  # an arm and a seed
_Chunk = tuple[str, list[int]]  # an arm and some seeds


@dataclass(frozen=True)
class _Job:
    """The filters, observations, seeds and collectors of `run_many`."""

    arms: dict[str, ParticleFilter]
    ys: list[Any]
    seeds: list[int]
    collectors: dict[str, Collector]
    together: bool

    def where(self, arm: str, seed: int | None = None) -> str:
        """Name of the filter and seed for error messages. A single filter has no name."""
        return ", ".join([f"arm {arm!r}"] * (arm != _ALONE) + [f"seed {seed}"] * (seed is not None))

    def sweeps(self, arm: str) -> bool:
        """Whether the runs of a filter are made in sweeps."""
        return self.together and can_sweep(self.arms[arm])

    def chunks(self) -> list[_Chunk]:
        """Divide the runs into sweeps and single runs, whatever the number of workers."""
        chunks = []
        for arm, filter in self.arms.items():
            size = max(1, _MOST_ROWS // filter.n) if self.sweeps(arm) else 1
            chunks += [(arm, self.seeds[k : k + size]) for k in range(0, len(self.seeds), size)]
        return chunks

    def run(self, arm: str, seeds: list[int]) -> dict[_Task, Collected]:
        """Make the runs of a filter with some seeds. The model is examined once."""
        filter = self.arms[arm]
        if not self.sweeps(arm):
            with unexamined(seeds[0] != self.seeds[0]):
                return {(arm, seed): self.single(arm, seed) for seed in seeds}
        with naming(self.where(arm)):
            with suppress(LostRunError):
                list(islice(filter.iterate(self.ys, seeds[0]), 3))
            key = Key(seeds[0]).child("sweep", sha256(repr(seeds).encode()).hexdigest())
            runs = sweep_runs(filter, self.ys, seeds, key, self.collectors)
        return {(arm, seed): run for seed, run in zip(seeds, runs, strict=True)}

    def single(self, arm: str, seed: int) -> Collected:
        """One run, up to the step at which all weights are zero."""
        lost: list[str] = []
        with naming(self.where(arm, seed)):
            steps = _until_lost(self.arms[arm].iterate(self.ys, seed), lost)
            return Collected(dict(collect(steps, **self.collectors)), "".join(lost))

    def history(self, found: Mapping[_Task, Collected], has_arms: bool) -> History:
        """The results of all runs. The axis "arm" has an entry for each filter; it is absent for a single filter."""
        sizes = {"arm": len(self.arms), "seed": len(self.seeds), "time": len(self.ys)}
        coords = {"arm": list(self.arms), "seed": np.asarray(self.seeds), "time": np.arange(sizes["time"])}
        runs = [found[task] for task in product(self.arms, self.seeds)]
        dims = tuple(sizes) if has_arms else ("seed", "time")
        values = {}
        # A run that is lost at its first step does not know the variables of a collector that returns mappings.
        known = max((run.rows for run in runs), key=lambda rows: max(map(len, rows.values()), default=0))
        for name, some in known.items():
            rows = self.joined(name, [run.rows.get(name, some[:0]) for run in runs], sizes["time"])
            values[name] = rows.reshape(*(sizes[dim] for dim in dims), *rows.shape[2:])
        lost = {task if has_arms else task[1]: found[task].lost for task in found if found[task].lost}
        levels = levels_of(self.collectors, values)
        return History(values, dims, {dim: coords[dim] for dim in dims}, lost=lost, levels=levels)

    def joined(self, name: str, rows: list[np.ndarray], n_steps: int) -> np.ndarray:
        """Values (run, time, ...) of a collector; -inf or NaN after all weights of a run became zero."""
        longest = max(rows, key=len)
        check_one_shape(name, [row.shape[1:] for row in rows if len(row)])
        complete = all(len(row) == n_steps for row in rows)
        empty = -np.inf if self.collectors.get(name) is log_evidence else np.nan
        kinds = {row.dtype for row in rows if len(row)} or {longest.dtype}
        kind = np.result_type(*kinds, *([] if complete else [np.float64]))
        values = np.full((len(rows), n_steps, *longest.shape[1:]), 0 if complete else empty, kind)
        for value, row in zip(values, rows, strict=True):
            value[: len(row)] = row if len(row) else 0
        return values


def _until_lost(steps: Iterable[tuple[State, Info]], lost: list[str]) -> Iterable[tuple[State, Info]]:
    """The steps of a run. If all weights become zero, the steps end and the reason is appended to `lost`."""
    try:
        yield from steps
    except LostRunError as error:
        lost.append(error.message)


# --- processes ----------------------------------------------------------------------------------------------------
def _finished(job: _Job, chunks: list[_Chunk], workers: int) -> Iterator[dict[_Task, Collected]]:
    """Results of chunks of runs, in the order in which the chunks finish.

    Workers are new processes and not forks, because a fork of a process with threads can deadlock.
    """
    if workers == 1:
        yield from (job.run(*chunk) for chunk in chunks)
        return
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    left = [(arm, seed) for arm, seeds in chunks for seed in seeds]
    try:
        with environment(), parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
            parallel = Parallel(batch_size=1, return_as="generator_unordered")
            for runs in parallel(delayed(_in_worker)(job, *chunk) for chunk in chunks):
                left = [task for task in left if task not in runs]
                yield runs
    except TerminatedWorkerError as error:
        code = re.search(r"exit codes of the workers are {(.*?)}", str(error))
        how = f" ({code[1]})" if code else ""
        # Chunks begin in order, so the worker died in one of the first of those that are left.
        begun = "; ".join(job.where(*task) for task in left[:workers])
        raise InputError(
            f"a worker process died{how}; the first runs that are not finished: {begun}",
            "if memory ran out: use fewer workers or fewer particles",
            "workers=1 runs in this process and shows a crash of compiled code",
        ) from None


def _in_worker(job: _Job, arm: str, seeds: list[int]) -> dict[_Task, Collected]:
    """Make the runs of a chunk, with one thread in libraries that ignore the environment variables."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    return job.run(arm, seeds)
