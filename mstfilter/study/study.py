"""Run a study: everything checked first, then every run that is not done yet, then the tables.

>>> result = run_study(load_study("study.toml"), Path("studies/first"), Local(workers=2))
>>> result.done, result.failed

A study that was stopped, killed or changed is run again by the same call: runs whose identity is unchanged are not
repeated, and the tables come out the same.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.runs.run_folder import write_json
from mstfilter.study.config import StudyConfig
from mstfilter.study.executors import Event, Executor, JobOutcome
from mstfilter.study.local import Local
from mstfilter.study.plan import Plan, StudyRun, make_plan
from mstfilter.study.results import STUDY_FORMAT, StudyFolder
from mstfilter.study.todo import ToDo

__all__ = ["StudyProgress", "StudyResult", "run_study"]


@dataclass(frozen=True)
class StudyProgress:
    """What is reported while a study is going on.

    Parameters
    ----------
    what : {"recordings", "runs"}
    event : Event, optional
        What happened last; None at the beginning of a part.
    name : str
        Of the job it happened to.
    done, failed, total : int
        Jobs of this part; those that were done before count as done.
    """

    what: str
    event: Event | None
    name: str
    done: int
    failed: int
    total: int


@dataclass(frozen=True)
class StudyResult:
    """What became of a study.

    Parameters
    ----------
    folder : StudyFolder
    done : int
        Runs that are done, earlier ones included.
    repeated : int
        Runs that were done before.
    failed : tuple of (str, JobOutcome)
        Names of the runs that failed, and why.
    """

    folder: StudyFolder
    done: int
    repeated: int
    failed: tuple[tuple[str, JobOutcome], ...]


def run_study(
    study: StudyConfig,
    path: Path,
    executor: Executor | None = None,
    overrides: Sequence[str] = (),
    *,
    allow_files: bool = True,
    cache: Path | None = None,
    progress: Callable[[StudyProgress], None] = lambda progress: None,
) -> StudyResult:
    """Run a study into a folder.

    Parameters
    ----------
    study : StudyConfig
    path : Path
        New, empty, or of an earlier call.
    executor : Executor, optional
        Default: one process a core of this machine.
    overrides : sequence of str
        Applied to every arm; a comma makes a grid.
    allow_files : bool
        Whether components may come from ``./file.py:Class``.
    cache : Path, optional
        Where simulated recordings and shared work are kept. Default: the user's cache folder.
    progress : callable
        Called for everything that happens.

    Raises
    ------
    InputError
        For whatever is wrong with the study or the folder, before any run begins. Runs that fail raise nothing.
    """
    from mstfilter.simulation import cache_folder

    plan = make_plan(study, overrides, allow_files=allow_files)
    cache = cache or cache_folder()
    with _held(path) as folder:
        executor = executor or Local(tries=study.tries, timeout_s=study.timeout_s, logs=path / "logs")
        todo = ToDo(plan, folder, allow_files, cache)
        todo.check_space()
        write_json(path / "study.json", _described(plan))
        failed = _recordings(todo, executor, progress)
        waiting, before = todo.runs()
        lost = {run.name: failed[run.scene.key] for run in plan.runs if run.scene.key in failed}
        for run in plan.runs:
            if run.name in lost and run.folder not in before:
                _note(folder, run, lost[run.name])
        waiting = [(run, job) for run, job in waiting if run.name not in lost]
        counted = _Counted(progress, "runs", [run.name for run, _ in waiting], len(before), len(plan.runs), len(lost))

        def tell(event: Event) -> None:
            if event.kind == "lost":
                _sweep(path, waiting[event.job][0].folder)
            if event.outcome is not None and event.outcome.status != "done":
                _note(folder, waiting[event.job][0], event.outcome)
            counted(event)

        outcomes = executor.run([job for _, job in waiting], tell)
        for (run, _), outcome in zip(waiting, outcomes, strict=True):
            if outcome.status != "done":
                _note(folder, run, outcome)  # again: the disk that was full then may not be so now
        folder = StudyFolder.open(path)
        try:
            folder.write_tables()
        except OSError as error:
            raise InputError(
                f"cannot write the tables of {path}: {error.strerror}", "make room and repeat"
            ) from error
    ended = [(run.name, outcome) for (run, _), outcome in zip(waiting, outcomes, strict=True)]
    bad = [*((n, o) for n, o in lost.items()), *((n, o) for n, o in ended if o.status != "done")]
    return StudyResult(folder, len(plan.runs) - len(bad), len(before), tuple(bad))


@contextlib.contextmanager
def _held(path: Path) -> Iterator[StudyFolder]:
    """The study's folder, made if need be, for this process alone."""
    if path.exists() and not (path / "study.json").exists() and (not path.is_dir() or any(_visible(path))):
        raise InputError(
            f"cannot run a study in {path}: it exists and is no study folder", "choose another with --out"
        )
    try:
        (path / "runs").mkdir(parents=True, exist_ok=True)
        (path / "logs").mkdir(exist_ok=True)
        lock = (path / ".lock").open("w")
    except OSError as error:
        raise InputError(
            f"cannot write study folder {path}: {error.strerror}", "choose another with --out"
        ) from error
    with lock:
        try:
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:
            pass  # a system without such locks
        except OSError:
            raise InputError(
                f"another process is running the study in {path}", "wait for it, or choose --out"
            ) from None
        _sweep(path, "*")  # what workers left that were killed with their study
        try:
            yield StudyFolder(path)
        finally:
            _sweep(path, "*")


