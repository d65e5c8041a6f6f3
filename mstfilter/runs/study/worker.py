"""The worker processes of a study.

>>> run_recording(jobs, Path("worker.log"))
{'mst on s1-0, seed 0': JobOutcome(status='done', ...), ...}

A worker makes the runs of one recording one after another, so the optical flow, the segmentation trees and whatever
else the runs share are computed once and stay in its memory. It reads jobs, one line of JSON each, from its standard
input and answers with their outcomes. A run that kills its worker or exceeds the time limit costs only itself. It is
started again in a new process, up to `tries` times.

The folder of a run is written under a temporary name and renamed when the run is complete. So the incomplete folder
of a killed worker is never taken for a result.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, describe_error, exhausted
from mstfilter.base.files import atomic_folder, sweep
from mstfilter.base.processes import log_lines
from mstfilter.formats import open_recording
from mstfilter.runs import RunFolder, code_version, filter_recording
from mstfilter.runs.presets import PACKAGES
from mstfilter.runs.study.plan import build_metric, family_of
from mstfilter.runs.study.results import FORECASTS, Job, JobOutcome, cost_columns, read_result, write_result
from mstfilter.scene import Recording, scene_cache
from mstfilter.scoring import measure_own, measure_pause

_THREADS = ("OMP", "OPENBLAS", "MKL", "NUMEXPR")
_ONE_THREAD = {**{f"{name}_NUM_THREADS": "1" for name in _THREADS}, "VECLIB_MAXIMUM_THREADS": "1"}

#: ``tell(name, outcome)``: a run has ended. None: its worker died or exceeded the time limit, and may try again.
Tell = Callable[[str, JobOutcome | None], None]


def run_recording(
    jobs: Sequence[Job], log: Path, workers: list[Worker] | None = None, tell: Tell = lambda name, outcome: None
) -> dict[str, JobOutcome]:
    """Make the runs of one recording in one worker process: one of `workers`, or a new one with the given log.

    Returns the outcomes by the names of the runs.
    """
    worker = workers.pop() if workers else Worker(log)
    recording = {name: value for name, value in jobs[0].items() if name != "folder"}
    outcomes = {}
    try:
        opened = worker.perform(recording)  # a simulated recording is made first
        for job in jobs:
            name = job["name"]
            outcomes[name] = worker.perform(job, partial(tell, name, None)) if opened.status == "done" else opened
            tell(name, outcomes[name])
    finally:
        worker.close() if workers is None else workers.append(worker)
    return outcomes


class Worker:
    """A process that makes runs one after another. The first job starts it, and the first one after its death."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False

    def perform(self, job: Job, died: Callable[[], None] = lambda: None) -> JobOutcome:
        """The outcome of a job. ``died()`` is called after each try that ended the process."""
        reason = ""
        for tries in range(1, job["tries"] + 1):
            answer, reason = self._try(job)
            if answer is not None:
                return JobOutcome(**{**answer, "hints": tuple(answer["hints"]), "tries": tries})
            if self._stopped:
                raise InterruptedError("the study was stopped")
            if "folder" in job:
                sweep(Path(job["folder"]).parent, Path(job["folder"]).name)
            died()
        times = f"{tries} time{'s' if tries > 1 else ''}"
        hints = "if memory ran out: use fewer workers or a smaller scene", f"log: {self._log}"
        return JobOutcome("failed", f"its worker died {times}, the last time {reason}", hints, tries=tries)

    def _try(self, job: Job) -> tuple[dict[str, Any] | None, str]:
        """The answer of the process; None and a reason if the process died or was killed after the time limit."""
        process = self._process = self._process or self._start(job["cwd"])
        if self._stopped:  # between the end of the last process and the start of this one
            process.kill()
        assert process.stdin is not None and process.stdout is not None
        limit, late = job["timeout_s"], threading.Event()

        def end() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(limit, end)
        try:
            if limit:
                timer.start()
            process.stdin.write(json.dumps(job).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = b""
        finally:
            timer.cancel()
        if late.is_set() or not line.endswith(b"\n"):
            code = self.close()
            died = f"by signal {-code}" if code < 0 else f"with exit code {code}"
            return None, f"because it took longer than {limit:g} s" if late.is_set() else died
        return json.loads(line), ""

    def _start(self, cwd: str) -> subprocess.Popen[bytes]:
        path = os.pathsep.join(folder for folder in sys.path if folder)  # not the working folder
        environment = {**os.environ, **_ONE_THREAD, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("ab") as log:
            command, pipe = [sys.executable, "-m", __name__], subprocess.PIPE
            return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=log, cwd=cwd, env=environment)

    def close(self) -> int:
        """End the process. Returns its exit code, or minus the number of the signal that ended it."""
        process = self._process
        if process is None:
            return 0
        process.kill()
        code = process.wait()
        self._process = None
        return code

    def stop(self) -> None:
        """End the process, and start no other one. Another thread may wait for the process."""
        self._stopped = True
        self.close()


# In the worker process:


def serve() -> None:
    """Perform jobs from standard input until it is closed. All other output goes to the log."""
    lines, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process of the study
    jobs: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read() -> None:
        for line in lines:
            jobs.put(line)
        os._exit(1)  # the study has ended, perhaps during a job

    threading.Thread(target=read, daemon=True).start()
    import cv2

    cv2.setNumThreads(1)
    with log_lines():
        while True:
            outcome = perform(json.loads(jobs.get()))
            answers.write(json.dumps(asdict(outcome)).encode() + b"\n")
            answers.flush()


def perform(job: Job) -> JobOutcome:
    """Run a job and return its outcome. An error in the job gives a failed outcome.

    A job without ``folder`` only opens, or simulates, the recording.
    """
    try:
        _check_code(job["code"])
        recording = _recording(json.dumps(job["source"]), job["recordings"], job["cache_gb"])
        return _run(job, recording) if "folder" in job else JobOutcome("done")
    except (Exception, SystemExit) as error:
        return _failure(error)


def _failure(error: BaseException) -> JobOutcome:
    trace = "".join(traceback.format_exception(error))
    known = error if isinstance(error, InputError) else exhausted(error)
    if known is not None:
        return JobOutcome("failed", known.message, known.hints, trace)
    hints = tuple(getattr(error, "__notes__", ()))
    hints = hints or ("result.json in the folder of the run has the traceback",)
    return JobOutcome("failed", describe_error(error), hints, trace)


@cache
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


@lru_cache(maxsize=1)
def _recording(source: str, recordings: str, cache_gb: float) -> Recording:
    """The recording of the present jobs. What runs share is kept in memory until another recording is opened."""
    scene_cache.clear()
    scene_cache.keeps_shared = cache_gb > 0
    if cache_gb:
        scene_cache.limit_bytes = int(cache_gb * 1e9)
    return open_scene(json.loads(source), recordings)


def open_scene(source: Mapping[str, Any], recordings: str) -> Recording:
    """The recording of a scene. A missing recording of a simulated scene is made first."""
    if "path" in source:
        return open_recording(Path(source["path"]), source["format"], source["options"], source["pauses"])
    from mstfilter.lab.simulation import cached_recording

    return open_recording(cached_recording(family_of(source), source["seed"], Path(recordings)))


def _run(job: Job, recording: Recording) -> JobOutcome:
    """Make a run, or only its own metrics if the rest of it is complete."""
    folder, result = Path(job["folder"]), read_result(Path(job["folder"]))
    if result.get("identity") == job["identity"] and result.get("rows") and (folder / "pauses").is_dir():
        return _finish(job, RunFolder(folder), recording, result)
    with atomic_folder(folder, "replace") as work:
        costs, progress = _costs()
        run = filter_recording(recording, job["config"], work, job["seed"], allow_files=True, progress=progress)
        for t, cost in enumerate(costs):
            stages = run.seconds(t)
            costs[t] = {"seconds": sum(stages.values()), **cost, **{f"seconds_{k}": s for k, s in stages.items()}}
        result = {"identity": job["identity"], "rows": write_measures(run, recording), "costs": costs}
        return _finish(job, run, recording, result)


def _finish(job: Job, run: RunFolder, recording: Recording, result: Mapping[str, Any]) -> JobOutcome:
    """Measure the own metrics that are missing, and write result.json. After an error the run and the others stay."""
    outcome, own = JobOutcome("done"), dict(result.get("own_metrics", {}))
    wanted = [own[key] for key in job["metrics"] if key in own]
    taken = {name for rows in (result["rows"], *wanted) for row in rows for name in row}
    for key, spec in job["metrics"].items():
        if key in own:
            continue
        try:
            metric = build_metric(spec)
            rows = [
                measure_own(metric, recording, t, run.hypotheses(t), np.array(run.info(t)["weights"]))
                for t in range(run.n_pauses)
            ]
            names = {name for row in rows for name in row}
            if twice := sorted(taken & names) or cost_columns([dict.fromkeys(names)]):
                raise InputError(f"metric {type(metric).__name__}: the study has another column {twice[0]!r}")
        except (Exception, SystemExit) as error:
            outcome = _failure(error)
        else:
            own[key], taken = rows, taken | names
    write_result(run.path, {**result, "own_metrics": own, **asdict(outcome)})
    if job["keep"] == "tables" and outcome.status == "done":
        shutil.rmtree(run.path / "pauses")
    return outcome


def write_measures(run: RunFolder, recording: Recording) -> list[dict[str, Any]]:
    """Return the metrics of each pause of a run, and write the counts of its forecasts into the folder of the run."""
    measured = [
        measure_pause(recording, t, run.hypotheses(t), one.weights, run.questions(t), one.answer)
        for t, one in enumerate(run.estimates())
    ]
    counts = [one for _, one in measured if one is not None]
    if len(counts) == len(measured):
        np.savez_compressed(run.path / FORECASTS, counts=np.stack(counts))
    return [row for row, _ in measured]


def _costs() -> tuple[list[dict[str, float]], Callable[[int, int], None]]:
    """A list, and a function for the progress of a run that appends processor time and memory of each step to it."""
    costs: list[dict[str, float]] = []
    began = time.process_time()

    def progress(done: int, total: int) -> None:
        nonlocal began
        if done:
            costs.append({"core_seconds": time.process_time() - began, "peak_mb": peak_megabytes()})
        reset_peak()
        began = time.process_time()

    return costs, progress


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


if __name__ == "__main__":
    serve()
