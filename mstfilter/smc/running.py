"""Many runs: several filters, seeds and data sets.

>>> runs = run_many(bootstrap(model, n=100), observations, seeds=range(200), ess=ess, log_evidence=log_evidence)
>>> runs["ess"].shape                                  # (seed, time)
(200, 50)
>>> run_many(bootstrap(model, n=100), data_sets, seeds=range(200), paired=True)        # run r gets data_sets[r]
>>> runs = run_many(
...     {"systematic": bootstrap(model, 100), "multinomial": bootstrap(model, 100, Multinomial())},
...     observations, seeds=range(20), workers=4)
>>> runs["log_evidence"].shape                         # (arm, seed, time)
(2, 20, 50)

Every run equals ``filter.run(observations, seed)`` bit for bit, for any number of workers and any other arms. The
runs of an arm are processed together, as arrays of the particles of all runs, if its components treat each particle
independently (see `mstfilter.smc.batching`). In other cases the runs are made one by one. Run k of every arm has the
same seed and so the same random streams. So differences between arms have less noise than those of independent runs.
"""

from __future__ import annotations

import json
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from mstfilter.errors import InputError, InputWarning, LostRunError, check_integer, naming
from mstfilter.files import atomic_path, check_output, folder_name
from mstfilter.lazy import progress_of
from mstfilter.processes import environment
from mstfilter.reading import read_arrays
from mstfilter.smc.batching import Collected, NotTogether, RunFilters, check_together, run_together
from mstfilter.smc.checkpoint import digest
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.history import Collector, History, check_one_shape, collect, log_evidence
from mstfilter.smc.inputs import check_observations
from mstfilter.smc.interfaces import Info, State


def run_many(
    filters: ParticleFilter | Mapping[str, ParticleFilter],
    observations: Iterable[Any],
    seeds: Iterable[int] = range(10),
    *,
    paired: bool = False,
    workers: int = 1,
    folder: str | Path | None = None,
    progress: bool | Callable[[int, int | None], None] = False,
    **collectors: Collector,
) -> History:
    """Run one filter, or each of several arms, with each seed.

    Parameters
    ----------
    filters : ParticleFilter or mapping
        A filter, or a mapping from names of arms to filters. All arms get the same observations and seeds.
    observations : iterable
        T observations, the same for all runs. None is a missing observation; use `WithInput` for an input.
    seeds : iterable of int
        Different non-negative integers.
    paired : bool
        If True, `observations` is a list of sequences of T observations, one for each seed. Components that are
        called with all runs get the observations of a step by row.
    workers : int
        Number of processes. With 1, the calling process is used. Other numbers start processes by joblib's loky. The
        processes are new interpreters that get the filters by cloudpickle and limit the numerical libraries to one
        thread. InputError if a worker dies, with the runs that may have caused it.
    folder : path, optional
        Every finished run is stored in this folder, as ``arm/seed.npz``. Characters of an arm other than lower-case
        letters, digits, ``_`` and ``-`` are replaced by a hash. The same call makes only the missing runs. InputError
        if a stored run was made with another filter, other observations or other collectors, or is damaged.
    progress : bool or callable
        True shows a progress bar. A function is called as ``progress(done, total)`` when runs finish.
    **collectors
        As for `collect`; default `log_evidence`.

    Returns
    -------
    History
        Arrays (arm, seed, time, ...), or (seed, time, ...) for a single filter. A run is lost if no particle explains
        an observation (`LostRunError`). From that step on, the log evidence of a lost run is -inf and the other
        results are NaN. `History.lost` has the reasons. `History.single` has the reasons for single runs.

    Warns
    -----
    InputWarning
        If the runs of an arm were made one by one because of a component that states ``batched=True``.
    """
    arms = dict(filters) if isinstance(filters, Mapping) else {_ALONE: filters}
    if not arms:
        raise InputError("there are no filters to run")
    check_integer("workers", workers)
    if workers > 1:
        _check_caller()
    collectors, seeds = collectors or {"log_evidence": log_evidence}, [int(seed) for seed in seeds]
    ys = _sequences(observations, paired)
    _check_seeds(seeds, ys, paired)
    job = _Job(arms, ys, seeds, collectors)
    if folder is not None:
        check_output(Path(folder), folder=True, empty=False)
        job = replace(job, folder=Path(folder), hashes=job.all_hashes())
    found = job.load_all()
    single: dict[str, str] = {}
    with progress_of(progress, "runs") as advance:
        for part in _finished(job, job.chunks(found, workers), workers):
            found.update(part.runs)
            single.update(part.single)
            advance(len(found), len(arms) * len(job.seeds))
    for arm, why in single.items():
        component = getattr(arms[arm], why.partition(":")[0], None)
        if getattr(component, "batched", None) is True:
            warnings.warn(InputWarning(f"the runs of {arm!r} are made one by one: {why}"), stacklevel=2)
    return job.history(found, single, isinstance(filters, Mapping))


