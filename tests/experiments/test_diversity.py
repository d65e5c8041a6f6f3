"""The diversity study: how it counts readings, and its small form."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from mstfilter.files import read_csv
from tests.experiments.scripts import EXPERIMENTS, run_script


@pytest.fixture
def scenes(monkeypatch):
    monkeypatch.syspath_prepend(str(EXPERIMENTS / "diversity"))
    import scenes

    yield scenes
    del sys.modules["scenes"]


def test_twins_are_one_two_or_missing(scenes):
    truth = np.repeat([0, 1, 2, 3], 10)
    assert scenes.as_one(np.where(truth == 3, 0, truth), truth, (1, 2)) is False
    assert scenes.as_one((truth > 0) * 7, truth, (1, 2)) is True
    assert scenes.as_one(np.where(truth == 2, 0, truth), truth, (1, 2)) is None
    mostly = np.where(np.arange(40) % 10 < 6, 4, truth)  # most of either twin has one label
    assert scenes.as_one(mostly, truth, (1, 2)) is True


@pytest.mark.slow
def test_small_form(tmp_path):
    for _ in range(2):  # the second time no run is left to do
        run_script("diversity/run.py", "--smoke", "--out", tmp_path)
    rows, table = read_csv(tmp_path / "runs.csv"), read_csv(tmp_path / "summary.csv")
    assert len(rows) == 6 * 4 and len(table) == 6
    assert all(int(r["as_one"]) + int(r["as_two"]) + int(r["missing"]) == 5 for r in rows)
