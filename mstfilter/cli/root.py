"""The typer application that the command groups register with, and options that several of them share."""

from __future__ import annotations

from typing import Annotated

import typer

from mstfilter import __version__

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
        metavar="RULE", help="Pauses of a video: still, ends, every, frames 0,40,85, seconds 0s,4.2s, a file."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Names all random streams.")]


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