_MOST_ROWS = 100_000  # particles of runs that are processed together; more are not faster
_ALONE = "filter"  # the arm of a single filter


def _sequences(observations: Iterable[Any], paired: bool) -> list[list[Any]]:
    """The sequences of observations: one for all runs, or one for each run."""
    given = enumerate(observations if paired else [observations])
    return [list(check_observations(ys, f"run {run}, " if paired else "")) for run, ys in given]


def _check_seeds(seeds: list[int], ys: list[list[Any]], paired: bool) -> None:
    """Raise InputError if seeds and sequences of observations do not fit."""
    if not seeds:
        raise InputError("there are no seeds")
    if len(set(seeds)) < len(seeds):
        raise InputError(f"a seed occurs twice in {seeds}", "every run has a seed of its own")
    if paired and len(ys) != len(seeds):
        raise InputError(f"there are {len(ys)} sequences of observations for {len(seeds)} seeds")
    lengths = sorted({len(sequence) for sequence in ys})
    if len(lengths) > 1:
        raise InputError(f"sequences of observations have lengths {lengths}, expected one length")


_Task = tuple[str, int]  # an arm and a seed
_Chunk = tuple[str, list[int]]  # an arm and some seeds


@dataclass(frozen=True)
class _Part:
    """Some finished runs, and the reason if they were made one by one."""

    runs: dict[_Task, Collected]
    single: dict[str, str]


