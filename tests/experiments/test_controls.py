"""The controls run from end to end in their small form, and go on where they were."""

from __future__ import annotations

import csv
import subprocess
import sys

from tests.conftest import REPOSITORY


def test_smoke(tmp_path, monkeypatch):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    script = REPOSITORY / "experiments/controls/run.py"
    command = [sys.executable, str(script), "--smoke", "--out", str(tmp_path / "out")]
    first = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "s1-0" in first
    with (tmp_path / "out/summary.csv").open(newline="") as file:
        rows = {row["what"]: row for row in csv.DictReader(file)}
    assert float(rows["same hypotheses at the start"]["mean"]) == 1.0
    assert int(rows["a still clip"]["n"]) >= 1
    assert int(rows["stranger - samples"]["n"]) == int(rows["again - samples"]["n"]) == 2
    # Something moved, and to follow it is better than to leave it.
    assert float(rows["moved: mst in order"]["mean"]) > float(rows["moved: frozen in order"]["mean"])
    again = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "'scene'" not in again  # nothing is run twice
