"""Progress bars on standard error, for the command line, scripts and notebooks.

>>> with progress_bar("filter") as advance:
...     advance(3, 15)

`ParticleFilter.run`, `run_many`, `filter_recording` and `run_study` show progress bars with ``progress=True``.
"""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable, Iterator
from typing import Any

from mstfilter.base.processes import log_lines


@contextlib.contextmanager
def _bars() -> Iterator[Any]:
    """Bars with a description, the counts, and the elapsed and remaining time."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    bars = Progress(TextColumn("{task.description:<12}"), *columns, console=Console(stderr=True))
    try:
        yield bars
    finally:
        bars.stop()


@contextlib.contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int | None], None]]:
    """A progress bar. Yields ``advance(done, total)``, where an unknown `total` is None."""
    with _bars() as bars:
        task = bars.add_task(what, total=None)

        def advance(done: int, total: int | None) -> None:
            bars.start()  # not before the first call, so that an earlier error is printed without a bar
            bars.update(task, completed=done, total=total)

        yield advance


@contextlib.contextmanager
def study_bars() -> Iterator[Callable[[Any], None]]:
    """A progress bar for a study. Yields a function of a `StudyProgress`. Failed runs are printed above the bar.

    If standard error is not a terminal, or if messages are shown, each finished run is a line of the log instead.
    """
    from rich import get_console

    shown = logging.getLogger("mstfilter").isEnabledFor(logging.INFO)
    if shown or not (sys.stderr.isatty() or get_console().is_jupyter):
        with contextlib.nullcontext() if shown else log_lines():
            yield lambda p: None
        return
    with _bars() as bars:
        task = bars.add_task("runs", total=None)

        def update(p: Any) -> None:
            bars.start()
            failed = f", {p.failed} failed" if p.failed else ""
            bars.update(task, total=p.total, completed=p.done + p.failed, description=f"runs{failed}")
            if p.name and p.outcome is None:
                bars.console.print(f"a worker died in {p.name}", markup=False)
            elif p.name and p.outcome.status != "done":
                bars.console.print(f"failed: {p.name}: {p.outcome.error}", markup=False)

        yield update
