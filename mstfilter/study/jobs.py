"""What a worker does: make a recording, run a filter on one, or measure a run again.

>>> perform({"kind": "run", "name": "mst on demo-0", ...}, step=lambda done, total: None)
JobOutcome(status='done')

A job is plain values and needs nothing else, so that a process on another machine can do it. A run is written
under a name of its own and renamed when it is whole: two workers with the same run do not disturb each other,
and what a killed one leaves is never taken for a result.
"""

from __future__ import annotations

import errno
import importlib
import os
import shutil
import time
import traceback
import uuid
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.formats import open_recording
from mstfilter.runs.run_folder import RunFolder, write_json
from mstfilter.runs.sources import open_source
from mstfilter.scene import Recording, scene_cache
from mstfilter.study.code_version import files_version
from mstfilter.study.executors import Job, JobOutcome
from mstfilter.study.memory import StagePeaks
from mstfilter.study.results import RESULT, read_result

__all__ = ["failed", "open_scene", "perform"]

_Step = Callable[[int, int], None]


def perform(job: Job, step: _Step = lambda done, total: None) -> JobOutcome:
    """Do a job; whatever goes wrong in it becomes its outcome.

    Parameters
    ----------
    job : mapping
        See `study.jobs_of`.
    step : callable
        Told steps done and steps in all.
    """
    try:
        {"record": _record, "run": _run, "measure": _measure}[job["kind"]](job, step)
    except Exception as error:
        return failed(error)
    return JobOutcome("done")


def failed(error: Exception) -> JobOutcome:
    """What an exception says to a user."""
    trace = "".join(traceback.format_exception(error))
    if isinstance(error, InputError):
        return JobOutcome("failed", error.message, error.hints, trace)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return JobOutcome(
            "failed", f"no space left: {error}", ("make room; the same command repeats this run",), trace
        )
    if isinstance(error, MemoryError):
        return JobOutcome("failed", "out of memory", ("use fewer workers",), trace)
    return JobOutcome(
        "failed", f"{type(error).__name__}: {error}", ("a fault of the program or of a component",), trace
    )


def open_scene(source: Mapping[str, Any], recordings: str) -> Recording:
    """The recording of a scene; a simulated one is made if it is missing."""
    if "path" in source:
        return open_source(Path(source["path"]), source["format"], source["options"], source["pauses"])
    from mstfilter.simulation import cached_recording

    return open_recording(cached_recording(source["family"], source["seed"], Path(recordings), **source["set"]))


def _record(job: Job, step: _Step) -> None:
    open_scene(job["source"], job["recordings"])


_verified: set[str] = set()


def _verify(job: Job) -> None:
    """Raise InputError unless this process runs the code that the study was planned with.

    Once is enough: all of it is imported then, and later changes of the files change nothing here.
    """
    if job["code"] in _verified:
        return
    if files_version(job["modules"]) != job["code"]:
        raise InputError(
            "the code has changed since the study began",
            "the same command begins these runs with the code as it is now",
        )
    for module in job["modules"]:
        importlib.import_module(module)
    _verified.add(job["code"])


def _run(job: Job, step: _Step) -> None:
    from mstfilter.runs.run import filter_recording

    _verify(job)
    final = Path(job["folder"])
    work = final.with_name(f".{final.name}.{uuid.uuid4().hex[:8]}.partial")
    costs: list[dict[str, float]] = []
    began, peaks = time.process_time(), StagePeaks()

    def progress(p: Any) -> None:
        nonlocal began
        now = time.process_time()
        if p.done:
            costs.append({"seconds": p.seconds, "core_seconds": now - began, **peaks.figures()})
            peaks.begin()
        began = time.process_time()
        step(p.done, p.total)

    try:
        recording = open_scene(job["source"], job["recordings"])
        began = time.process_time()
        with scene_cache.on_disk(**job["work"]) if job["work"] else nullcontext():
            run = filter_recording(
                recording,
                job["config"],
                work,
                job["seed"],
                allow_files=job["allow_files"],
                progress=progress,
                observer=peaks,
            )
        stages = [{f"seconds_{k}": v for k, v in run.seconds(t).items()} for t in range(run.n_pauses)]
        _write(run, recording, job, [{**cost, **stage} for cost, stage in zip(costs, stages, strict=True)])
        if job["keep"] == "tables":
            shutil.rmtree(run.path / "pauses")
        if final.exists():  # what failed there before
            shutil.rmtree(final)
        os.replace(work, final)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _measure(job: Job, step: _Step) -> None:
    """Figures of a run that is done already, by what they mean now."""
    folder = Path(job["folder"])
    recording = open_scene(job["source"], job["recordings"])
    _write(RunFolder.open(folder), recording, job, read_result(folder)["costs"])


def _write(run: RunFolder, recording: Recording, job: Job, costs: list[dict[str, float]]) -> None:
    from mstfilter.runs.metrics import measure_pause

    rows = [measure_pause(run, recording, t) for t in range(run.n_pauses)]
    result = {"identity": job["identity"], "metrics": job["metrics"], "status": "done", "rows": rows, "costs": costs}
    write_json(run.path / RESULT, result)