def _sweep(path: Path, folder: str) -> None:
    """Remove what a worker that died has left of a run."""
    for left in (path / "runs").glob(f".{folder}.*.partial"):
        shutil.rmtree(left, ignore_errors=True)


def _visible(path: Path) -> Iterator[Path]:
    return (p for p in path.iterdir() if p.name not in (".lock", "logs", "runs"))


def _described(plan: Plan) -> dict[str, Any]:
    study = plan.config
    return {
        "format": STUDY_FORMAT,
        "name": study.name,
        "description": study.description,
        "reference": plan.reference,
        "arms": [{"name": arm.name, "beside": arm.beside, "config": arm.config} for arm in plan.arms],
        "scenes": [{"name": s.name, "group": s.group, "source": s.source, "key": s.key} for s in plan.scenes],
        "seeds": study.seeds,
        "runs": [
            {
                "name": run.name,
                "folder": run.folder,
                "identity": run.identity,
                "arm": run.arm.name,
                "scene": run.scene.name,
                "group": run.scene.group,
                "seed": run.seed,
            }
            for run in plan.runs
        ],
    }


def _note(folder: StudyFolder, run: StudyRun, outcome: JobOutcome) -> None:
    """Write a failure down; where not even that is possible it is told at the end all the same."""
    with contextlib.suppress(OSError):
        folder.fail({"folder": run.folder, "identity": run.identity}, outcome)


def _recordings(todo: ToDo, executor: Executor, progress: Callable[[StudyProgress], None]) -> dict[str, JobOutcome]:
    """Make what is missing; why it could not be made, by the scene's key."""
    keys, records = todo.records()
    if not records:
        return {}
    counted = _Counted(progress, "recordings", [job["name"] for job in records], 0, len(records), 0)
    outcomes = executor.run(records, counted)
    return {key: outcome for key, outcome in zip(keys, outcomes, strict=True) if outcome.status != "done"}


class _Counted:
    """Events as progress."""

    def __init__(
        self,
        progress: Callable[[StudyProgress], None],
        what: str,
        names: list[str],
        done: int,
        total: int,
        failed: int,
    ) -> None:
        self._progress, self._what, self._names, self._total = progress, what, names, total
        self._done, self._failed = done, failed
        progress(StudyProgress(what, None, "", done, failed, total))

    def __call__(self, event: Event) -> None:
        if event.outcome is not None:
            good = event.outcome.status == "done"
            self._done, self._failed = self._done + good, self._failed + (not good)
        name = self._names[event.job]
        self._progress(StudyProgress(self._what, event, name, self._done, self._failed, self._total))
