"""The trials of the study runner run from end to end in their small form."""

from __future__ import annotations

import csv
import os
import subprocess
import sys

import pytest

from tests.conftest import REPOSITORY


@pytest.mark.parametrize(("script", "table", "rows"), [("trials", "results", 3), ("sharing", "sharing", 3)])
def test_smoke(tmp_path, script, table, rows):
    command = [sys.executable, str(REPOSITORY / f"experiments/study_runner/{script}.py"), "--smoke"]
    environment = {**os.environ, "MSTFILTER_CACHE": str(tmp_path / "cache")}
    subprocess.run([*command, "--out", str(tmp_path)], check=True, capture_output=True, env=environment)
    with (tmp_path / f"{table}.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    assert len(found) == rows
    if script == "trials":
        assert all(row["done"] == row["runs"] for row in found)
