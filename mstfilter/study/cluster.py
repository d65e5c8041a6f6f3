"""Jobs on a running Dask scheduler, on this or on other machines. Needs the extra ``dask``.

>>> Cluster("tcp://head:8786").run(jobs, tell)

The scheduler and its workers are neither started nor stopped here. All machines must see the study folder and the
cache under the same paths and have the same code of mstfilter. If a worker dies, the scheduler gives its jobs to
other workers; a job whose workers died more often than its ``allowed-failures`` (3) has failed. A job that exceeds
its time limit ends the process of its worker, which the worker's nanny starts again. Without workers, the jobs wait.
"""

from __future__ import annotations

import contextlib
import faulthandler
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from mstfilter.errors import InputError, InputWarning, missing_library
from mstfilter.study.executors import Executor, Tell
from mstfilter.study.jobs import perform
from mstfilter.study.results import Job, JobOutcome


@dataclass(frozen=True)
class Cluster(Executor):
    """A Dask scheduler.

    Parameters
    ----------
    address : str
        Address, for example ``tcp://head:8786``.
    connect_s : float
        Time limit in seconds for the first answer of the scheduler, and for its first worker.
    """

    address: str
    connect_s: float = 10.0

    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        if not jobs:
            return []
        self._warn_without_tls()
        outcomes: dict[int, JobOutcome] = {}
        with self._client() as client:
            from distributed import as_completed

            _check_workers(client, self.connect_s)
            job_of = {client.submit(_perform, dict(job), pure=False, priority=-k): k for k, job in enumerate(jobs)}
            for future in as_completed(job_of, loop=client.loop):
                k = job_of.pop(future)  # released: it is not computed again if its worker dies later
                outcomes[k] = _outcome(future, jobs[k])
                tell(k, outcomes[k])
        return [outcomes[k] for k in range(len(jobs))]

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


def _outcome(future: Any, job: Job) -> JobOutcome:
    """The outcome of a task that has ended."""
    from distributed import KilledWorker

    try:
        outcome: JobOutcome = future.result()
        return outcome
    except KilledWorker as error:
        tries = error.allowed_failures + 1
        limit = f" or it took longer than {job['timeout_s']:g} s" if job.get("timeout_s") else ""
        message = f"its worker died{limit}, {tries} time{'s' if tries > 1 else ''}"
        return JobOutcome("failed", message, ("if memory ran out: give each worker more memory",), tries=tries)
    except Exception as error:  # such as a task that the scheduler has cancelled
        return JobOutcome("failed", f"{type(error).__name__}: {error}", ("look at the logs of the cluster",))


def _check_workers(client: Any, timeout_s: float) -> None:
    """Wait for a worker. Raise InputError if none comes, or if one has several threads."""
    try:  # workers may be starting, or starting again after an earlier job
        client.wait_for_workers(1, timeout=timeout_s)
    except TimeoutError as error:
        hint = "start some: dask worker ADDRESS"
        raise InputError(f"the Dask scheduler at {client.scheduler.address} has no workers", hint) from error
    for worker, n in client.nthreads().items():
        if n > 1:
            hint = "start workers with --nthreads 1 --nworkers N"
            raise InputError(f"worker {worker} has {n} threads, expected 1", hint)


def _perform(job: Job) -> JobOutcome:
    """In a worker: do a job within its time limit."""
    import cv2

    cv2.setNumThreads(1)
    if not job.get("timeout_s"):
        return perform(job)
    # A timer of the process that needs no Python code: it also ends a job that hangs in a library.
    faulthandler.dump_traceback_later(job["timeout_s"], exit=True, file=2)
    try:
        return perform(job)
    finally:
        faulthandler.cancel_dump_traceback_later()
