"""Jobs on a running Dask scheduler, on this or on other machines. Needs the extra ``dask``.

>>> Cluster("tcp://head:8786").run(jobs, tell)

This module neither starts nor stops the scheduler and its workers. All machines must see the study folder and the
cache under the same paths and have the same version of mstfilter. If a worker dies, the scheduler gives its job to
another worker. After ``allowed-failures`` (3) deaths, the job has failed. If a job exceeds its time limit, the
worker's nanny restarts the process of the worker. If no worker is left for a while, an error ends the wait.

A worker sends the outcome of a job as an event, not as the value of the task. So the outcome remains if it dies
later.
"""

from __future__ import annotations

import collections
import contextlib
import queue
import time
import uuid
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mstfilter.errors import InputError, InputWarning, missing_library
from mstfilter.study.executors import Event, Executor, Tell, times
from mstfilter.study.jobs import perform
from mstfilter.study.results import Job, JobOutcome

_CHECK_INTERVAL_S = 0.5  # of workers and time limits


@dataclass(frozen=True)
class Cluster(Executor):
    """A Dask scheduler.

    Parameters
    ----------
    address : str
        Address, for example ``tcp://head:8786``.
    connect_s : float
        Time limit in seconds for the first answer of the scheduler, and for its first worker.
    without_workers_s : float
        `run` raises InputError if the scheduler later has no workers for this time in seconds.
    """

    address: str
    connect_s: float = 10.0
    without_workers_s: float = 300.0

    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        if not jobs:
            return []
        self._warn_without_tls()
        with self._client() as client:
            _check_workers(client, self.connect_s)
            return _ClusterRun(client, jobs, tell, self.without_workers_s).run()

    def _warn_without_tls(self) -> None:
        """Warn if the scheduler is on another host without TLS, since any program that reaches it can run code."""
        protocol, _, rest = self.address.rpartition("://")
        host = rest.rpartition(":")[0].strip("[]")
        if protocol not in ("tls", "wss", "inproc") and host not in ("localhost", "::1") and host[:4] != "127.":
            warnings.warn(
                InputWarning(
                    f"the connection to the Dask scheduler at {self.address} has no TLS: everyone in its network can "
                    "run code on its workers and on this machine",
                    "use tls://HOST:PORT with certificates, or a network of trusted machines",
                ),
                stacklevel=3,
            )

    @contextlib.contextmanager
    def _client(self) -> Iterator[Any]:
        try:
            from distributed import Client
        except ImportError as error:
            raise missing_library(error, "the cluster", library="dask.distributed") from error
        try:
            client = Client(self.address, timeout=self.connect_s, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {self.address}: {error}", "start one: dask scheduler"
            ) from error
        with client:
            yield client


