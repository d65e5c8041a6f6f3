"""The script that times belief queries runs in a small form. No time is judged here."""

from __future__ import annotations

import csv
import subprocess
import sys

from tests.conftest import REPOSITORY


def test_small_form(tmp_path):
    command = [sys.executable, str(REPOSITORY / "experiments/beliefs/speed.py"), "--n", "2", "--repeat", "1"]
    subprocess.run([*command, "--out", str(tmp_path / "speed.csv")], check=True, capture_output=True)
    with (tmp_path / "speed.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    with (REPOSITORY / "experiments/beliefs/speed.csv").open(newline="") as file:
        kept = list(csv.reader(file))
    assert [row[0] for row in rows] == [row[0] for row in kept]
    assert rows[0][1:] == ["n=2", "n=2 rough"]
