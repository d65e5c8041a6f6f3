"""Jobs in processes of this machine, one thread each.

>>> Local(workers=2).run(jobs, tell)

A worker is a fresh interpreter that is kept for many jobs, never a fork. When one dies (out of memory, a fault in a
library, somebody's kill) only its job is lost: it is begun again in a new worker, and named after `tries` times.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError
from mstfilter.study.executors import Event, Executor, Job, JobOutcome, Queue, Tell

__all__ = ["Local"]

_THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


@dataclass(frozen=True)
class Local(Executor):
    """Processes of this machine.

    Parameters
    ----------
    workers : int
        Processes at a time. 0: as many as there are cores that this process may use.
    tries : int
        How often a job is begun whose worker dies.
    timeout_s : float
        A job that takes longer counts as a worker's death. 0: no limit.
    logs : Path, optional
        Folder for what workers and their libraries print; without it nothing is kept.
    """

    workers: int = 0
    tries: int = 3
    timeout_s: float = 0.0
    logs: Path | None = None

    def __post_init__(self) -> None:
        if self.workers < 0 or self.tries < 1 or self.timeout_s < 0:
            raise InputError(f"workers is {self.workers}, tries {self.tries} and timeout {self.timeout_s} s")

    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        """Run all jobs."""
        if not jobs:
            return []
        n = min(self.workers or _cores(), len(jobs))
        crew = _Crew(self, jobs)
        threads = [threading.Thread(target=crew.serve, args=(w,), daemon=True) for w in range(n)]
        outcomes: dict[int, JobOutcome] = {}
        for thread in threads:
            thread.start()
        try:
            while len(outcomes) < len(jobs):
                event = crew.events.get()
                if isinstance(event, BaseException):
                    raise event
                if event.outcome is not None:
                    outcomes[event.job] = event.outcome
                tell(event)
        finally:
            crew.stop()
            for thread in threads:
                thread.join()
        return [outcomes[k] for k in range(len(jobs))]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Crew:
    """The workers of one call: a thread of this process looks after each."""

    def __init__(self, settings: Local, jobs: Sequence[Job]) -> None:
        self.settings, self.jobs = settings, jobs
        self.events: queue.SimpleQueue[Event | BaseException] = queue.SimpleQueue()
        self._queue, self._lock, self._stopped = Queue(jobs), threading.Lock(), False
        self._processes: dict[int, subprocess.Popen[str]] = {}

    def stop(self) -> None:
        """End all workers at once."""
        with self._lock:
            self._stopped = True
            for process in self._processes.values():
                process.kill()

    def serve(self, worker: int) -> None:
        """Give one worker jobs until there are none."""
        try:
            while True:
                with self._lock:
                    k = None if self._stopped else self._queue.take(worker)
                if k is None:
                    break
                outcome = self._see_through(worker, k)
                if outcome is not None:
                    self.events.put(Event("ended", k, outcome=outcome))
        except BaseException as error:  # a fault here must not leave the caller waiting
            self.events.put(error)
        finally:
            self._end(worker)

    def _see_through(self, worker: int, k: int) -> JobOutcome | None:
        """A job with all its tries; None if everything is being stopped."""
        why = ""
        for attempt in range(1, self.settings.tries + 1):
            self.events.put(Event("begun", k))
            outcome, why = self._once(worker, k)
            if self._stopped:
                return None
            if outcome is not None:
                return replace(outcome, tries=attempt)
            self._end(worker)
            self.events.put(Event("lost", k))
        n = self.settings.tries
        hints = (
            "if memory ran out: fewer workers, or a smaller scene",
            *([f"log: {self._log(worker)}"] if self._log(worker) else []),
        )
        return JobOutcome("failed", f"its worker died {n} time{'s' if n > 1 else ''}{why}", hints, tries=n)

    def _once(self, worker: int, k: int) -> tuple[JobOutcome | None, str]:
        """One try; no outcome, and why, if the worker died."""
        process = self._process(worker)
        if process is None:
            return None, ""
        late = threading.Event()

        def too_late() -> None:
            late.set()
            process.kill()

        limit = self.settings.timeout_s
        timer = threading.Timer(limit, too_late) if limit else None
        if timer is not None:
            timer.start()
        try:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(json.dumps(self.jobs[k]) + "\n")
            process.stdin.flush()
            for line in process.stdout:
                answer: Mapping[str, Any] = json.loads(line)
                if "outcome" in answer:
                    return _outcome(answer["outcome"]), ""
                self.events.put(Event("step", k, answer["done"], answer["total"]))
        except (OSError, ValueError):
            pass  # a broken pipe, or half a line: it died
        finally:
            if timer is not None:
                timer.cancel()
        code = process.wait()
        if late.is_set():
            return None, f", the last time because it took longer than {limit:g} s"
        return None, f", the last time by signal {-code}" if code < 0 else f", the last time with exit code {code}"

    def _process(self, worker: int) -> subprocess.Popen[str] | None:
        with self._lock:
            if self._stopped:
                return None
            process = self._processes.get(worker)
            if process is None:
                process = self._processes[worker] = self._start(worker)
            return process

    def _start(self, worker: int) -> subprocess.Popen[str]:
        path = self._log(worker)
        log: Any = subprocess.DEVNULL if path is None else path.open("a")
        try:
            return subprocess.Popen(
                [sys.executable, "-m", "mstfilter.study.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                encoding="utf-8",
                env={**os.environ, **dict.fromkeys(_THREADS, "1")},
                start_new_session=True,  # Ctrl-C is for the study, which ends its workers
            )
        finally:
            if path is not None:
                log.close()

    def _log(self, worker: int) -> Path | None:
        return None if self.settings.logs is None else self.settings.logs / f"worker-{worker}.log"

    def _end(self, worker: int) -> None:
        with self._lock:
            process = self._processes.pop(worker, None)
        if process is None:
            return
        process.kill()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        process.wait()


def _outcome(data: Mapping[str, Any]) -> JobOutcome:
    return JobOutcome(**{**data, "hints": tuple(data["hints"])})