class _ClusterRun:
    """The jobs of one call, and the messages of their workers."""

    def __init__(self, client: Any, jobs: Sequence[Job], tell: Tell, without_workers_s: float) -> None:
        self._client, self._jobs, self._tell = client, jobs, tell
        self._without_workers_s = without_workers_s
        self._topic = f"mstfilter-{uuid.uuid4().hex}"
        self._messages: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._futures: dict[int, Any] = {}
        self._outcomes: dict[int, JobOutcome] = {}
        self._running: dict[int, tuple[str, float]] = {}  # job -> its worker, and when the current try began
        self._tries: dict[int, int] = {}
        self._resubmitted: collections.Counter[int] = collections.Counter()
        self._checked = self._had_workers = time.monotonic()

    def run(self) -> list[JobOutcome]:
        self._client.subscribe_topic(self._topic, lambda event: self._messages.put(event[1]))
        try:
            for k in range(len(self._jobs)):
                self._submit(k)
            while len(self._outcomes) < len(self._jobs):
                with contextlib.suppress(queue.Empty):
                    self._receive(self._messages.get(timeout=_CHECK_INTERVAL_S))
                if time.monotonic() - self._checked >= _CHECK_INTERVAL_S:
                    self._check_workers_left()
                    self._check_time_limits()
                    self._checked = time.monotonic()
        finally:
            self._client.cancel(list(self._futures.values()), force=True)
            self._client.unsubscribe_topic(self._topic)
        return [self._outcomes[k] for k in range(len(self._jobs))]

    def _submit(self, k: int) -> None:
        key = f"{self._topic}-{k}-{self._resubmitted[k]}"
        job = dict(self._jobs[k])
        future = self._client.submit(_perform, job, k, self._topic, pure=False, key=key, priority=-k)
        self._futures[k] = future
        future.add_done_callback(lambda future: self._messages.put({"job": k, "future": future}))

    def _receive(self, message: dict[str, Any]) -> None:
        k = message["job"]
        if "future" in message:
            self._futures.pop(k)  # the scheduler forgets the task and does not repeat it if its worker dies
        if k in self._outcomes:
            return
        if "future" in message:
            self._end_without_outcome(k, message["future"])
        elif "outcome" in message:
            outcome = message["outcome"]
            self._end(k, JobOutcome(**{**outcome, "hints": tuple(outcome["hints"])}))
        else:
            if k not in self._tries:
                self._tell(Event("started", k))
            self._tries[k] = self._tries.get(k, 0) + 1
            self._running[k] = (message["started"], time.monotonic())

    def _end_without_outcome(self, k: int, future: Any) -> None:
        """End or repeat a job whose task is done without an outcome."""
        from distributed import KilledWorker

        if future.status in ("cancelled", "lost"):
            self._fail(k, f"the scheduler has dropped it: {future.status}", "repeat the command")
            return
        error = future.exception()
        if not isinstance(error, KilledWorker):
            self._fail(k, f"{type(error).__name__}: {error}", "look at the logs of the cluster")
        elif k not in self._tries and self._resubmitted[k] < len(self._jobs):
            # It only waited for the workers that died. This happens at most once for every other job.
            self._resubmitted[k] += 1
            self._submit(k)
        else:
            n = self._tries[k] = error.allowed_failures + 1
            self._fail(k, f"its worker died {times(n)}", "if memory ran out: give each worker more memory")

    def _fail(self, k: int, error: str, *hints: str) -> None:
        self._end(k, JobOutcome("failed", error, hints, tries=self._tries.get(k, 1)))

    def _end(self, k: int, outcome: JobOutcome) -> None:
        self._running.pop(k, None)
        self._outcomes[k] = outcome
        self._tell(Event("ended", k, outcome=outcome))

    def _check_workers_left(self) -> None:
        """Drop jobs of workers that are gone. Raise InputError if there have been no workers for too long."""
        try:
            workers = self._client.nthreads()
        except OSError:  # the connection is lost, and distributed cancels all futures
            return
        self._running = {k: run for k, run in self._running.items() if run[0] in workers}
        now = time.monotonic()
        if workers:
            self._had_workers = now
        elif now - self._had_workers > self._without_workers_s and self._messages.empty():
            raise InputError(
                f"the Dask scheduler at {self._client.scheduler.address} has had no workers for "
                f"{self._without_workers_s:g} s; {len(self._outcomes)} of {len(self._jobs)} jobs have ended",
                "start workers and repeat the command: it resumes",
            )

    def _check_time_limits(self) -> None:
        now = time.monotonic()
        for k, (worker, began) in list(self._running.items()):
            limit = self._jobs[k].get("timeout_s")
            if not limit or now - began <= limit:
                continue
            del self._running[k]
            last = self._tries[k] >= self._jobs[k].get("tries", 1)
            if last:  # before the worker is restarted, or the scheduler would start the job again
                self._client.cancel([self._futures[k]], force=True)
            hints = ["raise timeout_s, or set it to 0"]
            try:
                self._client.restart_workers([worker], timeout=30, raise_for_error=False)
            except Exception as failure:  # it has no nanny, so the job continues there
                self._client.cancel([self._futures[k]], force=True)
                hints.append(f"{worker} could not be restarted ({failure}): start workers with their nanny")
                last = True
            if last:
                self._fail(k, f"it took longer than {limit:g} s, {times(self._tries[k])}", *hints)


def _check_workers(client: Any, timeout_s: float) -> None:
    """Wait for a worker. Raise InputError if none comes, or if a worker has several threads or another version."""
    from mstfilter import __version__

    try:  # workers may be starting, or starting again after an earlier job
        client.wait_for_workers(1, timeout=timeout_s)
    except TimeoutError as error:
        hint = "start some: dask worker ADDRESS"
        raise InputError(f"the Dask scheduler at {client.scheduler.address} has no workers", hint) from error
    found = client.run(_worker_version)
    for worker, n in client.nthreads().items():
        if n > 1:
            hint = "start workers with --nthreads 1 --nworkers N"
            raise InputError(f"worker {worker} has {n} threads, expected 1", hint)
    for worker, version in found.items():
        if version != __version__:
            hint = "install the same version on all machines"
            raise InputError(f"worker {worker} has mstfilter {version}, this machine has {__version__}", hint)


def _worker_version() -> str:
    from mstfilter import __version__

    return __version__


def _perform(job: Job, k: int, topic: str) -> None:
    """In a worker: do a job and log its start and its outcome as events of the scheduler."""
    import cv2
    from distributed import get_worker

    worker = get_worker()

    def send(**message: Any) -> None:
        worker.log_event(topic, {"job": k, **message})

    cv2.setNumThreads(1)
    send(started=worker.contact_address)
    send(outcome=asdict(perform(job)))
