"""Commands that make many runs or train networks: study, train."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from mstfilter.app.cli.root import app
from mstfilter.app.report.progress import study_bars
from mstfilter.base.errors import InputError
from mstfilter.base.files import check_output

_MOST_FAILURES = 10  # different errors, and hints of each


@app.command()
def study(
    config: Annotated[Path, typer.Argument(help="TOML file of the study.")],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PATH=VALUE]...",
            help="Changes to every arm; a comma makes a grid: n=3,5; or metric=./file.py:Class",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Study folder. Default: studies/NAME.")] = None,
    workers: Annotated[int, typer.Option(min=0, help="Worker processes; 0 is one per core.")] = 0,
    family: Annotated[
        list[str] | None, typer.Option(help="Only the scenes of this family, by its name in the tables; repeatable.")
    ] = None,
    smoke: Annotated[
        bool, typer.Option("--smoke", help="Run the small form that the table `smoke` of the file describes.")
    ] = False,
    cluster: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Run on a cluster: address of a scheduler of dask.")
    ] = "",
    no_report: Annotated[bool, typer.Option("--no-report", help="Do not write report.html at the end.")] = False,
) -> None:
    """Compare filters on many scenes, or resume a study that was stopped."""
    from mstfilter.runs.study import check_arm_names, load_study

    wanted = load_study(config, smoke=smoke)
    if family:
        names = dict.fromkeys(scene.group_name for scene in wanted.scenes)
        if unknown := [name for name in family if name not in names]:
            raise InputError(f"the study has no family {unknown[0]!r}", f"its families are {', '.join(names)}")
        wanted = wanted.model_copy(update={"scenes": tuple(s for s in wanted.scenes if s.group_name in family)})
    check_arm_names(wanted, overrides or ())  # before any large library is imported
    from mstfilter.runs.study import run_study

    folder = out or Path("studies") / f"{wanted.name}{'-smoke' if smoke else ''}"
    check_output(folder, folder=True, empty=False)
    with study_bars() as progress:
        result = run_study(wanted, folder, overrides or (), workers=workers, cluster=cluster, progress=progress)
    print(f"study       {folder}")
    if not no_report:
        from mstfilter.app.report import write_study_report

        print(f"report      {write_study_report(folder)}")
    print(f"runs        {result.done} done, {result.repeated} of them earlier; table {folder / 'runs.csv'}")
    _print_tables(result.folder)
    _print_failures(result.failed)
    if result.failed:
        print(f"hint: the same command repeats the runs that failed; see {folder / 'failures.csv'}", file=sys.stderr)
        raise typer.Exit(1)


def _print_failures(failed: Sequence[tuple[str, Any]]) -> None:
    """Print the first different errors of failed runs, each with its hints once."""
    same: dict[Any, list[str]] = {}
    for name, outcome in failed:
        same.setdefault((outcome.error, tuple(outcome.hints)), []).append(name)
    for (error, hints), (first, *others) in list(same.items())[:_MOST_FAILURES]:
        print(f"failed      {first}{f' and {len(others)} more' if others else ''}: {error}")
        for hint in hints[:_MOST_FAILURES]:
            print(f"hint: {hint}", file=sys.stderr)
    if unseen := sum(map(len, list(same.values())[_MOST_FAILURES:])):
        print(f"failed      {unseen} more runs, with other errors")


def _print_tables(folder: Any) -> None:
    """Print the main tables of a study folder."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    for caption, (head, *rows) in folder.main_tables().values():
        table = Table(*head, caption=caption, caption_justify="left")
        for row in rows:
            table.add_row(*(Text(cell, overflow="fold") for cell in row))
        if rows:
            Console(width=None if sys.stdout.isatty() else 180).print(table)


@app.command()
def train(
    part: Annotated[str, typer.Argument(help="What to train: completion, border or seams.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]...", help="Changes to the settings: steps=10000")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the model. Default: trained/PART.")] = None,
    recipe: Annotated[str, typer.Option(help="Settings to start from: cpu, gpu or smoke.")] = "cpu",
    workers: Annotated[int, typer.Option(min=1, help="Processes that make samples.")] = 1,
    device: Annotated[str, typer.Option(help="Device of torch. Default: a GPU if there is one.")] = "",
) -> None:
    """Train a network on simulated scenes; the same command resumes a training that was stopped."""
    from mstfilter.base.errors import check_choice

    check_choice("part", part, ("completion", "border", "seams"))
    from mstfilter.base.resources import training_program

    trained = getattr(training_program(part), f"{part.capitalize()}Training")
    settings = trained.recipe(recipe, overrides or ())
    folder = out or Path("trained") / part
    check_output(folder, folder=True, empty=False)

    def report(done: int, total: int, text: str) -> None:
        print(f"{done:7d} of {total}  {text}", flush=True)

    figures = training_program("loop").run_training(settings, folder, workers, report, device or None)
    use = {
        "completion": f"use it with update.completer=network update.completer.weights={folder}",
        "border": f"next: python experiments/segmentation_fit/run.py --border {folder}, then use it with "
        f"proposal.tree.weights={folder}",
        "seams": f"use it with proposal.tree=seams proposal.tree.weights={folder}",
    }
    print(f"model       {folder}; {use[part]}")
    for name, value in (figures or {}).items():
        print(f"{name:28s} {value:.4f}")
