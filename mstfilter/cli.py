"""The command line: parses, calls, prints.

``mstfilter demo`` makes a simulated recording, filters it and writes a report. ``mstfilter --help`` lists the rest.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from mstfilter import __version__
from mstfilter.errors import InputError

__all__ = ["app", "main"]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Particle filtering over scene hypotheses: RGB-D video of a table in, weighted 3-D segmentations out.",
)

Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PATH=VALUE]...", help="Changes to the preset: n=10 resampler=multinomial transition.rule=paper"
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Names all random streams.")]


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; bad input is one clear error and exit code 2."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    debug = "--debug" in given
    given = [a for a in given if a != "--debug"]
    try:
        app(given, prog_name="mstfilter")
    except InputError as error:
        if debug:
            raise
        print(f"error: {error.message}", file=sys.stderr)
        for hint in error.hints:
            print(f"hint: {hint}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from here", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if debug:
            raise
        print(f"error: {type(error).__name__}: {error}", file=sys.stderr)
        print("hint: this is a fault of the program; --debug shows where it happened", file=sys.stderr)
        sys.exit(1)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"mstfilter {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show a traceback where something fails.")] = False,
) -> None:
    """Take the options of all commands."""


@app.command()
def run(
    recording: Annotated[
        Path, typer.Argument(help="Recording folder, or a folder of NAME_rgb.png / NAME_depth.png pairs.")
    ],
    overrides: Overrides = None,
    preset: Annotated[str, typer.Option(help="mst, paper, authors, or the path of a .toml file.")] = "mst",
    out: Annotated[Path | None, typer.Option(help="Run folder. Default: runs/RECORDING-PRESET-SEED.")] = None,
    seed: Seed = 0,
    frames: Annotated[str, typer.Option(help="Frames of a folder of pairs, separated by commas.")] = "",
    report: Annotated[bool, typer.Option(help="Write report.html into the run folder.")] = True,
) -> None:
    """Filter a recording into a run folder. A run that was stopped goes on."""
    from mstfilter.presets import load_config

    config = load_config(preset, overrides or ())
    source = _open(recording, frames)
    name = Path(preset).stem
    folder = out or Path("runs") / f"{_safe(source.name)}-{_safe(name)}-{seed}"
    _execute(source, config, folder, seed)
    if report:
        _report(folder, None)
    _summary(folder)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option(help="Folder for recording, run and report; an earlier demo there is replaced.")
    ] = Path("demo"),
    seed: Seed = 3,
) -> None:
    """Simulate a robot at a cluttered table, filter the recording, write a report."""
    import shutil

    from mstfilter.presets import load_config
    from mstfilter.scene.recording import Recording

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
    _execute(Recording.open(out / "recording"), load_config("mst"), out / "run", 0)
    _report(out / "run", out / "report.html")
    _summary(out / "run")


@app.command()
def simulate(
    family: Annotated[str, typer.Argument(help="Kind of scene; `mstfilter list families` shows them.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    seed: Seed = 0,
) -> None:
    """Simulate a recording with its true volumes."""
    _simulate(family, out, seed)


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    out: Annotated[Path | None, typer.Option(help="HTML file. Default: report.html in the run folder.")] = None,
    export: Annotated[
        Path | None, typer.Option(help="Also write PLY meshes and label images into this folder.")
    ] = None,
) -> None:
    """Write the report of a run folder, finished or not."""
    _report(run, out)
    if export is not None:
        from mstfilter.report.export import export_run
        from mstfilter.study.run_folder import RunFolder

        export_run(RunFolder.open(run), export)
        print(f"hypotheses  {export}")


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Folder of NAME_rgb.png / NAME_depth.png pairs with info.json.")],
    out: Annotated[Path, typer.Argument(help="Recording folder to make.")],
    frames: Annotated[str, typer.Option(help="Frames in order, separated by commas. Default: all.")] = "",
) -> None:
    """Write data of another layout as a recording."""
    from mstfilter.scene.formats.folder import save

    save(_open(source, frames), out, generator=f"converted from {source.name}")
    print(f"recording   {out}")


@app.command("list")
def list_(
    kind: Annotated[str, typer.Argument(help="One kind only: resampler, rule, ..., presets or families.")] = "",
) -> None:
    """List presets, scene families and components with their fields."""
    from mstfilter import registry

    kinds = ["presets", "families", *registry.COMPONENTS]
    wanted = kind.removesuffix("s") if kind.removesuffix("s") in registry.COMPONENTS else kind
    if wanted and wanted not in kinds:
        raise InputError(f"there is no kind of component {kind!r}", f"there are: {', '.join(kinds)}")
    for name in [wanted] if wanted else kinds:
        print(f"{name}:")
        for line in _lines(name):
            print(f"  {line}")


@app.command()
def check(
    component: Annotated[str, typer.Argument(help="./file.py:Class, or KIND.NAME such as resampler.systematic.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[FIELD=VALUE]...", help="Fields that are not the default.")
    ] = None,
) -> None:
    """Test whether a component keeps what its interface promises, and say in words what it does not."""
    from mstfilter import registry
    from mstfilter.presets import settings
    from mstfilter.testing import verify
    from mstfilter.testing.properties import FALSE_ALARM
    from mstfilter.testing.starters import example_of

    kind, _, name = ("", "", component) if ".py:" in component else component.partition(".")
    if ".py:" not in component and kind not in registry.COMPONENTS:
        raise InputError(
            f"{component!r} is no component", "give ./file.py:Class, or KIND.NAME as `mstfilter list` shows"
        )
    cls = registry.find_class(kind, name, component, allow_files=True)
    made = registry.make(cls, settings(overrides or ()), "", allow_files=True)
    failed = statistical = 0
    for outcome in verify(made, example_of(cls)):
        state = "broken" if outcome.broken else "skipped" if outcome.skipped else "holds"
        print(f"{state:<9}{outcome.property.says}")
        if outcome.broken or outcome.skipped:
            print(f"{'':<9}  {outcome.broken or outcome.skipped}  [{outcome.property.name}]")
        failed += outcome.broken is not None
        statistical += outcome.property.statistical and not outcome.skipped
    if statistical:
        print(
            f"{statistical} of these are statistical: each alarms falsely with probability {FALSE_ALARM:.0e} at most"
        )
    verdict = {0: "all properties that apply hold", 1: "1 property is broken"}.get(
        failed, f"{failed} properties are broken"
    )
    print(f"{cls.__name__}: {verdict}")
    if failed:
        raise typer.Exit(1)


@app.command()
def new(
    kind: Annotated[str, typer.Argument(help="resampler, transition, proposal or update.")],
    path: Annotated[Path, typer.Argument(help="Python file to make, for example mine.py.")],
) -> None:
    """Write a commented component of your own that works, and its test."""
    from mstfilter.testing.starters import write_starter

    file, test = write_starter(kind, path)
    print(f"component   {file}")
    print(f"test        {test}")
    print(f"next        mstfilter check {path.parent}/{path.name}:My{kind.capitalize()}")


def _lines(kind: str) -> Iterator[str]:
    """One line a preset, family or component."""
    import tomllib

    from mstfilter import registry
    from mstfilter.resources import find_preset, preset_names

    if kind == "presets":
        for name in preset_names():
            yield f"{name:<20}{tomllib.loads(find_preset(name).read_text()).get('description', '')}"
        return
    if kind == "families":
        from mstfilter.simulation.families import SCENE_FAMILIES

        for name, f in SCENE_FAMILIES.items():
            objects = f"{f.n_objects_min}-{f.n_objects_max}" if f.n_objects_min < f.n_objects_max else f.n_objects_max
            yield (
                f"{name:<20}{objects} objects, {f.n_actions} actions of {f.frames_per_clip} frames, "
                f"{f.width} x {f.height}, voxels {' x '.join(map(str, f.grid().shape))}"
            )
        return
    for name in registry.known(kind):
        cls = registry.find_class(kind, name)
        yield f"{name:<20}{_first_line(cls)}  [{_fields(cls)}]"


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").strip().split("\n")[0].rstrip(".")


def _fields(cls: type) -> str:
    """Fields of a component with their defaults."""
    import dataclasses

    from mstfilter.registry import default_of, name_of

    parts = []
    for field in dataclasses.fields(cls):
        value: Any = default_of(field)
        if value is dataclasses.MISSING:
            parts.append(field.name)
        elif dataclasses.is_dataclass(value):
            parts.append(f"{field.name}={name_of(type(value))}")
        else:
            parts.append(f"{field.name}={value}")
    return ", ".join(parts)


def _safe(name: str) -> str:
    """A name as part of a file name; nothing in it leads to another folder."""
    return re.sub(r"[^\w.-]+", "-", name).strip(".-") or "recording"


def _open(path: Path, frames: str = "") -> Any:
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
def _bar(what: str) -> Iterator[Callable[[int, int], None]]:
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


def _simulate(family: str, out: Path, seed: int) -> None:
    from mstfilter.simulation.families import scene_family
    from mstfilter.simulation.recorder import simulate

    chosen = scene_family(family)
    with _bar("simulate") as advance:
        simulate(chosen, seed, out, progress=lambda done, total, what: advance(done, total))
    print(f"recording   {out}")


def _execute(recording: Any, config: dict[str, Any], folder: Path, seed: int) -> None:
    from mstfilter.study.run import execute

    with _bar("filter") as advance:
        execute(recording, config, folder, seed, allow_files=True, progress=lambda p: advance(p.done, p.total))
    print(f"run         {folder}")


def _report(run: Path, out: Path | None) -> None:
    from mstfilter.report.html import write_report
    from mstfilter.study.run_folder import RunFolder

    print(f"report      {write_report(RunFolder.open(run), out)}")


def _summary(run: Path) -> None:
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
