"""The benchmarks run from end to end in their small form. No time is judged here."""

from __future__ import annotations

import csv
import subprocess
import sys

from tests.conftest import REPOSITORY


def test_smoke(tmp_path):
    command = [sys.executable, str(REPOSITORY / "experiments/benchmarks/speed.py"), "--smoke"]
    refused = subprocess.run(command, capture_output=True, text=True)
    assert refused.returncode == 2
    assert "would overwrite the results" in refused.stderr
    subprocess.run([*command, "--clock", "cpu", "--out", str(tmp_path)], check=True, capture_output=True)
    with (tmp_path / "speed.csv").open(newline="") as file:
        lines = {r["what"]: r for r in csv.DictReader(file)}
    with (REPOSITORY / "experiments/benchmarks/speed.csv").open(newline="") as file:
        kept = {r["what"]: r for r in csv.DictReader(file)}
    assert list(lines) == list(kept)
    assert lines["array components / particles 0.4"]["median"] == "not measured"
    # What is committed was measured with the peers, and meets its targets.
    for line in kept.values():
        if line["target"]:
            assert float(line["median"]) <= float(line["target"].removeprefix("<= ")), line


def test_fusion_smoke(tmp_path):
    command = [sys.executable, str(REPOSITORY / "experiments/benchmarks/fusion.py"), "--smoke"]
    refused = subprocess.run(command, capture_output=True, text=True)
    assert refused.returncode == 2
    assert "would overwrite the results" in refused.stderr
    # It ends at once where both programs do not make the same labels of the same random decisions.
    subprocess.run([*command, "--out", str(tmp_path)], check=True, capture_output=True)
    lines, kept = [], []
    for path, into in ((tmp_path, lines), (REPOSITORY / "experiments/benchmarks", kept)):
        with (path / "fusion.csv").open(newline="") as file:
            into.extend(csv.DictReader(file))
    assert [(r["unit"], r["target"] != "") for r in lines] == [(r["unit"], r["target"] != "") for r in kept]
    meets = {"<=": lambda found, bound: found <= bound, ">=": lambda found, bound: found >= bound}
    targets = [(r, *r["target"].split()) for r in kept if r["target"]]
    assert len(targets) == 4
    for line, sign, bound in targets:
        assert meets[sign](float(line["median"]), float(bound)), line["what"]
