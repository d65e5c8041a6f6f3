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


def test_memory_smoke(tmp_path, monkeypatch):
    """Simulated, known: a wider reach remembers no more; some is remembered, and little of it is occupied."""
    monkeypatch.setenv("MSTFILTER_CACHE", str(tmp_path / "cache"))
    script = REPOSITORY / "experiments/fusion/memory.py"
    subprocess.run([sys.executable, str(script), "--smoke", "--out", str(tmp_path)], check=True, capture_output=True)
    with (tmp_path / "memory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    remembered = [int(r["remembered"]) for r in rows]
    assert remembered == sorted(remembered, reverse=True)
    assert remembered[0] > 0
    assert int(rows[-1]["truly_occupied"]) <= 0.05 * remembered[-1]
