"""The typer application to which modules add commands, and functions that several commands use."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mstfilter import __version__

if TYPE_CHECKING:
    from mstfilter.app.report import RunNumbers
    from mstfilter.runs import RunFolder

app = typer.Typer(
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
FormatOption = Annotated[
    str, typer.Option(metavar="NAME", help="Format, or ./file.py:Class. Default: detected; `mstfilter list format`.")
]
Options = Annotated[
    list[str] | None,
    typer.Option(
        "--option", "-o", metavar="FIELD=VALUE", help="A field of the format, such as K=525,525,319.5,239.5."
    ),
]
Pauses = Annotated[
    str,
    typer.Option(
        metavar="RULE", help="Pauses of a video: still, settled, ends, every, frames 0,40,85, seconds 0s,4.2s."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random streams.")]


def _version(wanted: bool) -> None:
    if wanted:
        print(f"mstfilter {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Show messages on the progress of a command.")] = False,
) -> None:
    """Options of all commands."""


def safe_name(name: str) -> str:
    """The name without characters that have a meaning in paths."""
    return re.sub(r"[^\w.-]+", "-", name).strip(".-") or "recording"


def read_source(path: Path, format: str, options: list[str] | None, pauses: str) -> Any:
    """Open a recording of any format."""
    from rich.console import Console

    from mstfilter.formats import open_recording

    with Console(stderr=True).status(f"reading {path.name}"):  # shown on a terminal only
        return open_recording(path, format, options or (), pauses)


def print_summary(run: RunFolder, numbers: RunNumbers) -> None:
    """Print for each pause what changed and what is believed, then hypotheses, ESS and quality."""
    from textwrap import fill

    from mstfilter.app.report.answer import answers_of_run

    indent = 12 * " "
    for t, (step, (answer, happened)) in enumerate(zip(numbers.steps, answers_of_run(run), strict=True)):
        text = " ".join([*happened, *answer.sentences])
        print(fill(f"{f'pause {t}':<12}{text}", 100, subsequent_indent=indent))
        n = len(step.objects)
        line = f"{n} {'hypothesis' if n == 1 else 'hypotheses'}"
        line += f", ESS {step.info['ess']:.1f} of {step.info['n_candidates']} candidates"
        if step.mean is not None:
            line += f", quality {step.mean:.3f} (mean), {step.best:.3f} (best)"
        if step.image_score is not None:
            line += f", quality in the image {step.image_score.mean:.3f} (mean), {step.image_score.best:.3f} (best)"
        print(indent + line)
    for sentence in numbers.value_of_the_past:
        print(sentence)
