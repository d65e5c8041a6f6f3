"""The command train."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mstfilter.cli.root import app


@app.command()
def train(
    part: Annotated[str, typer.Argument(help="What to train: completion or border.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME=VALUE]...", help="Changes to the settings: steps=10000")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the model. Default: trained/PART.")] = None,
    recipe: Annotated[str, typer.Option(help="Settings to start from: cpu, gpu or smoke.")] = "cpu",
    workers: Annotated[int, typer.Option(min=1, help="Processes that make samples.")] = 1,
    device: Annotated[str, typer.Option(help="Device of torch. Default: a GPU if there is one.")] = "",
) -> None:
    """Train a learned part on simulated scenes; the same command resumes a training that was stopped."""
    from mstfilter.errors import check_choice
    from mstfilter.files import check_output

    check_choice("part", part, ("completion", "border"))
    from mstfilter.resources import training_program

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
        f"proposal.tree=border proposal.tree.weights={folder}",
    }
    print(f"model       {folder}; {use[part]}")
    for name, value in (figures or {}).items():
        print(f"{name:28s} {value:.4f}")
