"""The resampling study runs from end to end in its small form, and goes on where it was."""

from __future__ import annotations

import csv
import subprocess
import sys

from tests.conftest import REPOSITORY


def test_smoke(tmp_path):
    command = [sys.executable, str(REPOSITORY / "experiments/resampling/run.py"), "--smoke", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    with (tmp_path / "summary.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    from mstfilter.registry import COMPONENTS

    assert {r["scheme"] for r in lines} == set(COMPONENTS["resampler"])
    improper = [r for r in lines if r["measure"].startswith("log_evidence") and r["scheme"] == "keep_weights"]
    assert not improper
    again = subprocess.run(command, check=True, capture_output=True, text=True)
    assert " s\n" not in again.stdout  # nothing is run twice
