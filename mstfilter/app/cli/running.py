"""Commands about recordings and runs: run, demo, simulate, report, objects, view, convert, quality."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import typer

from mstfilter.app.cli.root import (
    FormatOption,
    Options,
    Overrides,
    Pauses,
    Seed,
    app,
    print_summary,
    read_source,
    safe_name,
)
from mstfilter.app.report.progress import progress_bar
from mstfilter.base.errors import InputError, check_choice
from mstfilter.base.files import atomic_folder, check_output, locked, write_csv, write_text

_DEMO = "occlusion"  # the family of the demo


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
    report: Annotated[bool, typer.Option(help="Write report.html into the run folder.")] = True,
    compare: Annotated[
        bool, typer.Option("--compare", help="Also run the filter without past and on single frames, for the report.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace an earlier run in the run folder after the first step.")
    ] = False,
    threads: Annotated[
        int, typer.Option(min=0, help="Threads of a step, with the same result. 0: all available cores.")
    ] = 0,
    cache: Annotated[int, typer.Option(min=0, help="Largest size of the cache of shared work, in MiB.")] = 768,
    live: Annotated[
        float,
        typer.Option(min=0, metavar="SECONDS", help="Filter images as they arrive, until none arrives for so long."),
    ] = 0,
) -> None:
    """Filter a recording into a run folder, or resume a run that was stopped."""
    from mstfilter.runs.presets import build_filter, load_config

    configs = {"": load_config(preset, overrides or ())}
    if compare:
        from mstfilter.runs import compared_configs

        configs |= compared_configs(configs[""])
    for config in configs.values():
        build_filter(config, allow_files=True)  # a wrong setting is reported before the recording is read
    if out is not None:
        from mstfilter.runs import check_run_folder

        check_run_folder(out, replace)
    else:
        check_output(Path("runs"), folder=True, empty=False)
    from mstfilter.base.processes import available_cores
    from mstfilter.scene import scene_cache

    scene_cache.limit_bytes = cache * 2**20
    threads = threads or available_cores()
    source = None if live else read_source(recording, format, option, pauses)
    name = Path(preset).stem
    title = recording.resolve().name if source is None else source.name
    folder = out or Path("runs") / f"{safe_name(title)}-{safe_name(name)}-{seed}"
    if source is None:
        from mstfilter.formats import open_format
        from mstfilter.runs.live import filter_folder

        if compare:
            raise InputError("--compare needs a complete recording", "run the folder again without --live")
        reader = open_format(recording, format or "redwood", option or (), pauses or "settled")
        filter_folder(
            recording,
            reader,
            configs[""],
            folder,
            seed,
            idle_s=live,
            replace=replace,
            allow_files=True,
            n_threads=threads,
            on_pause=lambda pause: print(f"pause {pause.index}     {pause.latency_s:.2f} s after its last image"),
        )
    else:
        _execute_all(source, configs, folder, seed, replace, threads)
    for name in configs:
        print(f"run         {_compared(folder, name)}")
    from mstfilter.app.report import read_numbers, write_report
    from mstfilter.runs import RunFolder

    run = RunFolder.open(folder)
    numbers = read_numbers(run, beliefs=report or compare)
    if report:
        print(f"report      {write_report(folder, None, numbers)}")
    print_summary(run, numbers)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="New folder for recording, run and report.")] = Path("demo"),
    seed: Seed = 3,
) -> None:
    """Simulate a robot at a cluttered table, filter the recording with and without predictions, write a report."""
    from mstfilter.app.report import read_numbers, write_report
    from mstfilter.formats import open_recording
    from mstfilter.runs import RunFolder, compared_configs
    from mstfilter.runs.presets import load_config

    check_output(out, folder=True)
    with locked(out), atomic_folder(out) as work:
        _simulate(_DEMO, work / "recording", seed)
        recording, config = open_recording(work / "recording"), load_config("mst")
        _execute_all(recording, {"": config} | compared_configs(config), work / "run", 0)
        run = RunFolder.open(work / "run")
        numbers = read_numbers(run)
        write_report(run, work / "report.html", numbers)
    for name, file in (("recording", "recording"), ("run", "run"), ("report", "report.html")):
        print(f"{name:<12}{out / file}")
    print_summary(RunFolder.open(out / "run"), numbers)
    print(f"\nopen {out / 'report.html'} in a browser")


@app.command("simulate")
def simulate_(
    family: Annotated[str, typer.Argument(help="Kind of scene; `mstfilter list families` shows them.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(metavar="[FIELD=VALUE]...", help="Changes to the family: n_objects_max=8 n_actions=2"),
    ] = None,
    seed: Seed = 0,
    objects: Annotated[
        Path | None, typer.Option(help="Folder of meshes (.obj, .glb, .stl, .ply) of which the objects are drawn.")
    ] = None,
) -> None:
    """Simulate a recording with ground truth."""
    named = [] if objects is None else [f"objects={json.dumps(str(objects))}"]
    _simulate(family, out, seed, [*(overrides or ()), *named])
    print(f"recording   {out}")


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help="Run folder, or study folder.")],
    out: Annotated[Path | None, typer.Option(help="HTML file. Default: report.html in the folder.")] = None,
) -> None:
    """Write the report of a run or a study, which need not be finished."""
    if out is not None:
        check_output(out)
    if (run / "study.json").is_file():
        from mstfilter.app.report import write_study_report

        print(f"report      {write_study_report(run, out)}")
        return
    from mstfilter.app.report import write_report

    print(f"report      {write_report(run, out)}")


@app.command()
def objects(
    run: Annotated[Path, typer.Argument(help="Run folder, finished or not.")],
    pause: Annotated[int | None, typer.Option(help="One pause, from 0; -1 is the last. Default: all.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with the open borders.")] = False,
    out: Annotated[Path | None, typer.Option(help="File to write instead: .csv or .json.")] = None,
    reach: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="X Y Z X Y Z", help="What a robot reaches, metres: JSON then has the pushes that tell most."
        ),
    ] = None,
) -> None:
    """Print the objects of a run: where, how certain, visible or hidden, which other object they may belong to."""
    from mstfilter.runs import TABLE_COLUMNS, RunFolder, chosen_pauses, object_rows, pause_documents

    if out is not None:
        check_output(out)
        check_choice("ending of a table of objects", out.suffix.lower(), (".csv", ".json"))
        if as_json and out.suffix.lower() == ".csv":
            raise InputError(f"--json and --out {out} ask for two formats", "the ending of --out decides")
    if reach is not None and not as_json and (out is None or out.suffix.lower() == ".csv"):
        raise InputError("only JSON has pushes", "use --json, or --out with a .json file")
    folder = RunFolder.open(run)
    chosen = chosen_pauses(folder, pause)
    if out is not None and out.suffix.lower() == ".csv":
        write_csv(out, object_rows(folder, chosen), TABLE_COLUMNS)
    elif out is not None or as_json:
        text = json.dumps(pause_documents(folder, chosen, reach and (reach[:3], reach[3:]))) + "\n"
        if out is None:
            sys.stdout.write(text)
        else:
            write_text(out, text)
    else:
        times, tables = folder.description["recording"]["times"], folder.tables(chosen[-1] + 1)
        for t in chosen:
            print(f"pause {t}, {times[t]:.1f} s: {tables[t]!r}")
    if out is not None:
        print(f"objects     {out}")


@app.command()
def view(
    source: Annotated[Path, typer.Argument(help="Run folder, or recording of any format.")],
    out: Annotated[
        Path | None, typer.Option(help="HTML file. Default: view.html in the run, NAME.html here.")
    ] = None,
    format: FormatOption = "",
    option: Options = None,
    pauses: Pauses = "",
) -> None:
    """Write a page that any browser opens: time line, image, voxels, weights, genealogy, truth."""
    from mstfilter.app.report import recording_page, run_page
    from mstfilter.runs import RunFolder

    if out is not None:
        check_output(out)
    if (source / "run.json").is_file():
        if format or option or pauses:
            raise InputError(f"{source} is a run: --format, -o and --pauses are for recordings")
        page, default = run_page(RunFolder.open(source)), source / "view.html"
    else:
        recording = read_source(source, format, option, pauses)
        page, default = recording_page(recording), Path(f"{safe_name(recording.name)}.html")
    print(f"page        {page.save(out or default)}")


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Folder or file of a format that `mstfilter list format` shows.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    format: FormatOption = "",
    option: Options = None,
    pauses: Pauses = "",
) -> None:
    """Convert data of another format to a recording folder; a stopped or failed conversion leaves no folder."""
    from mstfilter.formats import save_recording

    check_output(out, folder=True)
    recording = read_source(source, format, option, pauses)
    generator = recording.manifest.get("generator") or f"converted from {source.name}"
    try:
        with progress_bar("convert") as advance:
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
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    truth: Annotated[Path, typer.Argument(help="Recording with ground truth.")],
    csv: Annotated[Path | None, typer.Option(help="Also write the table into this file.")] = None,
    format: FormatOption = "",
    option: Options = None,
) -> None:
    """Score the hypotheses of a run and trivial baselines against the ground truth."""
    if csv is not None:
        check_output(csv)
    from mstfilter.runs import RunFolder
    from mstfilter.scoring import read_truth, score_pauses

    known = read_truth(read_source(truth, format, option, ""))
    rows = score_pauses(RunFolder.open(run).estimates(), known)
    if csv is not None:
        write_csv(csv, [asdict(row) for row in rows], float_format=".6f")
    names = ("mean", "weighted", "best", "top", "estimate", "one_blob", "components")
    print(f"{'pause':<7}{'form':<9}{'n':>4}" + "".join(f"{name:>12}" for name in names))
    forms = list(dict.fromkeys(row.form for row in rows))
    for row in rows:
        print(f"{row.pause:<7}{row.form:<9}{row.n:>4}" + _numbers([row], names, 12))
    for form in forms:
        print(f"{'all':<7}{form:<9}{'':>4}" + _numbers([row for row in rows if row.form == form], names, 12))
    if rows[0].brier == rows[0].brier:
        print("\nthe weighted set, asked whether two voxels belong to one object (lower is better)")
        scores = ("log_loss", "base_rate", "brier", "calibration_error")
        these = [row for row in rows if row.form == forms[0]]
        print(f"{'pause':<7}" + "".join(f"{name:>19}" for name in scores))
        for row in these:
            print(f"{row.pause:<7}" + _numbers([row], scores, 19))
        print(f"{'all':<7}" + _numbers(these, scores, 19))
        print("base_rate is the log loss of a forecast that knows only how often the answer is yes. The scores are")
        print("those of the forecasts as they come: only studies have other scenes to recalibrate them on.")
    if rows[0].where == "image":
        print("scored in the image: hypotheses are projected, hidden parts do not count")


def _numbers(rows: Sequence[Any], names: Sequence[str], width: int) -> str:
    """The mean over `rows` of each column in `names`, as cells of a table."""
    return "".join(f"{fmean(getattr(row, name) for row in rows):>{width}.3f}" for name in names)


def _simulate(family: str, out: Path, seed: int, overrides: Sequence[str] = ()) -> None:
    from mstfilter.base.registry import settings
    from mstfilter.lab.simulation import SceneFamily, scene_family, simulate_recording
    from mstfilter.runs.presets import REGISTRY

    chosen = REGISTRY.make(SceneFamily, settings(overrides), base=scene_family(family))
    check_output(out, folder=True)
    with progress_bar("simulate") as advance:
        simulate_recording(chosen, seed, out, progress=lambda done, total, what: advance(done, total))


def _execute_all(
    recording: Any,
    configs: dict[str, dict[str, Any]],
    folder: Path,
    seed: int,
    replace: bool = False,
    threads: int = 1,
) -> None:
    """Run the main filter (empty name) in `folder`, and the filters for comparison in the subfolder ``compare``."""
    from mstfilter.runs import filter_recording

    for name, config in configs.items():
        with progress_bar("filter") as advance:
            filter_recording(
                recording,
                config,
                _compared(folder, name),
                seed,
                replace=replace and not name,
                allow_files=True,
                progress=advance,
                n_threads=threads,
            )


def _compared(folder: Path, name: str) -> Path:
    """The folder of the comparison run `name` inside the run folder `folder`; `folder` itself if `name` is empty."""
    return folder / "compare" / name.replace(" ", "-") if name else folder
