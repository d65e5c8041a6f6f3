"""Commands about data: convert, quality."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from mstfilter.cli.root import FormatOption, Options, Pauses, app
from mstfilter.cli.shared import bar, read_source


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Folder or file of a format that `mstfilter list format` shows.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    format: FormatOption = "",
    option: Options = None,
    pauses: Pauses = "",
    frames: Annotated[str, typer.Option(help="Frames of a folder of pairs, separated by commas.")] = "",
) -> None:
    """Write data of another format as a recording. Stopped or failed, it leaves nothing behind."""
    from mstfilter.formats import check_writable, save_recording

    check_writable(out)
    recording = read_source(source, format, option, pauses, frames)
    generator = recording.manifest.get("generator") or f"converted from {source.name}"
    try:
        with bar("convert") as advance:
            save_recording(recording, out, progress=advance, generator=generator)
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        raise typer.Exit(130) from None
    print(f"recording   {out}")
    marks = ", ".join(f"{p} ({recording.times[p]:.1f} s)" for p in recording.pauses[:12])
    more = ", ..." if len(recording.pauses) > 12 else ""
    print(f"pauses      {len(recording.pauses)} of {len(recording)} frames: {marks}{more}")


@app.command()
def quality(
    run: Annotated[Path, typer.Argument(help="Run folder, or label volumes (.npz or .npy).")],
    truth: Annotated[Path, typer.Argument(help="Recording that holds the truth, or its voxels.npz.")],
    csv: Annotated[Path | None, typer.Option(help="Also write the table into this file.")] = None,
    format: FormatOption = "",
    option: Options = None,
) -> None:
    """Score the hypotheses of a run against the truth, beside trivial baselines."""
    from statistics import fmean

    from mstfilter.runs import read_estimate, read_truth, score_pauses, write_scores

    volumes = truth.is_file() and truth.suffix in (".npz", ".npy")
    known = truth if volumes else read_source(truth, format, option, "")
    rows = score_pauses(read_estimate(run), read_truth(known))
    if csv is not None:
        write_scores(csv, rows)
    names = ("mean", "weighted", "best", "top", "one_blob", "components")
    print(f"{'pause':<7}{'form':<9}{'n':>4}" + "".join(f"{name:>12}" for name in names))
    for row in rows:
        print(f"{row.pause:<7}{row.form:<9}{row.n:>4}" + "".join(f"{getattr(row, name):>12.3f}" for name in names))
    for form in dict.fromkeys(row.form for row in rows):
        these = [row for row in rows if row.form == form]
        print(f"{'all':<7}{form:<9}{'':>4}" + "".join(f"{fmean(getattr(r, n) for r in these):>12.3f}" for n in names))
    if rows[0].where == "image":
        print("scored in the image: hypotheses are projected, hidden parts do not count")
