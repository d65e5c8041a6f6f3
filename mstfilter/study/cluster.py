"""Jobs on a running Dask scheduler: a cluster, or other machines of one's own. Needs the extra ``dask``.

>>> Cluster("tcp://head:8786").run(jobs, tell)

The scheduler is somebody else's: it is neither started nor stopped here. All machines must see the study's folder and
the cache under the same paths and have the same version of this package. A run whose worker dies goes to another one;
after as many deaths as the scheduler allows (its ``allowed-failures``, 3) it is named and the rest goes on.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mstfilter.errors import InputError, MissingLibraryError
from mstfilter.study.executors import Event, Executor, Job, Outcome, Tell

__all__ = ["Cluster"]


@dataclass(frozen=True)
class Cluster(Executor):
    """A Dask scheduler by its address.

    Parameters
    ----------
    address : str
        For example ``tcp://head:8786``.
    timeout_s : float
        How long the scheduler may take to answer at first.
    """

    address: str
    timeout_s: float = 10.0

    def run(self, jobs: Sequence[Job], tell: Tell) -> list[Outcome]:
        """Run all jobs; where those of one share run is the scheduler's choice."""
        if not jobs:
            return []
        outcomes: dict[int, Outcome] = {}
        with self._client() as client:
            from distributed import as_completed

            _check_workers(client)
            futures = {}
            for k, job in enumerate(jobs):
                future = client.submit(_perform, dict(job), pure=False, key=f"mstfilter-{k}-{id(self)}", priority=-k)
                futures[future] = k
                tell(Event("begun", k))
            with contextlib.ExitStack() as stack:
                stack.callback(lambda: client.cancel([f for f in futures if not f.done()], force=True))
                for future in as_completed(list(futures), loop=client.loop):
                    k = futures[future]
                    outcomes[k] = self._outcome(future)
                    tell(Event("ended", k, outcome=outcomes[k]))
        return [outcomes[k] for k in range(len(jobs))]

    def _outcome(self, future: Any) -> Outcome:
        """What became of a job whose future is done."""
        from distributed import KilledWorker

        error = future.exception()
        if error is None:
            result = future.result()
            return Outcome(**{**result, "hints": tuple(result["hints"])})
        if isinstance(error, KilledWorker):
            n = error.allowed_failures + 1
            return Outcome(
                "failed", f"its worker died {n} times", ("if memory ran out: more memory a worker",), tries=n
            )
        return Outcome("failed", f"{type(error).__name__}: {error}", ("look at the logs of the cluster",))

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
            client = Client(self.address, timeout=self.timeout_s, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {self.address}: {error}", "start one: dask scheduler"
            ) from error
        with client:
            yield client


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


def _perform(job: Job) -> dict[str, Any]:
    """In a worker."""
    import cv2

    from mstfilter.study.jobs import perform

    cv2.setNumThreads(1)
    return asdict(perform(job))
