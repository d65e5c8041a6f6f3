"""Commands about data: convert."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mstfilter.cli.root import app
from mstfilter.cli.shared import open_recording

__all__ = ["convert"]


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Folder of NAME_rgb.png / NAME_depth.png pairs with info.json.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    frames: Annotated[str, typer.Option(help="Frames in order, separated by commas. Default: all.")] = "",
) -> None:
    """Write data of another layout as a recording."""
    from mstfilter.scene.formats.folder import save

    save(open_recording(source, frames), out, generator=f"converted from {source.name}")
    print(f"recording   {out}")
