"""What several commands share: opening a recording, a progress bar, the lines that sum up a run."""

from __future__ import annotations

import contextlib
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

from mstfilter.errors import InputWarning


def safe_name(name: str) -> str:
    """A name as part of a file name; nothing in it leads to another folder."""
    return re.sub(r"[^\w.-]+", "-", name).strip(".-") or "recording"


def read_source(path: Path, format: str, options: list[str] | None, pauses: str, frames: str = "") -> Any:
    """A recording of any format that is read."""
    from mstfilter.runs import open_source

    names = ",".join(name.strip() for name in frames.split(",") if name.strip())
    chosen = [*(options or []), *([f"frames={names},"] if names else [])]
    from rich.console import Console

    with Console(stderr=True).status(f"reading {path.name}"):  # shown on a terminal only
        return open_source(path, format, chosen, pauses)


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Show what a user should know of the input as one ``warning:`` line and its hints; other warnings as ever."""
    with warnings.catch_warnings():
        usual = warnings.showwarning
        warnings.simplefilter("always", InputWarning)

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not isinstance(message, InputWarning):
                usual(message, category, filename, lineno, file, line)
                return
            print(f"warning: {message.message}", file=sys.stderr)
            for hint in message.hints:
                print(f"hint: {hint}", file=sys.stderr)

        warnings.showwarning = show
        yield


@contextlib.contextmanager
def bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on standard error; yields ``advance_to(done, total)``."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bars = Progress(*columns, console=Console(stderr=True))
    task = bars.add_task(what, total=None)

    def advance(done: int, total: int) -> None:
        bars.start()  # at the first call: an error before it stands alone
        bars.update(task, completed=done, total=total)

    try:
        yield advance
    finally:
        bars.stop()


def summary(run: Path) -> None:
    """A line a pause: hypotheses, their objects, effective number of candidates, quality."""
    from mstfilter.runs import RunFolder

    folder = RunFolder.open(run)
    for t in range(folder.n_pauses):
        info, hypotheses = folder.info(t), folder.hypotheses(t)
        objects = " ".join(str(h.n_objects) for h in hypotheses)
        line = f"pause {t}     {len(hypotheses)} hypotheses of {objects} objects, "
        line += f"ESS {info['ess']:.1f} of {info['n_candidates']} candidates"
        if info["quality"] is not None:
            q = info["quality"]["objects"]
            line += f", quality {sum(q) / len(q):.3f} (mean), {max(q):.3f} (best)"
        print(line)
