"""What runs the jobs of a study: processes of this machine (`local`), or a cluster (`cluster`).

An executor is given jobs as plain dictionaries (see `jobs.perform`) and tells what happens. It never fails because
a job does: a job ends with a `JobOutcome`, whatever becomes of it.

>>> outcomes = Local(workers=2).run(jobs, tell=print)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Event", "Executor", "Job", "JobOutcome", "Tell"]

Job = Mapping[str, Any]
"""Plain values: ``kind`` (record, run, measure), ``name``, ``share`` (jobs of one share use the same work), ..."""


@dataclass(frozen=True)
class JobOutcome:
    """How a job ended.

    Parameters
    ----------
    status : {"done", "failed"}
    error : str
        One line: what went wrong.
    hints : tuple of str
        What can be done about it.
    trace : str
        Where it went wrong, for whoever mends the program.
    tries : int
        How often it was begun.
    """

    status: str
    error: str = ""
    hints: tuple[str, ...] = ()
    trace: str = ""
    tries: int = 1


@dataclass(frozen=True)
class Event:
    """Something that happened to a job.

    Parameters
    ----------
    kind : {"begun", "step", "lost", "ended"}
        "lost": its worker died; it will be begun again if tries are left.
    job : int
        Its place in the list.
    done, total : int
        Steps of the job, where known.
    outcome : JobOutcome, optional
        Of a job that has ended.
    """

    kind: str
    job: int
    done: int = 0
    total: int = 0
    outcome: JobOutcome | None = None


Tell = Callable[[Event], None]


class Executor(ABC):
    """Runs jobs."""

    @abstractmethod
    def run(self, jobs: Sequence[Job], tell: Tell) -> list[JobOutcome]:
        """Run all jobs; their outcomes in the order given.

        Parameters
        ----------
        jobs : sequence of mapping
            Begun in this order as far as workers are free; those of one ``share`` preferably by one worker.
        tell : callable
            Called for every `Event`, in the thread of the caller. What it raises stops everything.
        """


@dataclass
class Queue:
    """Jobs that wait; a worker is given what shares work with what it did before."""

    jobs: Sequence[Job]
    waiting: list[int] = field(default_factory=list)
    at: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.waiting = list(range(len(self.jobs)))

    def take(self, worker: int) -> int | None:
        """The next job of a worker: of the share it is at, else of one where nobody is, else the next."""
        if not self.waiting:
            return None
        others = {share for w, share in self.at.items() if w != worker}

        def rank(k: int) -> tuple[bool, bool]:
            share = self.jobs[k].get("share", "")
            return share != self.at.get(worker), share in others

        chosen = min(self.waiting, key=rank)  # the first of the best
        self.waiting.remove(chosen)
        self.at[worker] = self.jobs[chosen].get("share", "")
        return chosen
