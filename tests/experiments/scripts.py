"""Helpers of the tests of experiments/: run a script in its small form, import a script as a module."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from unittest import mock

from tests.conftest import REPOSITORY

EXPERIMENTS = REPOSITORY / "experiments"


def run_script(script: str, *arguments: object, expected_exit: int = 0, **environment: object) -> str:
    """Run a script of experiments/; returns its standard output, or standard error if it must fail.

    The script runs in this process, because most of the time of a small form in a new process is spent on imports.
    """
    path = EXPERIMENTS / script
    variables = {name: str(value) for name, value in environment.items()}
    out, error, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.dict(os.environ, variables),
        mock.patch.object(sys, "argv", [str(path), *map(str, arguments)]),
        own_modules(path.parent),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(error),
    ):
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            if isinstance(end.code, str):  # the interpreter prints such a message
                print(end.code, file=sys.stderr)
            code = 1 if isinstance(end.code, str) else end.code or 0
    assert code == expected_exit, error.getvalue()
    return error.getvalue() if expected_exit else out.getvalue()


@contextlib.contextmanager
def own_modules(folder: Path) -> Iterator[None]:
    """Modules of a folder can be imported inside the block; they are removed at its end.

    Modules of several folders have the same name.
    """
    before, path = set(sys.modules), list(sys.path)
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path[:] = path
        for name in set(sys.modules) - before:
            file = getattr(sys.modules[name], "__file__", None)
            if file and Path(file).is_relative_to(EXPERIMENTS):
                del sys.modules[name]


def import_script(script: str) -> ModuleType:
    """A script of experiments/ as a module."""
    path = EXPERIMENTS / script
    name = "_".join(path.relative_to(EXPERIMENTS).with_suffix("").parts)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module
