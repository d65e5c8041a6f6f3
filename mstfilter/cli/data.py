"""Commands about data: convert, quality."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mstfilter.cli.root import Format, Options, Pauses, app
from mstfilter.cli.shared import bar, open_recording

__all__ = ["convert"]


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Folder or file of a format that `mstfilter list format` shows.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    format: Format = "",
    option: Options = None,
    pauses: Pauses = "",
    frames: Annotated[str, typer.Option(help="Frames of a folder of pairs, separated by commas.")] = "",
) -> None:
    """Write data of another format as a recording. Stopped or failed, it leaves nothing behind."""
    from mstfilter.scene.formats.writer import check_writable, save

    check_writable(out)
    recording = open_recording(source, format, option, pauses, frames)
    generator = recording.manifest.get("generator") or f"converted from {source.name}"
    with bar("convert") as advance:
        save(recording, out, progress=advance, generator=generator)
    print(f"recording   {out}")
    marks = ", ".join(f"{p} ({recording.times[p]:.1f} s)" for p in recording.pauses[:12])
    more = ", ..." if len(recording.pauses) > 12 else ""
    print(f"pauses      {len(recording.pauses)} of {len(recording)} frames: {marks}{more}")
