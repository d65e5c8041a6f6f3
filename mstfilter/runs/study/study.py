"""Runs a study: `run_study` checks the study and the folder, makes every missing run, and writes the tables.

>>> result = run_study(load_study("study.toml"), Path("studies/first"), Local(workers=2))
>>> result.done, result.failed

The same call resumes an interrupted study and repeats failed runs. Finished runs with unchanged identity are not
repeated. An interruption does not change the metrics.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mstfilter.base.errors import InputError
from mstfilter.base.files import locked, sweep, writing
from mstfilter.base.lazy import progress_of
from mstfilter.base.processes import check_main_guard, machine
from mstfilter.base.reading import check_private
from mstfilter.runs import library_versions, write_json
from mstfilter.runs.study.config import StudyConfig
from mstfilter.runs.study.executors import Executor, Local, Tell
from mstfilter.runs.study.plan import Plan, StudyRun, StudyScene, make_plan
from mstfilter.runs.study.results import STUDY_FORMAT, Job, JobOutcome, StudyFolder, read_result, write_result

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class StudyProgress:
    """Progress of a study."""

    what: str  #: {"recordings", "runs"}
    name: str  #: the job that has ended or lost its worker; empty at the beginning of a part
    outcome: JobOutcome | None  #: how the job ended; None if its worker died
    done: int  #: finished jobs of this part, including those of earlier calls
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
    executor: Executor | None = None,
    overrides: Sequence[str] = (),
    *,
    cache: Path | None = None,
    progress: bool | Callable[[StudyProgress], None] = False,
) -> StudyResult:
    """Run a study and store its results in a folder.

    Parameters
    ----------
    path : Path
        The study folder. The folder must be new, empty, or from an earlier call.
    executor : Executor, optional
        Runs the jobs. By default, `Local` with one process for each core of this machine.
    overrides : sequence of str
        Overrides for every arm. Each combination of comma-separated values is an arm.
    cache : Path, optional
        Folder of simulated recordings and intermediate results. The default is the user's cache folder.
    progress : bool or callable
        True shows progress bars, or lines of the log if standard error is not a terminal. A function is called with
        a `StudyProgress` when a job ends or loses its worker.

    Raises
    ------
    InputError
        If the study or the folder is invalid, before any run starts. Failed runs do not raise an error.
    """
    from mstfilter.lab.simulation import cache_folder

    executor = executor or Local(logs=path / "logs")
    if isinstance(executor, Local):
        check_main_guard("run_study")
    plan = make_plan(study, overrides)
    cache = (cache or cache_folder()).absolute()
    with _locked(path) as folder, progress_of(progress, bars="study_bars") as report:
        _prepare(folder, cache, _description(plan))
        waiting = [run for run in plan.runs if not _is_done(run, folder)]
        call = _Call(plan, folder, cache, executor, report)
        failed = call.record_scenes(waiting)
        failed |= call.filter_scenes([run for run in waiting if run.name not in failed], len(failed))
        folder = StudyFolder.open(path)
        with writing(f"the tables of {path}", "free disk space and repeat the command"):
            folder.write_tables()
    n = len(plan.runs)
    return StudyResult(folder, n - len(failed), n - len(waiting), tuple(failed.items()))


def _prepare(folder: StudyFolder, cache: Path, description: dict[str, Any]) -> None:
    """Check the folders and write study.json."""
    for part in ("recordings", "work"):
        check_private(cache / part)
    with writing(f"study folder {folder.path}", "choose another with --out"):
        write_json(folder.path / "study.json", description)
        for part in ("runs", "logs"):
            (folder.path / part).mkdir(exist_ok=True)


@dataclass(frozen=True)
class _Call:
    """One call of `run_study`, which gives jobs to the executor and records failures."""

    plan: Plan
    folder: StudyFolder
    cache: Path
    executor: Executor
    report: Callable[[StudyProgress], None]

    def record_scenes(self, runs: Sequence[StudyRun]) -> dict[str, JobOutcome]:
        """Simulate missing recordings. Returns the runs that lack a recording, with the reason."""
        recordings = self.cache / "recordings"
        scenes = {run.scene.key: run.scene for run in runs if "family" in run.scene.source}
        missing = [scene for scene in scenes.values() if not _is_recorded(scene.source, recordings)]
        jobs = [self._job("record", scene.name, scene, {"recordings": str(recordings)}) for scene in missing]
        if not jobs:
            return {}
        outcomes = self.executor.run(jobs, self._counter("recordings", jobs, 0, len(jobs), 0))
        why = {scene.key: one for scene, one in zip(missing, outcomes, strict=True) if one.status != "done"}
        failed = [run for run in runs if run.scene.key in why]
        for run in failed:
            _write_failure(self.folder, run, why[run.scene.key])
        return {run.name: why[run.scene.key] for run in failed}

    def filter_scenes(self, runs: Sequence[StudyRun], n_failed: int) -> dict[str, JobOutcome]:
        """Make the given runs, after `n_failed` runs have failed. Returns the newly failed runs, with the reasons."""
        total = len(self.plan.runs)
        jobs = [self._run_job(run) for run in runs]
        count = self._counter("runs", jobs, total - len(runs) - n_failed, total, n_failed)

        def tell(k: int, outcome: JobOutcome | None) -> None:
            if outcome is None:
                sweep(self.folder.path / "runs", runs[k].folder)
            count(k, outcome)

        outcomes = self.executor.run(jobs, tell)
        failed = [(run, outcome) for run, outcome in zip(runs, outcomes, strict=True) if outcome.status != "done"]
        for run, outcome in failed:
            _write_failure(self.folder, run, outcome)
        return {run.name: outcome for run, outcome in failed}

    def _job(self, kind: str, name: str, scene: StudyScene, more: dict[str, Any]) -> Job:
        """A job for `mstfilter.runs.study.jobs`, as plain values."""
        limits = {"tries": self.plan.config.tries, "timeout_s": self.plan.config.timeout_s}
        return {"kind": kind, "name": name, "share": scene.key, "source": scene.source, **limits, **more}

    def _run_job(self, run: StudyRun) -> Job:
        plan = self.plan
        libraries = "".join(f" {name}={version}" for name, version in library_versions().items())
        work = {
            "folder": str(self.cache / "work"),
            "limit_bytes": int(plan.config.cache_gb * 1e9),
            "version": plan.code + libraries,
        }
        more = {
            "folder": str(self.folder.run(run.folder).absolute()),
            "identity": run.identity,
            "code": plan.code,
            "config": {**run.arm.config, "description": run.arm.name},
            "seed": run.seed,
            "keep": plan.config.keep,
            "recordings": str(self.cache / "recordings"),
            "work": work if plan.config.cache_gb and run.arm.known_code else None,
        }
        return self._job("run", run.name, run.scene, more)

    def _counter(self, what: str, jobs: Sequence[Job], done: int, total: int, failed: int) -> Tell:
        """A function that reports the outcome of each job as a `StudyProgress` and to the log, with the time left."""
        begun, earlier = time.monotonic(), done + failed

        def count(k: int, outcome: JobOutcome | None) -> None:
            nonlocal done, failed
            if outcome is None:
                _LOGGER.warning("a worker died in %s", jobs[k]["name"])
            else:
                done += outcome.status == "done"
                failed += outcome.status != "done"
                n = done + failed
                seconds = (time.monotonic() - begun) / (n - earlier) * (total - n)
                left = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
                text = f"{n}/{total} {what}{f', {failed} failed' if failed else ''}, {left} left: {jobs[k]['name']}"
                _LOGGER.info("%s%s", text, f" failed: {outcome.error}" if outcome.status != "done" else "")
            self.report(StudyProgress(what, jobs[k]["name"], outcome, done, failed, total))

        self.report(StudyProgress(what, "", None, done, failed, total))
        return count


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
        "runs": [
            {name: getattr(run, name) for name in ("name", "folder", "identity", "seed")}
            | {"arm": run.arm.name, "scene": run.scene.name, "group": run.scene.group}
            for run in plan.runs
        ],
    }


def _is_done(run: StudyRun, folder: StudyFolder) -> bool:
    result = read_result(folder.run(run.folder))
    return result.get("identity") == run.identity and result.get("status") == "done"


def _write_failure(folder: StudyFolder, run: StudyRun, outcome: JobOutcome) -> None:
    """Record the reason of a failed run. If the disk is full, nothing is written."""
    with contextlib.suppress(OSError):
        folder.run(run.folder).mkdir(parents=True, exist_ok=True)
        write_result(folder.run(run.folder), {"identity": run.identity, **asdict(outcome)})


def _is_recorded(source: dict[str, Any], recordings: Path) -> bool:
    from mstfilter.lab.simulation import cached_path, scene_family

    family = replace(scene_family(source["family"]), **source["set"])
    return (cached_path(family, source["seed"], recordings) / "manifest.json").is_file()
