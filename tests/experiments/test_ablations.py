"""The ablations: the script runs from end to end in its small form, and the committed tables agree with each other.

The small form of the study itself runs with those of the other studies.
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys

import numpy as np
import pytest

from mstfilter.simulation import FIRST_REPORTED_SEED
from mstfilter.study import compare, load_study, make_plan
from tests.conftest import REPOSITORY

FOLDER = REPOSITORY / "experiments/ablations"


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_terms_and_pieces_are_counted(tmp_path):
    environment = {**os.environ, "MSTFILTER_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, str(FOLDER / "candidates.py"), "--smoke", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, env=environment)
    assert [r["term"] for r in rows(tmp_path / "terms.csv")] == ["agreement", "depth", "support", "best"]
    found = {r["pieces"]: float(r["voxels"]) for r in rows(tmp_path / "pieces.csv")}
    assert found["not seen"] >= found["not seen, not carried"] >= 0


def test_committed_tables_are_of_the_study_and_agree():
    plan = make_plan(load_study(FOLDER / "study.toml"))
    assert all(scene.source["seed"] < FIRST_REPORTED_SEED // 10 for scene in plan.scenes), "tuning seeds are 0 - 99"
    quality = {}
    for row in rows(FOLDER / "results/ablations_scenes.csv"):
        quality.setdefault(row["arm"], {})[row["scene"]] = float(row["quality"])
    assert set(quality) == {arm.name for arm in plan.arms}
    assert {frozenset(of_arm) for of_arm in quality.values()} == {frozenset(s.name for s in plan.scenes)}
    table = rows(FOLDER / "results/ablations_pooled_differences.csv")
    assert {row["arm"] for row in table} == {arm.name for arm in plan.arms if not arm.beside} - {"mst"}
    for row in table:
        expected = compare(quality["mst"], quality[row["arm"]])
        found = [float(row[name]) for name in ("mean", "low", "high")]
        np.testing.assert_allclose(found, [expected.mean, expected.low, expected.high], atol=2e-3)
        assert int(row["n"]) == len(plan.scenes) and float(row["p_holm"]) >= float(row["p"])


@pytest.mark.parametrize("name", ["terms", "pieces"])
def test_committed_tables_have_rows(name):
    assert len(rows(FOLDER / f"results/{name}.csv")) >= 2
