"""Every Python example of the README and the documentation runs."""

from __future__ import annotations

import importlib
import re

import numpy as np
import pytest

from mstfilter.scene import render
from tests.conftest import REPOSITORY
from tests.scene.scenes import CAMERA, GRID, table_scene

PAGES = [
    p for p in [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))] if "```python" in p.read_text()
]


def blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)


def _shown(labels):
    """Label image of a scene, in place of the reader's segmentation."""
    return render(labels, GRID, CAMERA).labels


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_examples_run(page, tmp_path, capsys, monkeypatch):
    """The examples of a page run in order in one namespace, with arrays in place of the reader's data."""
    from mstfilter.scene import Hypothesis

    noise = np.random.default_rng(0)
    scenes = [table_scene(shift, noise) for shift in (0, 1, 2)]
    given = {
        "rgb": np.stack([s[0] for s in scenes]),
        "depth": np.stack([s[1] for s in scenes]),
        "K": CAMERA.K,
        "hypotheses": [Hypothesis.from_labels(s[2], GRID) for s in scenes],
    }
    given["segment"] = lambda image: [next(_shown(s[2]) for s in scenes if (s[0] == image).all())]
    monkeypatch.chdir(tmp_path)
    for number, block in enumerate(blocks(page)):
        exec(compile(block, f"{page.name}, example {number + 1}", "exec"), given)
    assert "nan" not in capsys.readouterr().out


def test_the_first_example_of_the_readme_is_short():
    """A user's own arrays give weighted hypotheses in at most six lines."""
    first = next(b for b in blocks(REPOSITORY / "README.md") if "from_arrays" in b)
    lines = [line for line in first.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(lines) <= 6
    assert "weights" in first


@pytest.mark.parametrize("page", sorted((REPOSITORY / "docs/reference").glob("*.md")), ids=lambda p: p.name)
def test_reference_names_modules_that_exist(page):
    for name in re.findall(r"automodule:: (\S+)", page.read_text()):
        importlib.import_module(name)
