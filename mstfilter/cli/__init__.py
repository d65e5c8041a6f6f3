"""The command line: parses, calls, prints.

``mstfilter demo`` makes a simulated recording, filters it and writes a report. ``mstfilter --help`` lists the rest.
Each module holds one group of commands; importing it registers them with `mstfilter.cli.root.app`.
"""

from __future__ import annotations

import sys

from mstfilter.cli import running, studying, training, components  # isort: skip (the order of the help page)
from mstfilter.cli.root import app, warnings_as_lines
from mstfilter.errors import InputError, describe_error, exhausted, place_in_user_file
from mstfilter.registry import loaded_components

__all__ = ["app", "components", "main", "running", "studying", "training"]


def main(arguments: list[str] | None = None) -> None:
    """Run the command line. Invalid input is reported as one ``error:`` line and exit code 2."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    debug = "--debug" in given
    given = [a for a in given if a != "--debug"]
    try:
        with warnings_as_lines():
            app(given, prog_name="mstfilter")
    except InputError as error:
        if debug:
            raise
        place = place_in_user_file(error) or ""
        _print_error(error, *([] if not place or ": raise " in place or place in error.hints else [place]))
        sys.exit(2)
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
        if known := exhausted(error):
            _print_error(known)
            sys.exit(1)
        print(f"error: {describe_error(error)}", file=sys.stderr)
        for note in getattr(error, "__notes__", ()):
            print(f"hint: {note}", file=sys.stderr)
        if place_in_user_file(error) is None:
            for component in loaded_components():
                print(f"hint: `mstfilter check {component}` tests the component of this command", file=sys.stderr)
        print("hint: --debug shows the traceback", file=sys.stderr)
        sys.exit(1)


def _print_error(error: InputError, *hints: str) -> None:
    print(f"error: {error.message}", file=sys.stderr)
    for hint in (*error.hints, *hints):
        print(f"hint: {hint}", file=sys.stderr)


def _interrupted(given: list[str]) -> str:
    """What an interrupted command leaves behind."""
    if given[:1] in (["run"], ["study"]):
        return "interrupted: repeat the command to resume"
    return "interrupted: the command starts anew if it is repeated"
