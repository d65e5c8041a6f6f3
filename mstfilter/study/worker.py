"""A worker: a process that reads jobs, one line of JSON each, and writes what becomes of them.

``python -m mstfilter.study.worker``; `local.Local` starts it. It ends when its input does, also in the middle of a
job: a study that was killed leaves no worker behind.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from dataclasses import asdict
from typing import IO, Any

__all__ = ["main"]


def main() -> None:
    """Do jobs until there are no more."""
    # What libraries print goes to the log; answers have a channel of their own.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin, lines), daemon=True).start()
    _one_thread()
    from mstfilter.study.jobs import perform

    while True:
        job = json.loads(lines.get())

        def step(done: int, total: int) -> None:
            _say(answers, {"done": done, "total": total})

        _say(answers, {"outcome": asdict(perform(job, step))})


def _read(source: IO[str], lines: queue.SimpleQueue[str]) -> None:
    for line in source:
        lines.put(line)
    os._exit(0)  # whoever gave the jobs is gone


def _say(answers: IO[str], what: dict[str, Any]) -> None:
    answers.write(json.dumps(what) + "\n")
    answers.flush()


def _one_thread() -> None:
    """One thread a library; those that read no environment variable are told."""
    import cv2

    cv2.setNumThreads(1)


if __name__ == "__main__":
    main()
