"""The ablations run from end to end in their small form, and what they found is kept."""

from __future__ import annotations

import csv
import os
import subprocess
import sys

import pytest

from tests.conftest import REPOSITORY

FOLDER = REPOSITORY / "experiments/ablations"


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    out = tmp_path_factory.mktemp("ablations")
    environment = {**os.environ, "MSTFILTER_CACHE": str(out / "cache")}
    for script in ("evidence", "candidates"):
        command = [sys.executable, str(FOLDER / f"{script}.py"), "--smoke", "--out", str(out)]
        subprocess.run(command, check=True, capture_output=True, env=environment)
    return out


def test_every_arm_has_a_figure(smoke):
    arms = {r["arm"]: r for r in rows(smoke / "evidence.csv")}
    assert set(arms) == {r["arm"] for r in rows(FOLDER / "results/evidence.csv")}
    assert all(0 < float(r["quality"]) < 1 and r["n"] == "1" for r in arms.values())
    assert float(arms["+support"]["difference to mst"]) == 0  # the same run


def test_terms_and_pieces_are_counted(smoke):
    assert [r["term"] for r in rows(smoke / "terms.csv")] == ["agreement", "depth", "support", "best"]
    found = {r["pieces"]: float(r["voxels"]) for r in rows(smoke / "pieces.csv")}
    assert found["not seen"] >= found["not seen, not carried"] >= 0


def test_differences_are_those_of_the_runs():
    runs = {(r["arm"], r["scene"]): float(r["quality"]) for r in rows(FOLDER / "results/runs.csv")}
    for row in rows(FOLDER / "results/evidence.csv")[1:]:
        own = [(q, runs["mst", scene]) for (arm, scene), q in runs.items() if arm == row["arm"]]
        n = int(row["n"])
        assert len(own) >= n
        if len(own) == n:
            assert abs(sum(a - b for a, b in own) / n - float(row["difference to mst"])) < 2e-4
