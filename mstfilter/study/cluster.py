"""Jobs on a running Dask scheduler, on this or on other machines. Needs the extra ``dask``.

>>> Cluster("tcp://head:8786").run(jobs, tell)

The scheduler and its workers are neither started nor stopped here. All machines must see the study folder and the
cache under the same paths and have the same version of mstfilter. If a worker dies, the scheduler gives its job to
another worker; after its ``allowed-failures`` (3) the job has failed. If a job exceeds its time limit, the process of
its worker is restarted by the worker's nanny.
"""

from __future__ import annotations

import contextlib
import queue
import time
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mstfilter.errors import InputError, MissingLibraryError
from mstfilter.study.executors import Event, Executor, Tell, times
from mstfilter.study.jobs import perform
from mstfilter.study.results import Job, JobOutcome

_CHECK_INTERVAL_S = 0.5  # of time limits


@dataclass(frozen=True)
class Cluster(Executor):
    """A Dask scheduler.

    Parameters
    ----------
    address : str
        For example ``tcp://head:8786``.
    connect_s : float
        Time limit in seconds for the first answer of the scheduler.
    """

    address: str
    connect_s: float = 10.0

    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        if not jobs:
            return []
        with self._client() as client:
            _check_workers(client)
            return _ClusterRun(client, jobs, tell).run()

    @contextlib.contextmanager
    def _client(self) -> Iterator[Any]:
        try:
            from distributed import Client
        except ImportError as error:
            raise MissingLibraryError(
                f"the cluster needs dask.distributed, which cannot be imported: {error}",
                "pip install 'mstfilter[dask]'",
            ) from error
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

    def __init__(self, client: Any, jobs: Sequence[Job], tell: Tell) -> None:
        self._client, self._jobs, self._tell = client, jobs, tell
        self._messages: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._futures: dict[int, Any] = {}
        self._outcomes: dict[int, JobOutcome] = {}
        self._running: dict[int, tuple[str, float]] = {}  # job -> its worker, and when the current try began
        self._tries: dict[int, int] = {}

    def run(self) -> list[JobOutcome]:
        topic = f"mstfilter-{uuid.uuid4().hex}"
        self._client.subscribe_topic(topic, lambda event: self._messages.put(event[1]))
        try:
            for k, job in enumerate(self._jobs):
                future = self._client.submit(
                    _perform, dict(job), k, topic, pure=False, key=f"{topic}-{k}", priority=-k
                )
                self._futures[k] = future
                future.add_done_callback(lambda future, k=k: self._messages.put({"job": k, "ended": True}))
            while len(self._outcomes) < len(self._jobs):
                with contextlib.suppress(queue.Empty):
                    self._receive(self._messages.get(timeout=_CHECK_INTERVAL_S))
                self._check_time_limits()
        finally:
            self._client.cancel([f for k, f in self._futures.items() if k not in self._outcomes], force=True)
            self._client.unsubscribe_topic(topic)
        return [self._outcomes[k] for k in range(len(self._jobs))]

    def _receive(self, message: dict[str, Any]) -> None:
        k = message["job"]
        if k in self._outcomes:
            return
        if "ended" in message:
            self._end(k, _outcome(self._futures[k], self._tries.get(k, 1)))
        elif "started" in message:
            if k not in self._tries:
                self._tell(Event("started", k))
            self._tries[k] = self._tries.get(k, 0) + 1
            self._running[k] = (message["started"], time.monotonic())
        else:
            self._tell(Event("step", k, message["done"], message["total"]))

    def _end(self, k: int, outcome: JobOutcome) -> None:
        self._running.pop(k, None)
        self._outcomes[k] = outcome
        self._tell(Event("ended", k, outcome=outcome))

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
                n = self._tries[k]
                self._end(
                    k, JobOutcome("failed", f"it took longer than {limit:g} s, {times(n)}", tuple(hints), tries=n)
                )


def _outcome(future: Any, tries: int) -> JobOutcome:
    """The outcome of a job whose future is done."""
    from distributed import KilledWorker

    if future.status in ("cancelled", "lost"):
        hints = ("repeat the command",)
        return JobOutcome("failed", f"the scheduler has dropped it: {future.status}", hints, tries=tries)
    error = future.exception()
    if error is None:
        result = future.result()
        return JobOutcome(**{**result, "hints": tuple(result["hints"])})
    if isinstance(error, KilledWorker):
        n = error.allowed_failures + 1
        hints = ("if memory ran out: give each worker more memory",)
        return JobOutcome("failed", f"its worker died {times(n)}", hints, tries=n)
    return JobOutcome("failed", f"{type(error).__name__}: {error}", ("look at the logs of the cluster",), tries=tries)


def _check_workers(client: Any) -> None:
    """Raise InputError if there are no workers, or if a worker has several threads or another version."""
    from mstfilter import __version__

    found = client.run(_worker_version)
    if not found:
        raise InputError(
            f"the Dask scheduler at {client.scheduler.address} has no workers", "start some: dask worker ADDRESS"
        )
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


def _perform(job: Job, k: int, topic: str) -> dict[str, Any]:
    """In a worker: do a job and log its steps as events of the scheduler."""
    import cv2
    from distributed import get_worker

    worker = get_worker()

    def send(**message: Any) -> None:
        worker.log_event(topic, {"job": k, **message})

    cv2.setNumThreads(1)
    send(started=worker.address)
    return asdict(perform(job, lambda done, total: send(done=done, total=total)))
