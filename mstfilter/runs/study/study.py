"""Runs a study: `run_study` checks the study and the folder, makes every missing run, and writes the tables.

>>> result = run_study(load_study("study.toml"), Path("studies/first"), workers=2)
>>> result.done, result.failed

The same call resumes an interrupted study: it makes the missing and the failed runs, and leaves finished ones alone
if their identity has not changed. An interruption does not change the metrics.

The runs are a loop over recordings by `joblib.Parallel`. Here, each of its threads waits for one worker process
(`mstfilter.runs.study.worker`). On a cluster, dask gives the recordings to its machines, whose threads do the same.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from mstfilter.base.errors import InputError, missing_library
from mstfilter.base.files import cache_folder, locked, sweep, writing
from mstfilter.base.lazy import progress_of
from mstfilter.base.processes import available_cores, machine
from mstfilter.base.reading import check_private
from mstfilter.runs import library_versions, write_json
from mstfilter.runs.study.config import StudyConfig
from mstfilter.runs.study.plan import Plan, StudyRun, make_plan
from mstfilter.runs.study.results import STUDY_FORMAT, Job, JobOutcome, StudyFolder, read_result, write_failure
from mstfilter.runs.study.worker import Worker, run_recording

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class StudyProgress:
    """Progress of a study."""

    name: str  #: the run that has ended or lost its worker; empty at the beginning
    outcome: JobOutcome | None  #: how the run ended; None if its worker died
    done: int  #: finished runs, including those of earlier calls
    failed: int
    total: int


@dataclass(frozen=True)
class StudyResult:
    """Result of `run_study`."""

    folder: StudyFolder
    done: int  #: runs that are done, earlier ones included
    repeated: int  #: runs that were done before this call
    failed: tuple[tuple[str, JobOutcome], ...]  #: names of the runs that failed, and why


def run_study(
    study: StudyConfig,
    path: Path,
    overrides: Sequence[str] = (),
    *,
    workers: int = 0,
    cluster: str = "",
    cache: Path | None = None,
    progress: bool | Callable[[StudyProgress], None] = False,
) -> StudyResult:
    """Run a study and store its results in a folder.

    Parameters
    ----------
    path : Path
        The study folder: new, empty, or from an earlier call.
    overrides : sequence of str
        Overrides for every arm. Each combination of comma-separated values is an arm. ``metric=./file.py:Class`` adds
        an own metric.
    workers : int
        Number of worker processes, each with one thread. 0 means one for each core of this machine or of the cluster.
    cluster : str
        Address of a scheduler of dask, such as ``tcp://head:8786``. The default is this machine.
    cache : Path, optional
        Folder of simulated recordings. The default is the user's cache folder.
    progress : bool or callable
        True shows a progress bar, or lines of the log if standard error is not a terminal. A function is called with
        a `StudyProgress` when a run ends or loses its worker, from any thread but never from two at once. If it
        raises an exception, the study stops. On a cluster, it is called when all runs of a recording have ended.

    Raises
    ------
    InputError
        If the study or the folder is invalid, before any run starts. Failed runs do not raise an error.
    """
    plan = make_plan(study, overrides)
    cache = (cache or cache_folder()).absolute()
    with _locked(path) as folder, progress_of(progress, bars="study_bars") as report, _backend(cluster):
        check_private(cache / "recordings")
        with writing(f"study folder {path}", "choose another with --out"):
            write_json(path / "study.json", _description(plan))
            for part in ("runs", "logs"):
                (path / part).mkdir(exist_ok=True)
        waiting = [run for run in plan.runs if not _is_done(run, plan, folder)]
        ledger = _Ledger(folder, plan, len(plan.runs) - len(waiting), report)
        _make(waiting, [_job(run, plan, folder, cache) for run in waiting], ledger, workers, not cluster)
        folder = StudyFolder.open(path)
        with writing(f"the tables of {path}", "free disk space and repeat the command"):
            folder.write_tables()
    n = len(plan.runs)
    return StudyResult(folder, n - len(ledger.failed), n - len(waiting), tuple(ledger.failed.items()))


@contextlib.contextmanager
def _backend(cluster: str) -> Iterator[None]:
    """In the block, `joblib.Parallel` gives its tasks to the machines of a cluster, if there is an address."""
    if not cluster:
        yield
        return
    try:
        from distributed import Client, KilledWorker
        from distributed.comm import CommClosedError
    except ImportError as error:
        raise missing_library(error, "a cluster") from error
    import joblib

    try:
        client = Client(cluster, timeout=10)
        client.wait_for_workers(1, timeout=30)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no cluster with workers answers at {cluster}: {error}",
            "start one: `dask scheduler`, and `dask worker ADDRESS --nthreads 1` for each core",
        ) from error
    with client, joblib.parallel_config(backend="dask"):
        try:
            yield
        except (KilledWorker, CommClosedError) as error:
            raise InputError(f"the cluster at {cluster} broke: {error}", "repeat the command to resume") from error


def _make(runs: Sequence[StudyRun], jobs: Sequence[Job], ledger: _Ledger, workers: int, here: bool) -> None:
    """Make the given runs. All runs of a recording go to one worker, or to a few if there are few recordings."""
    from joblib import Parallel, delayed, effective_n_jobs

    if not runs:
        return
    n_workers = workers or (available_cores() if here else effective_n_jobs(-1))
    recordings = [list(part) for _, part in groupby(jobs, key=lambda job: job["source"])]
    n_parts = -(-n_workers // len(recordings))
    groups = [part for of in recordings for k in range(n_parts) if (part := of[k::n_parts])]
    logs = ledger.folder.path.absolute() / "logs"
    crew = [Worker(logs / f"worker-{k}.log") for k in range(min(n_workers, len(groups)))] if here else []
    # On another machine, a task starts a worker of its own, and its outcomes are told when they are back.
    local = {"workers": crew[::-1], "tell": ledger.tell} if here else {}
    tasks = (
        delayed(run_recording)(group, logs / f"{Path(group[0]['folder']).name}.log", **local) for group in groups
    )
    backend = "threading" if here else None
    try:
        for outcomes in Parallel(n_workers, backend, "generator_unordered", batch_size=1)(tasks):
            for name, outcome in () if here else outcomes.items():
                ledger.tell(name, outcome)
    finally:
        for worker in crew:
            worker.stop()


class _Ledger:
    """Records the outcomes of runs, which any thread may tell, and reports them with the time left."""

    def __init__(self, folder: StudyFolder, plan: Plan, done: int, report: Callable[[StudyProgress], None]) -> None:
        self.folder, self.failed = folder, dict[str, JobOutcome]()
        self._runs = {run.name: run for run in plan.runs}
        self._done = self._earlier = done
        self._report, self._lock, self._begun = report, threading.Lock(), time.monotonic()
        report(StudyProgress("", None, done, 0, len(self._runs)))

    def tell(self, name: str, outcome: JobOutcome | None) -> None:
        """A run has ended. None: its worker died or exceeded the time limit."""
        with self._lock:
            if outcome is None:
                _LOGGER.warning("a worker died in %s", name)
            elif outcome.status == "done":
                self._done += 1
            else:
                run = self._runs[name]
                write_failure(self.folder.run(run.folder), run.identity, outcome)
                self.failed[name] = outcome
            if outcome is not None:
                self._log(name, outcome)
            self._report(StudyProgress(name, outcome, self._done, len(self.failed), len(self._runs)))

    def _log(self, name: str, outcome: JobOutcome) -> None:
        n, failed, total = self._done + len(self.failed), len(self.failed), len(self._runs)
        seconds = (time.monotonic() - self._begun) / (n - self._earlier) * (total - n)
        left = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        text = f"{n}/{total} runs{f', {failed} failed' if failed else ''}, {left} left: {name}"
        _LOGGER.info("%s%s", text, "" if outcome.status == "done" else f" failed: {outcome.error}")


def _job(run: StudyRun, plan: Plan, folder: StudyFolder, cache: Path) -> Job:
    """What a worker needs to make a run, as plain values."""
    study = plan.config
    return {
        "name": run.name,
        "source": run.scene.source,
        "recordings": str(cache / "recordings"),
        "folder": str(folder.run(run.folder).absolute()),
        "identity": run.identity,
        "code": plan.code,
        "config": {**run.arm.config, "description": run.arm.name},
        "seed": run.seed,
        "metrics": plan.metrics,
        "cwd": str(Path.cwd()),
        **{name: getattr(study, name) for name in ("keep", "tries", "timeout_s", "cache_gb")},
    }


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[StudyFolder]:
    """Lock the study folder, which need not exist. Temporary files of killed processes are removed."""
    with locked(path):
        try:
            sweep(path)
            sweep(path / "runs")
            if (path / "study.json").is_file():
                StudyFolder.open(path)  # checks the format
            elif path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise InputError(
                    f"cannot run a study in {path}: it exists and is not a study folder", "choose another with --out"
                )
            yield StudyFolder(path)
        finally:
            sweep(path / "runs")


def _description(plan: Plan) -> dict[str, Any]:
    """The content of study.json."""
    study = plan.config
    return {
        "format": STUDY_FORMAT,
        "name": study.name,
        "description": study.description,
        "reference": plan.reference,
        "code": plan.code,
        "libraries": library_versions(),
        "machine": machine(),
        "arms": [
            {name: getattr(arm, name) for name in ("name", "reported_only", "uses_truth", "config")}
            for arm in plan.arms
        ],
        "scenes": [asdict(scene) for scene in plan.scenes],
        "seeds": study.seeds,
        "metrics": plan.metrics,
        "runs": [
            {name: getattr(run, name) for name in ("name", "folder", "identity", "seed")}
            | {"arm": run.arm.name, "scene": run.scene.name, "group": run.scene.group}
            for run in plan.runs
        ],
    }


def _is_done(run: StudyRun, plan: Plan, folder: StudyFolder) -> bool:
    result = read_result(folder.run(run.folder))
    done = result.get("identity") == run.identity and result.get("status") == "done"
    return done and plan.metrics.keys() <= result.get("own_metrics", {}).keys()
