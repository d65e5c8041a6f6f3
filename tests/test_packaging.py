"""Presets are found in a checkout, in an editable install and in a wheel; the wheel holds all it needs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile

import pytest

import mstfilter
from tests.conftest import REPOSITORY

ASK = (
    "import mstfilter, pathlib; from mstfilter.base.resources import *; "
    "from mstfilter.runs.presets import load_config; "
    "[load_config(n) for n in preset_names()]; "
    "print(pathlib.Path(mstfilter.__file__).parent, models_folder(), *preset_names(), sep='\\n')"
)


def ask(tmp_path, *flags, **environment):
    """Where a fresh interpreter, started elsewhere, finds package and presets."""
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, *flags, "-c", ASK],
        cwd=tmp_path,
        env={**clean, **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    package, folder, *names = done.stdout.split("\n")[:-1]
    assert sorted([*names, "base"]) == sorted(path.stem for path in (REPOSITORY / "models").glob("*.toml"))
    return package, folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    pytest.importorskip("hatchling", reason="hatchling absent: pip install -e '.[dev]'")
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return next(out.glob("*.whl"))


def test_versions_agree():
    """The places that a release changes: version and date."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    citation = dict(re.findall(r"^(version|date-released): (\S+)$", (REPOSITORY / "CITATION.cff").read_text(), re.M))
    assert project["version"] == mstfilter.__version__ == citation["version"]
    notes = re.findall(r"^## \[(\S+)\] - (\S+)$", (REPOSITORY / "CHANGELOG.md").read_text(), re.M)
    assert notes[0] in {(project["version"], citation["date-released"]), (project["version"], "unreleased")}


def test_in_a_wheel(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    programs = {f"mstfilter/_models/{name}.py" for name in ("published/cob", "mst_training/border")}
    assert {"mstfilter/_models/mst.toml", *programs} <= set(names)
    assert "mstfilter/_examples/resampler.py" in names
    assert "mstfilter/_examples/scenes/transition.py" in names
    assert {"mstfilter/app/report/templates/viewer.html", "mstfilter/app/report/figures.mplstyle"} <= set(names)
    assert "mstfilter/py.typed" in names
    assert any(
        name.startswith("mstfilter/app/report/") and name.endswith((".html", ".j2", ".jinja")) for name in names
    )
    assert not [
        name for name in names if name.startswith(("tests/", "experiments/", "docs/")) or name.endswith(".pyc")
    ]
    package, folder = ask(tmp_path, PYTHONPATH=str(tmp_path / "site"))
    assert package == str(tmp_path / "site" / "mstfilter")
    assert folder == str(tmp_path / "site" / "mstfilter" / "_models")


def test_in_an_editable_install(tmp_path):
    """The environment that `make` sets up is one: a .pth file leads to the checkout."""
    package, folder = ask(tmp_path, "-P")
    if package != str(REPOSITORY / "mstfilter"):
        pytest.skip(f"mstfilter is not installed in editable form from here, but from {package}")
    assert folder == str(REPOSITORY / "models")


def test_ci_builds_the_documentation():
    for path in (".github/workflows/test.yml", ".ci/run"):
        assert "make docs" in (REPOSITORY / path).read_text(), path
