"""The jobs of a study. Each job simulates a recording, or runs a filter on a recording.

>>> perform({"kind": "run", "name": "mst on demo-0", ...})
JobOutcome(status='done')

A job is a mapping of plain values, so that a process on another machine can run it. The folder of a run is written
under a temporary name and renamed when the run is complete. So two workers can make the same run, and an incomplete
folder of a killed worker is never used as a result.
"""

from __future__ import annotations

import contextlib
import functools
import shutil
import sys
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, describe_error, exhausted
from mstfilter.base.files import atomic_folder
from mstfilter.formats import open_recording
from mstfilter.runs import RunFolder, code_version, filter_recording
from mstfilter.runs.presets import PACKAGES
from mstfilter.runs.study.results import FORECASTS, Job, JobOutcome, write_result
from mstfilter.scene import Recording, scene_cache
from mstfilter.scoring import measure_pause


def perform(job: Job) -> JobOutcome:
    """Run a job and return its outcome. An error in the job gives a failed outcome.

    ``job["kind"]`` is "record" or "run". `mstfilter.runs.study.study` writes the other keys.
    """
    try:
        if job["kind"] == "record":
            open_scene(job["source"], job["recordings"])
        else:
            _run(job)
    except (Exception, SystemExit) as error:
        return _failure(error)
    return JobOutcome("done")


def _failure(error: BaseException) -> JobOutcome:
    trace = "".join(traceback.format_exception(error))
    known = error if isinstance(error, InputError) else exhausted(error)
    if known is not None:
        return JobOutcome("failed", known.message, known.hints, trace)
    hints = tuple(getattr(error, "__notes__", ()))
    hints = hints or ("result.json in the folder of the run has the traceback",)
    return JobOutcome("failed", describe_error(error), hints, trace)


def open_scene(source: Mapping[str, Any], recordings: str) -> Recording:
    """The recording of a scene. A missing recording of a simulated scene is made first."""
    if "path" in source:
        return open_recording(Path(source["path"]), source["format"], source["options"], source["pauses"])
    from mstfilter.lab.simulation import cached_recording

    return open_recording(cached_recording(source["family"], source["seed"], Path(recordings), **source["set"]))


@functools.cache
def _check_code(expected: str) -> None:
    """Raise InputError unless this process runs the code with which the study was planned.

    The function also imports all packages of the filter, so later changes of their files do not affect this process.
    """
    if code_version() != expected:
        raise InputError(
            "this process has other code of mstfilter than the study began with",
            "after a change of the code, repeat the command; all machines need the same version",
        )
    for package in PACKAGES:
        for name in package.__all__:
            getattr(package, name)


def _run(job: Job) -> None:
    _check_code(job["code"])
    folder = Path(job["folder"])
    costs: list[dict[str, float]] = []
    began = time.process_time()

    def progress(done: int, total: int) -> None:
        nonlocal began
        if done:
            costs.append({"core_seconds": time.process_time() - began, "peak_mb": peak_megabytes()})
        reset_peak()
        began = time.process_time()

    recording = open_scene(job["source"], job["recordings"])
    with atomic_folder(folder, "replace") as work:
        with scene_cache.on_disk(**job["work"]) if job["work"] else contextlib.nullcontext():
            began = time.process_time()
            run = filter_recording(
                recording,
                job["config"],
                work,
                job["seed"],
                allow_files=True,
                progress=progress,
            )
        for t, cost in enumerate(costs):
            stages = run.seconds(t)
            by_stage = {f"seconds_{stage}": seconds for stage, seconds in stages.items()}
            costs[t] = {"seconds": sum(stages.values()), **cost, **by_stage}
        rows = write_measures(run, recording)
        write_result(work, {"identity": job["identity"], "status": "done", "rows": rows, "costs": costs})
        if job["keep"] == "tables":
            shutil.rmtree(work / "pauses")


def write_measures(run: RunFolder, recording: Recording) -> list[dict[str, Any]]:
    """Return the metrics of each pause of a run, and write the counts of its forecasts into the folder of the run."""
    measured = [
        measure_pause(
            recording, t, run.hypotheses(t), np.array(run.info(t)["weights"], dtype=float), run.questions(t)
        )
        for t in range(run.n_pauses)
    ]
    counts = [one for _, one in measured if one is not None]
    if len(counts) == len(measured):
        np.savez_compressed(run.path / FORECASTS, counts=np.stack(counts))
    return [row for row, _ in measured]


def reset_peak() -> bool:
    """Reset the peak memory of this process. Returns False on systems other than Linux."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")
        return True
    return False


def peak_megabytes() -> float:
    """Peak resident memory of this process in MB since the last `reset_peak`; NaN if it is unknown."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    try:
        import resource
    except ImportError:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 1024)
