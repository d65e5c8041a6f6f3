"""Shared fixtures: where the real data lie, and recordings that are simulated once per session."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Property tests draw the same examples in every run, so that a failure is not a matter of luck.
settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")

REPOSITORY = Path(__file__).resolve().parent.parent


def shared_folder() -> Path:
    """The folder of real data: the environment variable MSTFILTER_SHARED, else ``../shared``."""
    named = os.environ.get("MSTFILTER_SHARED")
    return Path(named) if named else REPOSITORY.parent / "shared"


def find_shared(name: str) -> Path:
    """A path below the shared folder; the test is skipped, with the reason, where it is absent."""
    path = shared_folder() / name
    if not path.exists():
        pytest.skip(f"real data absent: {name} (set MSTFILTER_SHARED to the folder that holds it)")
    return path


@pytest.fixture
def shared_data():
    """``shared_data("r1/quality.npz")`` is the path, or the test is skipped."""
    return find_shared


@pytest.fixture(scope="session", autouse=True)
def recordings(tmp_path_factory):
    """The folder of `cached_recording` in this session: all tests and workers share what one of them has simulated.

    The user's cache is not used: the key of a recording does not depend on the code that makes it.
    """
    base = tmp_path_factory.getbasetemp()
    cache = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MSTFILTER_CACHE", str(cache))
        yield cache / "recordings"
