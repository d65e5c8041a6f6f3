"""Every Python example of the README and the documentation runs.

`make docs` executes the pages that are notebooks, so `make test` runs the examples of the other pages only.
"""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest

import mstfilter
from mstfilter.scene import render
from tests.conftest import REPOSITORY
from tests.scene.scenes import CAMERA, GRID, table_scene

PAGES = [
    p
    for p in [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
    if re.search(r"^```(python|{code-cell})", p.read_text(), flags=re.MULTILINE)
]
#: Other libraries, which one page compares with this one.
PEERS = ("particles", "stonesoup")


def is_notebook(page):
    return page.read_text().startswith("---\nfile_format: mystnb")


def blocks(page):
    """Python examples of a page, without the options of notebook cells."""
    cells = re.findall(
        r"^```(?:python|{code-cell})\n(?::[^\n]*\n)*(.*?)```", page.read_text(), flags=re.DOTALL | re.MULTILINE
    )
    return [cell.lstrip("\n") for cell in cells]


def run_cell(code, name, given):
    """Execute a cell; what its last line returns is shown as a notebook shows it."""
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, name, "exec"), given)
    if last is not None:
        value = eval(compile(ast.Expression(last.value), name, "eval"), given)
        for show in ("__repr__", "_repr_html_", "_repr_png_"):
            getattr(value, show, str)()


def _shown(labels):
    """Label image of a scene, in place of the reader's segmentation."""
    return render(labels, GRID, CAMERA).labels


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.name, marks=[pytest.mark.nightly] * is_notebook(p)) for p in PAGES]
)
def test_examples_run(page, tmp_path, capsys, monkeypatch):
    """The examples of a page run in order in one namespace; those that are no notebook get the reader's arrays."""
    from mstfilter.scene import Hypothesis

    noise = np.random.default_rng(0)
    scenes = [table_scene(shift, noise) for shift in (0, 1, 2)]
    given = {
        "rgb": np.stack([s[0] for s in scenes]),
        "depth": np.stack([s[1] for s in scenes]),
        "K": CAMERA.K,
        "pauses": [0, 1, 2],
        "hypotheses": [Hypothesis.from_labels(s[2], GRID) for s in scenes],
    }
    given["segment"] = lambda image: [next(_shown(s[2]) for s in scenes if (s[0] == image).all())]
    monkeypatch.chdir(tmp_path)
    absent = []
    given = {} if is_notebook(page) else given
    for number, block in enumerate(blocks(page)):
        try:
            run_cell(block, f"{page.name}, example {number + 1}", given)
        except ModuleNotFoundError as error:
            if error.name not in PEERS:
                raise
            absent.append(error.name)
    plt.close("all")
    assert "nan" not in capsys.readouterr().out
    if absent:
        pytest.skip(f"all examples ran but those of {', '.join(absent)}, which is not installed")


def shown(module):
    """Whether a module has a page in the reference: all but the commands, which ``--help`` describes."""
    return not module.name.startswith(("mstfilter.__main__", "mstfilter.app.cli."))


def test_the_reference_names_what_exists():
    text = (REPOSITORY / "docs" / "reference" / "index.md").read_text()
    modules = re.findall(r"^   (mstfilter\.\S+)$", text, flags=re.MULTILINE)
    assert sorted(modules) == sorted(
        m.name for m in pkgutil.walk_packages(mstfilter.__path__, "mstfilter.") if shown(m)
    )
    listed = {name: module for module, name in re.findall(r"`~(mstfilter\.\S+)\.(\w+)`", text)}
    assert set(listed) == set(mstfilter.__all__) - {"__version__"}
    for name, module in listed.items():
        assert getattr(importlib.import_module(module), name) is getattr(mstfilter, name)
