"""Helpers of the tests of experiments/: run a script in its small form, import a script as a module."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from types import ModuleType

from tests.conftest import REPOSITORY

EXPERIMENTS = REPOSITORY / "experiments"


def run_script(script: str, *arguments: object, expected_exit: int = 0, **environment: object) -> str:
    """Run a script of experiments/ in a process; returns its standard output, or standard error if it must fail."""
    command = [sys.executable, str(EXPERIMENTS / script), *map(str, arguments)]
    variables = {name: str(value) for name, value in environment.items()}
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables})
    assert done.returncode == expected_exit, done.stderr
    return done.stderr if expected_exit else done.stdout


def import_script(script: str) -> ModuleType:
    """A script of experiments/ as a module."""
    path = EXPERIMENTS / script
    name = "_".join(path.relative_to(EXPERIMENTS).with_suffix("").parts)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module
