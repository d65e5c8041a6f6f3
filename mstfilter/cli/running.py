"""Commands that filter recordings: run, demo, simulate, report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mstfilter.cli.root import FormatOption, Options, Overrides, Pauses, Seed, app
from mstfilter.cli.shared import bar, read_source, safe_name, summary
from mstfilter.errors import InputError


@app.command()
def run(
    recording: Annotated[
        Path, typer.Argument(help="Recording folder, or data of any format that `mstfilter list format` shows.")
    ],
    overrides: Overrides = None,
    preset: Annotated[str, typer.Option(help="mst, paper, authors, or the path of a .toml file.")] = "mst",
    out: Annotated[Path | None, typer.Option(help="Run folder. Default: runs/RECORDING-PRESET-SEED.")] = None,
    seed: Seed = 0,
    format: FormatOption = "",
    option: Options = None,
    pauses: Pauses = "",
    frames: Annotated[str, typer.Option(help="Frames of a folder of pairs, separated by commas.")] = "",
    report: Annotated[bool, typer.Option(help="Write report.html into the run folder.")] = True,
) -> None:
    """Filter a recording into a run folder. A run that was stopped goes on."""
    from mstfilter.presets import build_filter, load_config

    config = load_config(preset, overrides or ())
    build_filter(config, allow_files=True)  # a wrong setting is reported before the recording is read
    source = read_source(recording, format, option, pauses, frames)
    name = Path(preset).stem
    folder = out or Path("runs") / f"{safe_name(source.name)}-{safe_name(name)}-{seed}"
    _execute(source, config, folder, seed)
    if report:
        _report(folder, None)
    summary(folder)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option(help="Folder for recording, run and report; an earlier demo there is replaced.")
    ] = Path("demo"),
    seed: Seed = 3,
) -> None:
    """Simulate a robot at a cluttered table, filter the recording, write a report."""
    import shutil

    from mstfilter.formats import open_recording
    from mstfilter.presets import load_config

    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file, expected a folder for the demo")
    if out.exists() and any(out.iterdir()):
        known = {"recording", "run", "report.html"}
        strange = sorted(p.name for p in out.iterdir() if p.name.lstrip(".").removesuffix(".partial") not in known)
        if strange:
            raise InputError(
                f"{out} holds something that is not a demo: {strange[0]}", "choose another folder with --out"
            )
        shutil.rmtree(out)
    _simulate("demo", out / "recording", seed)
    _execute(open_recording(out / "recording"), load_config("mst"), out / "run", 0)
    _report(out / "run", out / "report.html")
    summary(out / "run")


@app.command("simulate")
def simulate_(
    family: Annotated[str, typer.Argument(help="Kind of scene; `mstfilter list families` shows them.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    seed: Seed = 0,
) -> None:
    """Simulate a recording with its true volumes."""
    _simulate(family, out, seed)


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help="Run folder, or study folder.")],
    out: Annotated[Path | None, typer.Option(help="HTML file. Default: report.html in the folder.")] = None,
    export: Annotated[Path | None, typer.Option(help="Also write meshes and label images into this folder.")] = None,
    mesh_format: Annotated[str, typer.Option(help="Format of exported meshes: ply, obj or glb.")] = "ply",
    mesh_style: Annotated[str, typer.Option(help="Style of exported meshes: blocky or smooth.")] = "blocky",
) -> None:
    """Write the report of a run or a study, finished or not."""
    if (run / "study.json").is_file():
        from mstfilter.report import write_study_report

        if export is not None:
            raise InputError(f"{run} is a study, only runs can be exported", f"export one of {run / 'runs'}")
        print(f"report      {write_study_report(run, out)}")
        return
    _report(run, out)
    if export is not None:
        from mstfilter.report import export_run
        from mstfilter.runs import RunFolder

        export_run(RunFolder.open(run), export, mesh_format, mesh_style)
        print(f"hypotheses  {export}")


def _simulate(family: str, out: Path, seed: int) -> None:
    from mstfilter.simulation import scene_family, simulate_recording

    chosen = scene_family(family)
    with bar("simulate") as advance:
        simulate_recording(chosen, seed, out, progress=lambda done, total, what: advance(done, total))
    print(f"recording   {out}")


def _execute(recording: Any, config: dict[str, Any], folder: Path, seed: int) -> None:
    from mstfilter.runs import filter_recording

    with bar("filter") as advance:
        filter_recording(
            recording, config, folder, seed, allow_files=True, progress=lambda p: advance(p.done, p.total)
        )
    print(f"run         {folder}")


def _report(run: Path, out: Path | None) -> None:
    from mstfilter.report import write_report
    from mstfilter.runs import RunFolder

    print(f"report      {write_report(RunFolder.open(run), out)}")
