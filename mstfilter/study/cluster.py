"""Jobs on a running Dask scheduler: a cluster, or other machines of one's own. Needs the extra ``dask``.

>>> Cluster("tcp://head:8786").run(jobs, tell)

The scheduler is somebody else's: it is neither started nor stopped here. All machines must see the study's folder and
the cache under the same paths and have the same version of this package. A run whose worker dies goes to another one;
after as many deaths as the scheduler allows (its ``allowed-failures``, 3) it is named and the rest goes on. A run
that takes too long costs its worker its process, which the nanny of the worker begins anew.
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
from mstfilter.study.executors import Event, Executor, Job, JobOutcome, Tell

__all__ = ["Cluster"]

_LOOK_S = 0.5  # how often it is looked for runs that take too long


@dataclass(frozen=True)
class Cluster(Executor):
    """A Dask scheduler by its address.

    Parameters
    ----------
    address : str
        For example ``tcp://head:8786``.
    tries : int
        How often a run that takes too long is begun before it is named.
    timeout_s : float
        Seconds that one try may take; 0: any.
    connect_s : float
        How long the scheduler may take to answer at first.
    """

    address: str
    tries: int = 3
    timeout_s: float = 0.0
    connect_s: float = 10.0

    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        """Run all jobs; where those of one share run is the scheduler's choice."""
        if not jobs:
            return []
        with self._client() as client:
            _check_workers(client)
            return _Conversation(self, client, tell).run(jobs)

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


class _Conversation:
    """Jobs handed in, and what is heard of them."""

    def __init__(self, settings: Cluster, client: Any, tell: Tell) -> None:
        self._settings, self._client, self._tell = settings, client, tell
        self._heard: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._outcomes: dict[int, JobOutcome] = {}
        self._at: dict[int, tuple[str, float]] = {}  # worker and time of the try that is going on
        self._tries: dict[int, int] = {}

    def run(self, jobs: Sequence[Job]) -> list[JobOutcome]:
        topic = f"mstfilter-{uuid.uuid4().hex}"
        self._client.subscribe_topic(topic, lambda event: self._heard.put(event[1]))
        futures = {}
        try:
            for k, job in enumerate(jobs):
                key = f"{topic}-{k}"
                futures[k] = self._client.submit(_perform, dict(job), k, topic, pure=False, key=key, priority=-k)
                futures[k].add_done_callback(lambda future, k=k: self._heard.put({"job": k, "ended": True}))
            while len(self._outcomes) < len(jobs):
                with contextlib.suppress(queue.Empty):
                    self._hear(self._heard.get(timeout=_LOOK_S), futures)
                self._end_what_hangs(futures)
        finally:
            self._client.cancel([f for k, f in futures.items() if k not in self._outcomes], force=True)
            self._client.unsubscribe_topic(topic)
        return [self._outcomes[k] for k in range(len(jobs))]

    def _hear(self, said: dict[str, Any], futures: dict[int, Any]) -> None:
        k = said["job"]
        if k in self._outcomes:
            return
        if "ended" in said:
            self._end(k, _outcome(futures[k], self._tries.get(k, 1)))
        elif "begun" in said:
            if k not in self._tries:
                self._tell(Event("begun", k))
            self._tries[k] = self._tries.get(k, 0) + 1
            self._at[k] = (said["begun"], time.monotonic())
        else:
            self._tell(Event("step", k, said["done"], said["total"]))

    def _end(self, k: int, outcome: JobOutcome) -> None:
        self._at.pop(k, None)
        self._outcomes[k] = outcome
        self._tell(Event("ended", k, outcome=outcome))

    def _end_what_hangs(self, futures: dict[int, Any]) -> None:
        limit = self._settings.timeout_s
        late = [k for k, (_, began) in self._at.items() if limit and time.monotonic() - began > limit]
        for k in late:
            (worker, _), n = self._at.pop(k), self._tries[k]
            last = n >= self._settings.tries
            if last:  # before its worker goes, or the scheduler would begin it elsewhere
                self._client.cancel([futures[k]], force=True)
            hints = ["raise timeout_s, or set it to 0"]
            try:
                self._client.restart_workers([worker], timeout=30, raise_for_error=False)
            except Exception as error:  # no nanny: it hangs there for good
                self._client.cancel([futures[k]], force=True)
                hints.append(f"{worker} could not be restarted ({error}): start workers with their nanny")
                last = True
            if last:
                why = f"it took longer than {limit:g} s, {n} time{'s' if n > 1 else ''}"
                self._end(k, JobOutcome("failed", why, tuple(hints), tries=n))


def _outcome(future: Any, tries: int) -> JobOutcome:
    """What became of a job whose future is done."""
    from distributed import KilledWorker

    if future.status in ("cancelled", "lost"):
        return JobOutcome(
            "failed", f"the scheduler has given it up: {future.status}", ("repeat the command",), tries=tries
        )
    error = future.exception()
    if error is None:
        result = future.result()
        return JobOutcome(**{**result, "hints": tuple(result["hints"])})
    if isinstance(error, KilledWorker):
        n = error.allowed_failures + 1
        return JobOutcome(
            "failed", f"its worker died {n} times", ("if memory ran out: more memory a worker",), tries=n
        )
    return JobOutcome("failed", f"{type(error).__name__}: {error}", ("look at the logs of the cluster",), tries=tries)


def _check_workers(client: Any) -> None:
    """Raise InputError if there are no workers, or such as would give other results or figures of time."""
    from mstfilter import __version__

    found = client.run(_version)
    if not found:
        raise InputError(
            f"the Dask scheduler at {client.scheduler.address} has no workers", "start some: dask worker ADDRESS"
        )
    threads = {worker: n for worker, n in client.nthreads().items() if n > 1}
    if threads:
        worker, n = next(iter(threads.items()))
        raise InputError(
            f"worker {worker} has {n} threads, expected 1", "start workers with --nthreads 1 --nworkers N"
        )
    other = {worker: version for worker, version in found.items() if version != __version__}
    if other:
        worker, version = next(iter(other.items()))
        raise InputError(
            f"worker {worker} has mstfilter {version}, here it is {__version__}", "install the same on all"
        )


def _version() -> str:
    from mstfilter import __version__

    return __version__


def _perform(job: Job, k: int, topic: str) -> dict[str, Any]:
    """In a worker."""
    import cv2
    from distributed import get_worker

    from mstfilter.study.jobs import perform

    worker = get_worker()

    def say(**what: Any) -> None:
        worker.log_event(topic, {"job": k, **what})

    cv2.setNumThreads(1)
    say(begun=worker.address)
    return asdict(perform(job, lambda done, total: say(done=done, total=total)))
