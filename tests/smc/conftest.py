"""The tests of the filter core run where only numpy, scipy, pytest and hypothesis are installed."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest

#: What some tests need besides; with all of them installed no test is skipped for their sake.
FURTHER = ("filterpy", "emcee", "torch", "pebble", "joblib", "networkx", "pydantic", "xarray", "matplotlib")

# Modules that need a package at their top.
_NEEDS = {"test_stream_names.py": "pydantic", "test_guided_proposals.py": "filterpy"}
collect_ignore = [module for module, package in _NEEDS.items() if find_spec(package) is None]


def pytest_report_header() -> str:
    missing = [name for name in FURTHER if find_spec(name) is None]
    return (
        f"filter core: tests that need {', '.join(missing)} are skipped" if missing else "filter core: all packages"
    )


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: Any) -> Iterator[Any]:
    """A test that needs a package which is not installed is skipped."""
    try:
        return (yield)
    except ModuleNotFoundError as error:
        if error.name in FURTHER and find_spec(error.name) is None:
            pytest.skip(f"{error.name} is not installed")
        raise
