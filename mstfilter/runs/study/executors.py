"""Executors of the jobs of a study. `Local` uses processes of this machine. For a cluster, write an `Executor`.

>>> outcomes = Local(workers=2).run(jobs, tell=print)

A job is a mapping of plain values (see `mstfilter.runs.study.jobs`). A job always ends with a `JobOutcome`. An error
in a job, the death of a worker or an exceeded time limit does not stop the other jobs.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mstfilter.base.fields import Bounded, NonNegativeInt
from mstfilter.base.processes import available_cores, environment, log_lines
from mstfilter.runs.study.jobs import perform
from mstfilter.runs.study.results import Job, JobOutcome

_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"),
    "1",
)

#: ``tell(k, outcome)``: job `k` has ended. None: its worker died or exceeded the time limit, and may try again.
Tell = Callable[[int, JobOutcome | None], None]


class Executor(Bounded, ABC):
    """Runs jobs."""

    @abstractmethod
    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        """Run all jobs and return their outcomes, in the order of `jobs`.

        Jobs start in the order of `jobs`, except that jobs with equal entries ``share`` go to one worker if possible.
        `tell` is called in the thread that called `run`. An exception in `tell` stops all jobs.
        """


@dataclass(frozen=True)
class Local(Executor):
    """Runs jobs in processes of this machine. Each process uses one thread.

    Each worker is a `pebble.ProcessPool` of one process. The process is started with ``spawn`` and runs many jobs. A
    worker that dies or exceeds the time limit of its job is replaced. As with `multiprocessing`, a script that uses
    `Local` needs ``if __name__ == "__main__":``.

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
        n_workers = min(self.workers or available_cores(), len(jobs))
        workers = [_Worker(k, self.logs) for k in range(n_workers)]
        try:
            with environment(**_ONE_THREAD):  # processes inherit it when they start
                return _LocalRun(jobs, tell).run(workers)
        finally:
            for worker in workers:
                worker.close()


class _LocalRun:
    """The jobs of one call of `Local.run`: waiting jobs, running jobs, and the outcomes of ended jobs."""

    def __init__(self, jobs: Sequence[Job], tell: Tell) -> None:
        self._jobs, self._tell = jobs, tell
        self._waiting = list(range(len(jobs)))
        self._share_of: dict[_Worker, str] = {}
        self._tries = [0] * len(jobs)
        self._running: dict[Future[JobOutcome], tuple[_Worker, int]] = {}
        self._outcomes: dict[int, JobOutcome] = {}

    def run(self, workers: Sequence[_Worker]) -> list[JobOutcome]:
        for worker in workers:
            self._start(worker, self._next_job(worker))
        while self._running:
            for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                self._finish(future)
        return [self._outcomes[k] for k in range(len(self._jobs))]

    def _next_job(self, worker: _Worker) -> int | None:
        """The next job: one with the worker's ``share``, else with a ``share`` that no worker has, else the first."""
        other_shares = {share for other, share in self._share_of.items() if other is not worker}

        def rank(k: int) -> tuple[bool, bool]:
            share = self._jobs[k].get("share", "")
            return share != self._share_of.get(worker), share in other_shares

        chosen = min(self._waiting, key=rank, default=None)
        if chosen is not None:
            self._waiting.remove(chosen)
            self._share_of[worker] = self._jobs[chosen].get("share", "")
        return chosen

    def _start(self, worker: _Worker, k: int | None) -> None:
        if k is not None:
            self._tries[k] += 1
            self._running[worker.submit(self._jobs[k])] = worker, k

    def _finish(self, future: Future[JobOutcome]) -> None:
        """Record the outcome of a job and start the next job, or start the job again if its worker died."""
        from pebble import ProcessExpired

        worker, k = self._running.pop(future)
        job, tries = self._jobs[k], self._tries[k]
        try:
            outcome = replace(future.result(), tries=tries)
        except (TimeoutError, ProcessExpired, BrokenProcessPool) as error:
            worker.close()
            self._tell(k, None)
            if tries < int(job.get("tries", 1)):
                self._start(worker, k)
                return
            outcome = worker.failure(error, job, tries)
        self._outcomes[k] = outcome
        self._tell(k, outcome)
        self._start(worker, self._next_job(worker))


class _Worker:
    """A worker process. The first job starts the process. If the process dies, the next job starts a new process."""

    def __init__(self, number: int, logs: Path | None) -> None:
        self._log = None if logs is None else logs / f"worker-{number}.log"
        self._pool: Any = None

    def submit(self, job: Job) -> Future[JobOutcome]:
        from pebble import ProcessPool

        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            log = os.devnull if self._log is None else str(self._log)
            self._pool = ProcessPool(1, initializer=_initialise, initargs=(log,), context=context)
        future: Future[JobOutcome] = self._pool.schedule(
            perform, args=(dict(job),), timeout=job.get("timeout_s") or None
        )
        return future

    def failure(self, error: Exception, job: Job, tries: int) -> JobOutcome:
        """The outcome of a job if its worker died at every try; `error` is the error of the last try."""
        reason = "before it began"
        if isinstance(error, TimeoutError):
            reason = f"because it took longer than {job['timeout_s']:g} s"
        elif code := getattr(error, "exitcode", 0):
            reason = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        hints = ["if memory ran out: use fewer workers or a smaller scene"]
        hints += [] if self._log is None else [f"log: {self._log}"]
        times = f"{tries} time{'s' if tries > 1 else ''}"
        return JobOutcome("failed", f"its worker died {times}, the last time {reason}", tuple(hints), tries=tries)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.stop()
            self._pool.join()
        self._pool = None


# In the worker process:

_OPEN = contextlib.ExitStack()  # until the process ends


def _initialise(log: str) -> None:
    """Prepare a worker process: write output to the log, use one thread, and exit when the study ends."""
    import cv2

    target = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    sys.stdout.flush()
    os.dup2(target, 1)
    os.dup2(target, 2)
    os.close(target)
    cv2.setNumThreads(1)
    _OPEN.enter_context(log_lines())
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """Exit as soon as the process of the study has ended, even during a job."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
