"""The fusion study and what stands beside it run from end to end in their small form."""

from __future__ import annotations

import csv
import subprocess
import sys

from tests.conftest import REPOSITORY


def test_claims_smoke(tmp_path, monkeypatch):
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    script = REPOSITORY / "experiments/fusion/claims.py"
    subprocess.run([sys.executable, str(script), "--smoke", "--out", str(tmp_path)], check=True, capture_output=True)
    with (tmp_path / "claims.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"sample: sample alone", "prediction: prediction alone"} <= {r["claimed by"] for r in rows}
    assert sum(int(r["voxels"]) for r in rows) > 100
    with (tmp_path / "hidden.csv").open(newline="") as file:
        hidden = list(csv.DictReader(file))
    alone = sum(
        int(r["voxels"])
        for r in rows
        if r["claimed by"] == "prediction: prediction alone"
        and r["where"] == "hidden"
        and r["cleared"] in ("<= 0.01", "<= 0.03")
    )
    assert sum(int(r["voxels"]) for r in hidden) == alone > 0