@dataclass(frozen=True)
class _Job:
    """The task of `run_many`."""

    arms: dict[str, ParticleFilter]
    ys: list[list[Any]]
    seeds: list[int]
    collectors: dict[str, Collector]
    folder: Path | None = None
    hashes: dict[_Task, str] = field(default_factory=dict)  #: of what a stored run depends on

    def where(self, arm: str, seed: int | None = None) -> str:
        """Place for error messages; a single filter has no name."""
        return ", ".join([f"arm {arm!r}"] * (arm != _ALONE) + [f"seed {seed}"] * (seed is not None))

    def observations(self, seed: int) -> list[Any]:
        return self.ys[self.seeds.index(seed) % len(self.ys)]

    def chunks(self, found: Mapping[_Task, Collected], workers: int) -> list[_Chunk]:
        """Missing runs for one call of a worker. The runs contain many seeds if these can be processed together."""
        chunks = []
        for arm in self.arms:
            missing = [seed for seed in self.seeds if (arm, seed) not in found]
            share = -(-len(missing) // (4 * workers if workers > 1 else 1))
            size = max(1, min(share, _MOST_ROWS // self.arms[arm].n))
            try:
                check_together(self.arms[arm])
            except NotTogether:
                size = 1
            chunks += [(arm, missing[k : k + size]) for k in range(0, len(missing), size)]
        return chunks

    def run(self, arm: str, seeds: list[int]) -> _Part:
        """Make some runs of an arm, and store the results."""
        runs, why = self.made(arm, seeds)
        found = {(arm, seed): run for seed, run in zip(seeds, runs, strict=True)}
        for task, run in found.items():
            self.save(*task, run)
        return _Part(found, {arm: why} if why else {})

    def made(self, arm: str, seeds: list[int]) -> tuple[list[Collected], str]:
        """Some runs of an arm, and the reason if several runs were made one by one, or else ""."""
        filter, why = self.arms[arm], ""
        ys = self.ys if len(self.ys) == 1 else [self.observations(seed) for seed in seeds]
        try:
            check_together(filter)
            if len(seeds) > 1:
                same = RunFilters(lambda run: filter, lambda runs: filter)
                with naming(self.where(arm)):
                    return run_together(same, ys, seeds, self.collectors), ""
        except NotTogether as error:
            why = f"{error.slot}: {error.reason}"
        return [self.single(arm, seed) for seed in seeds], why

    def single(self, arm: str, seed: int) -> Collected:
        """One run, up to the step at which it is lost."""
        lost: list[str] = []
        with naming(self.where(arm, seed)):
            steps = _until_lost(self.arms[arm].iterate(self.observations(seed), seed), lost)
            return Collected(dict(collect(steps, **self.collectors)), "".join(lost))

    def history(self, found: Mapping[_Task, Collected], single: Mapping[str, str], has_arms: bool) -> History:
        """The results of all runs; without the axis of arms for a single filter."""
        sizes = {"arm": len(self.arms), "seed": len(self.seeds), "time": len(self.ys[0])}
        coords = {"arm": list(self.arms), "seed": np.asarray(self.seeds), "time": np.arange(sizes["time"])}
        runs = [found[task] for task in product(self.arms, self.seeds)]
        dims = tuple(sizes) if has_arms else ("seed", "time")
        values = {}
        for name in self.collectors:
            rows = self.joined(name, [run.rows[name] for run in runs], sizes["time"])
            values[name] = rows.reshape(*(sizes[dim] for dim in dims), *rows.shape[2:])
        lost = {task if has_arms else task[1]: found[task].lost for task in found if found[task].lost}
        return History(values, dims, {dim: coords[dim] for dim in dims}, lost=lost, single=dict(single))

    def joined(self, name: str, rows: list[np.ndarray], n_steps: int) -> np.ndarray:
        """(run, time, ...) values of a collector; -inf or NaN after a run is lost."""
        longest = max(rows, key=len)
        check_one_shape(name, [row.shape[1:] for row in rows if len(row)])
        complete = all(len(row) == n_steps for row in rows)
        empty = -np.inf if self.collectors[name] is log_evidence else np.nan
        kind = longest.dtype if complete else np.result_type(longest.dtype, np.float64)
        values = np.full((len(rows), n_steps, *longest.shape[1:]), 0 if complete else empty, kind)
        for value, row in zip(values, rows, strict=True):
            value[: len(row)] = row if len(row) else 0
        return values

    # --- stored runs ----------------------------------------------------------------------------------------------
    def all_hashes(self) -> dict[_Task, str]:
        """The hashes of all runs."""

        def of(arm: str, ys: list[Any]) -> str:
            return digest((self.arms[arm], ys, self.collectors))

        shared = {arm: of(arm, self.ys[0]) for arm in self.arms}
        return {
            (arm, seed): shared[arm] if len(self.ys) == 1 else of(arm, self.observations(seed))
            for arm, seed in product(self.arms, self.seeds)
        }

    def path(self, arm: str, seed: int) -> Path:
        assert self.folder is not None
        return self.folder / folder_name(arm) / f"{seed}.npz"

    def save(self, arm: str, seed: int, run: Collected) -> None:
        if self.folder is None:
            return
        arrays: dict[str, Any] = {f"rows/{name}": row for name, row in run.rows.items()}
        arrays["head"] = json.dumps({"made_by": self.hashes[arm, seed], "seed": seed, "lost": run.lost})
        with atomic_path(self.path(arm, seed)) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)

    def load(self, arm: str, seed: int) -> Collected | None:
        """A stored run; None if it does not exist. InputError if the file is damaged or belongs to another run."""
        if self.folder is None or not self.path(arm, seed).exists():
            return None
        path = self.path(arm, seed)
        arrays = read_arrays(path, "a stored run", _DAMAGED)
        try:
            head = json.loads(str(arrays.pop("head")))
            made_by, lost = (head["made_by"], head["seed"]), str(head["lost"])
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path} is not a stored run of run_many", _DAMAGED) from None
        if made_by != (self.hashes[arm, seed], seed):
            raise InputError(
                f"run {path} was made by another filter or seed, other observations or other collectors",
                "choose another folder, or remove this one",
            )
        rows = {name.removeprefix("rows/"): row for name, row in arrays.items()}
        lengths, steps = {np.shape(row)[:1] for row in rows.values()}, len(self.ys[0])
        if set(rows) != set(self.collectors) or (not lost and lengths != {(steps,)}):
            raise InputError(f"stored run {path} is not complete", _DAMAGED)
        return Collected(rows, lost)

    def load_all(self) -> dict[_Task, Collected]:
        """All stored runs. The error states how many cannot be used."""
        found, errors = {}, []
        for task in product(self.arms, self.seeds):
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
    """The steps of a run. If the run is lost, the reason is appended."""
    try:
        yield from steps
    except LostRunError as error:
        lost.append(error.message)


# --- processes ----------------------------------------------------------------------------------------------------
def _finished(job: _Job, chunks: list[_Chunk], workers: int) -> Iterator[_Part]:
    """Results of chunks of runs in the order in which they finish.

    Workers are new processes, since a fork of a process with threads can deadlock.
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
            for part in parallel(delayed(_in_worker)(job, *chunk) for chunk in chunks):
                left = [task for task in left if task not in part.runs]
                yield part
    except TerminatedWorkerError as error:
        code = re.search(r"exit codes of the workers are {(.*?)}", str(error))
        how = f" ({code[1]})" if code else ""
        # Chunks begin in order, so the worker died in one of the first of those that are left.
        begun = "; ".join(job.where(*task) for task in left[:workers])
        raise InputError(
            f"a worker process died{how}; the first runs that are not finished: {begun}",
            "if memory ran out: use fewer workers or fewer particles",
            "workers=1 runs in this process and shows a crash of compiled code",
            *(["the same call with the folder continues"] if job.folder else []),
        ) from None


def _check_caller() -> None:
    """Raise InputError if a module that is being imported calls `run_many` with workers.

    Workers import the modules of the functions that they get. So workers would call `run_many` again, or wait
    forever.
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


def _in_worker(job: _Job, arm: str, seeds: list[int]) -> _Part:
    """Run a chunk with one thread in libraries that ignore the environment variables."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    return job.run(arm, seeds)
