"""What several commands share: opening a recording, a progress bar, the lines that sum up a run."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError

__all__ = ["bar", "open_recording", "safe_name", "summary"]


def safe_name(name: str) -> str:
    """A name as part of a file name; nothing in it leads to another folder."""
    return re.sub(r"[^\w.-]+", "-", name).strip(".-") or "recording"


def open_recording(path: Path, frames: str = "") -> Any:
    """A recording of our own or of a known layout."""
    from mstfilter.scene.formats.paired_images import is_paired, open_paired
    from mstfilter.scene.recording import Recording

    names = [name.strip() for name in frames.split(",") if name.strip()]
    if path.is_dir() and is_paired(path):
        return open_paired(path, names)
    if names:
        raise InputError(f"--frames is for folders of image pairs; {path} is none")
    return Recording.open(path)


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
    """Two lines a pause: hypotheses with weights, objects and quality."""
    from mstfilter.study.run_folder import RunFolder

    folder = RunFolder.open(run)
    for t in range(folder.n_pauses):
        info, hypotheses = folder.info(t), folder.hypotheses(t)
        objects = " ".join(str(h.n_objects) for h in hypotheses)
        line = f"pause {t}     {len(hypotheses)} hypotheses of {objects} objects, ESS {info['ess']:.1f}"
        if info["quality"] is not None:
            q = info["quality"]["objects"]
            line += f", quality {sum(q) / len(q):.3f} (mean), {max(q):.3f} (best)"
        print(line)
