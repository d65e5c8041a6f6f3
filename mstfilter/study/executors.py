"""Executors run the jobs of a study: `Local` in processes of this machine, `Cluster` on a Dask scheduler.

>>> outcomes = Local(workers=2).run(jobs, tell=print)

A job is a mapping of plain values (see `mstfilter.study.jobs`). A job always ends with a `JobOutcome`. An error in a
job, the death of a worker or an exceeded time limit does not stop the other jobs.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mstfilter.fields import Bounded, NonNegativeInt
from mstfilter.processes import available_cores, environment
from mstfilter.study.jobs import perform
from mstfilter.study.results import Job, JobOutcome

_POLL_S = 0.1  # of a worker's order to stop
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
    "1",
)


@dataclass(frozen=True)
class Event:
    """Something that happened to a job."""

    #: {"started", "lost", "ended"}: "lost": its worker died or the time limit was exceeded; it is started
    #: again if tries are left.
    kind: str
    job: int  #: its index in the list of jobs
    outcome: JobOutcome | None = None  #: of a job that has ended


Tell = Callable[[Event], None]


class Executor(Bounded, ABC):
    """Runs jobs."""

    @abstractmethod
    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        """Run all jobs and return their outcomes, in the order of `jobs`.

        Jobs are started in this order when workers are free. Jobs of one ``share`` are given to the same worker if
        possible. `tell` is called with every `Event` in the calling thread. An exception in `tell` stops all jobs.
        """


@dataclass(frozen=True)
class Local(Executor):
    """Runs jobs in processes of this machine, one thread each.

    Each worker is a `pebble.ProcessPool` of one process. The process is started with ``spawn`` and runs many jobs. If
    a worker dies or exceeds the time limit of its job, it is replaced. As with `multiprocessing`, a script that uses
    this class needs ``if __name__ == "__main__":``.

    Parameters
    ----------
    workers : int
        Number of processes. 0 means the number of cores that this process may use.
    logs : Path, optional
        Folder for the output of the workers. By default, their output is discarded.
    """

    workers: NonNegativeInt = 0
    logs: Path | None = None

    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        if not jobs:
            return []
        jobs_left = _JobQueue(jobs)
        events: queue.SimpleQueue[Event | BaseException] = queue.SimpleQueue()
        n_workers = min(self.workers or available_cores(), len(jobs))
        workers = [_Worker(k, jobs_left, events, self.logs) for k in range(n_workers)]
        outcomes: dict[int, JobOutcome] = {}
        with environment(**_ONE_THREAD):  # processes inherit it when they start
            for worker in workers:
                worker.start()
            try:
                while len(outcomes) < len(jobs):
                    event = events.get()
                    if isinstance(event, BaseException):
                        raise event
                    if event.outcome is not None:
                        outcomes[event.job] = event.outcome
                    tell(event)
            finally:
                for worker in workers:
                    worker.stopped.set()
                for worker in workers:
                    worker.join()
        return [outcomes[k] for k in range(len(jobs))]


class _JobQueue:
    """Jobs that wait for a worker."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self.jobs = jobs
        self._waiting = list(range(len(jobs)))
        self._share_of: dict[int, str] = {}
        self._lock = threading.Lock()

    def take(self, worker: int) -> int | None:
        """The next job of a worker: from its last share, else from a share of no other worker, else the first."""
        with self._lock:
            if not self._waiting:
                return None
            other_shares = {share for w, share in self._share_of.items() if w != worker}

            def rank(k: int) -> tuple[bool, bool]:
                share = self.jobs[k].get("share", "")
                return share != self._share_of.get(worker), share in other_shares

            chosen = min(self._waiting, key=rank)
            self._waiting.remove(chosen)
            self._share_of[worker] = self.jobs[chosen].get("share", "")
            return chosen


class _Worker(threading.Thread):
    """The thread that gives jobs to one process and reports their events."""

    def __init__(
        self,
        number: int,
        jobs_left: _JobQueue,
        events: queue.SimpleQueue[Event | BaseException],
        logs: Path | None,
    ) -> None:
        super().__init__(daemon=True)
        self.stopped = threading.Event()
        self._number, self._queue, self._events = number, jobs_left, events
        self._log = None if logs is None else logs / f"worker-{number}.log"
        self._pool: Any = None

    def run(self) -> None:
        try:
            while not self.stopped.is_set():
                k = self._queue.take(self._number)
                if k is None:
                    return
                outcome = self._do(k)
                if outcome is not None:
                    self._events.put(Event("ended", k, outcome=outcome))
        except BaseException as error:
            self._events.put(error)
        finally:
            self._close_pool()

    def _do(self, k: int) -> JobOutcome | None:
        """Run a job up to ``tries`` times; None if the worker is stopped."""
        from pebble import ProcessExpired

        job = self._queue.jobs[k]
        tries = int(job.get("tries", 1))
        reason = ""
        for attempt in range(1, tries + 1):
            self._events.put(Event("started", k))
            try:
                outcome = self._try(job)
            except TimeoutError:
                reason = f", the last time because it took longer than {job['timeout_s']:g} s"
            except ProcessExpired as error:
                code = error.exitcode
                reason = f", the last time {f'by signal {-code}' if code < 0 else f'with exit code {code}'}"
            except BrokenProcessPool:
                reason = ", the last time before it began"
            else:
                return None if outcome is None else replace(outcome, tries=attempt)
            self._close_pool()
            self._events.put(Event("lost", k))
        log_hint = [] if self._log is None else [f"log: {self._log}"]
        hints = ("if memory ran out: use fewer workers or a smaller scene", *log_hint)
        return JobOutcome("failed", f"its worker died {times(tries)}{reason}", hints, tries=tries)

    def _try(self, job: Job) -> JobOutcome | None:
        """Run a job once; None if the worker is stopped.

        Raises TimeoutError, ProcessExpired or BrokenProcessPool if the process took too long or died.
        """
        if self._pool is None:
            self._open_pool()
        future = self._pool.schedule(perform, args=(dict(job),), timeout=job.get("timeout_s") or None)
        while not self.stopped.is_set():
            if wait([future], _POLL_S).done:
                outcome: JobOutcome = future.result()
                return outcome
        return None

    def _open_pool(self) -> None:
        from pebble import ProcessPool

        context = multiprocessing.get_context("spawn")
        log = os.devnull if self._log is None else str(self._log)
        self._pool = ProcessPool(1, initializer=_initialise, initargs=(log,), context=context)

    def _close_pool(self) -> None:
        if self._pool is not None:
            self._pool.stop()
            self._pool.join()
        self._pool = None


def times(n: int) -> str:
    """``1 time``, ``2 times``."""
    return f"{n} time{'s' if n > 1 else ''}"


# In the worker process:


def _initialise(log: str) -> None:
    """Prepare a worker process: output to the log, one thread, and exit when the study ends."""
    import cv2

    target = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    sys.stdout.flush()
    os.dup2(target, 1)
    os.dup2(target, 2)
    os.close(target)
    cv2.setNumThreads(1)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """Exit as soon as the process of the study has ended, even during a job."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
