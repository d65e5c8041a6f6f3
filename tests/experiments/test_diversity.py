"""The diversity study: how it counts, its small form, and what the committed figures say."""

from __future__ import annotations

import csv
import subprocess
import sys

import numpy as np
import pytest

from tests.conftest import REPOSITORY

FOLDER = REPOSITORY / "experiments/diversity"


@pytest.fixture
def scenes(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    import scenes

    yield scenes
    del sys.modules["scenes"]


def lines(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_twins_are_one_two_or_missing(scenes):
    truth = np.repeat([0, 1, 2, 3], 10)
    assert scenes.as_one(np.where(truth == 3, 0, truth), truth, (1, 2)) is False
    assert scenes.as_one((truth > 0) * 7, truth, (1, 2)) is True
    assert scenes.as_one(np.where(truth == 2, 0, truth), truth, (1, 2)) is None
    mostly = np.where(np.arange(40) % 10 < 6, 4, truth)  # most of either twin has one label
    assert scenes.as_one(mostly, truth, (1, 2)) is True


@pytest.mark.slow
def test_the_small_form(tmp_path):
    command = [sys.executable, str(FOLDER / "run.py"), "--smoke", "--out", str(tmp_path)]
    for _ in range(2):  # the second time nothing is left to do
        done = subprocess.run(command, capture_output=True, text=True, timeout=400)
        assert done.returncode == 0, done.stderr
    rows, table = lines(tmp_path / "runs.csv"), lines(tmp_path / "summary.csv")
    assert len(rows) == 6 * 4 and len(table) == 6
    assert all(int(r["as_one"]) + int(r["as_two"]) + int(r["missing"]) == 5 for r in rows)


def test_the_committed_figures():
    """Both readings present at 80 % of the pauses, and the pulled-apart twins never one in 90 % of the runs."""
    table = {row["method"]: row for row in lines(FOLDER / "results/summary.csv")}
    assert int(table["mst"]["runs"]) >= 20
    assert float(table["mst"]["share"]) >= 0.8
    assert float(table["mst"]["share parted"]) >= 0.9
