"""Small forms of experiments that have no test file of their own: they run to the end, and spare the results."""

from __future__ import annotations

import csv
import math
import runpy
import subprocess
import sys

import pytest

from mstfilter.scene import read_rgb
from tests.conftest import REPOSITORY, find_shared

EXPERIMENTS = REPOSITORY / "experiments"


def lines(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def run(script, *arguments):
    done = subprocess.run(
        [sys.executable, str(EXPERIMENTS / script), *map(str, arguments)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    "script",
    [str(p.relative_to(EXPERIMENTS)) for p in sorted(EXPERIMENTS.glob("*/*.py")) if '"--smoke"' in p.read_text()],
)
def test_small_form_never_overwrites_results(script):
    refused = subprocess.run([sys.executable, str(EXPERIMENTS / script), "--smoke"], capture_output=True, text=True)
    assert refused.returncode == 2 and "would overwrite the" in refused.stderr


def test_full_size(tmp_path):
    assert "peak memory" in run("full_size/run.py", "--smoke", "--out", tmp_path)
    rows = lines(tmp_path / "full_size.csv")
    assert [r["pause"] for r in rows] == ["0", "1"]
    for r in rows:
        assert 0 <= float(r["quality_mean"]) <= 1 and float(r["peak_GiB"]) > 0.05
        parts = [float(v) for k, v in r.items() if k.endswith("_s") and k != "step_s"]
        assert sum(parts) == pytest.approx(float(r["step_s"]), abs=0.01)


def test_readme_picture(tmp_path):
    run("readme_picture/make.py", "--smoke", "--out", tmp_path / "picture.png")
    picture = read_rgb(tmp_path / "picture.png")
    assert picture.shape == (3 * 300 + 2 * 10, 4 * 400 + 3 * 10, 3) and picture.std() > 10


def test_segmentation_fit(tmp_path):
    assert "judged wrongly" in run("segmentation_fit/run.py", "--smoke", "--out", tmp_path / "weights.py")
    made = runpy.run_path(str(tmp_path / "weights.py"))["JOIN_WEIGHTS"]
    present = runpy.run_path(str(REPOSITORY / "mstfilter/segmentation/join_weights.py"))["JOIN_WEIGHTS"]
    assert list(made) == list(present) and all(math.isfinite(w) for w in made.values())
    assert made != present

    run("segmentation_fit/check.py", "--smoke", "--out", tmp_path)
    rows = {r["arm"]: r for r in lines(tmp_path / "quality.csv")}
    assert len(rows) == 7 and float(rows["true masks"]["image"]) == 1.0
    for r in rows.values():
        assert 0 < float(r["space_mean"]) <= float(r["space_best"]) <= 1


def test_tracking_rules(tmp_path):
    run("tracking_rules/run.py", "--smoke", "--out", tmp_path)
    rows = {r["arm"]: r for r in lines(tmp_path / "results.csv")}
    assert len(rows) == 13 and len({(r["n_moved"], r["n_rest"]) for r in rows.values()}) == 1
    assert int(rows["mst"]["n_moved"]) >= 1
    # Nothing that moved has an own IoU of .9, which is what standing still scores.
    assert float(rows["identity"]["iou_moved"]) < 0.9


def test_killed_runs(tmp_path):
    assert "2 ended identically" in run("killed_runs/trials.py", "--trials", 2, "--out", tmp_path)
    assert [r["identical"] for r in lines(tmp_path / "trials.csv")] == ["1", "1"]


def test_miniature(tmp_path):
    run("miniature/run.py", "--smoke", "--out", tmp_path)
    rows = {(r["world"], r["n"], r["arm"]): float(r["tv"]) for r in lines(tmp_path / "distances.csv")}
    assert {key[0] for key in rows} == {"shelf", "row"}
    for (_, _, arm), tv in rows.items():
        assert tv == 0 if arm == "exact" else 0 < tv <= 1
    ranks = [int(v) for r in lines(tmp_path / "calibration.csv") for k, v in r.items() if k.startswith("rank_")]
    assert sum(ranks) == 20 * len(lines(tmp_path / "calibration.csv"))


def test_osd_frames(tmp_path):
    find_shared("real/osd_learn/learn0_rgb.png")
    run("osd_frames/run.py", "--smoke", "--out", tmp_path)
    rows = lines(tmp_path / "frames.csv")
    assert [r["frame"] for r in rows] == ["learn0", "learn2"]
    committed = {r["frame"]: r for r in lines(EXPERIMENTS / "osd_frames/results/frames.csv")}
    floor = "floor: plane + components"  # asks nothing of the other frames
    for r in rows:
        assert r[floor] == committed[r["frame"]][floor]
