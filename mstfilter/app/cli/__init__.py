"""The command line: it parses arguments, calls the package and prints.

``mstfilter demo`` simulates a recording, filters it and writes a report; ``mstfilter --help`` lists the other
commands. Each module has one group of commands, which are added to `mstfilter.app.cli.root.app` when the module is
imported. A command does no work of its own, so whatever it does can be done in Python too.
"""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

from mstfilter import __version__
from mstfilter.base.errors import (
    InputError,
    InputWarning,
    describe_error,
    exhausted,
    missing_library,
    place_in_user_file,
)
from mstfilter.base.processes import log_lines

_WITHOUT_TYPER = """Usage: mstfilter list [KIND]

Without typer, only `list`, --help and --version are available. For all commands: pip install mstfilter"""

_MOST_HINTS = 10  # of one error or warning


def main(arguments: list[str] | None = None) -> None:
    """Run the command line. Invalid input is reported as one ``error:`` line and exit code 2."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    debug, verbose = "--debug" in given, "--verbose" in given
    given = [a for a in given if a not in ("--debug", "--verbose")]
    try:
        with _warnings_as_lines(), log_lines() if verbose else contextlib.nullcontext():
            _execute(given)
    except SystemExit as end:
        if end.code == 130:  # Ctrl-C
            print(_interrupted(given), file=sys.stderr)
        raise
    except KeyboardInterrupt:
        print(_interrupted(given), file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if debug:
            raise
        sys.exit(_report(error, given))


def _report(error: Exception, given: list[str]) -> int:
    """Print an error, and return the exit code: 2 if the user can correct the error, otherwise 1."""
    place = place_in_user_file(error)
    if isinstance(error, ModuleNotFoundError) and place is None:
        error = missing_library(error, " ".join(["mstfilter", *given[:1]]))
    if isinstance(error, InputError):
        tells_more = place is not None and ": raise " not in place and place not in error.hints
        _print("error", error.message, *error.hints, *([str(place)] if tells_more else []))
        return 2
    if known := exhausted(error):
        _print("error", known.message, *known.hints)
        return 1
    _print("error", describe_error(error), *getattr(error, "__notes__", ()), "--debug shows the traceback")
    return 1


def _execute(given: list[str]) -> None:
    """Execute a command. `list` and help also work without typer."""
    try:
        from mstfilter.app.cli import running, studying, components  # noqa: F401, I001 (in the order of the help)
        from mstfilter.app.cli.root import app
    except ModuleNotFoundError as error:
        command = [word for word in given if not word.startswith("-")]
        if command[:1] == ["list"]:
            from mstfilter.app.cli.listing import print_list

            print_list("".join(command[1:2]))
        elif command:
            raise missing_library(error, f"mstfilter {command[0]}") from error
        else:
            print(f"mstfilter {__version__}" if "--version" in given else _WITHOUT_TYPER)
        return
    app(given, prog_name="mstfilter")


@contextlib.contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """Print an `InputWarning` as one ``warning:`` line with its hints; other warnings are unchanged."""
    with warnings.catch_warnings():
        show_other, shown = warnings.showwarning, set()
        warnings.simplefilter("always", InputWarning)
        # uv does not compile: the first import of higra in Python 3.12 gives 65 warnings about its docstrings
        warnings.filterwarnings("ignore", category=SyntaxWarning, module=r".*\bhigra\b")

        def show(message: Warning | str, *place: Any, **named: Any) -> None:
            if not isinstance(message, InputWarning):
                show_other(message, *place, **named)
            elif message.message not in shown:
                shown.add(message.message)
                _print("warning", message.message, *message.hints)

        warnings.showwarning = show
        yield


def _print(kind: str, message: str, *hints: str) -> None:
    more = [f"{len(hints) - _MOST_HINTS} more hints are not shown"] if len(hints) > _MOST_HINTS else []
    for line in (f"{kind}: {message}", *(f"hint: {hint}" for hint in (*hints[:_MOST_HINTS], *more))):
        print(line, file=sys.stderr)


def _interrupted(given: list[str]) -> str:
    """Message that states how to continue an interrupted command."""
    if given[:1] == ["run"] and any(option.startswith("--live") for option in given):
        return "interrupted: a live run cannot be resumed; its pauses are complete"
    if given[:1] in (["run"], ["study"], ["train"]):
        return "interrupted: repeat the command to resume" + ", without --replace" * ("--replace" in given)
    return "interrupted: the command starts anew if it is repeated"
