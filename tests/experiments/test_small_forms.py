"""The scripts of experiments/ run in their small form (`--smoke`)."""

from __future__ import annotations

import math
import shutil

import numpy as np
import pytest

from mstfilter.base.files import read_csv
from mstfilter.base.resources import models_folder
from mstfilter.base.trained import open_model
from mstfilter.formats import read_rgb
from mstfilter.mst.segmentation import FEATURES, LearnedTree, PairNetwork
from tests.conftest import find_shared
from tests.experiments.scripts import EXPERIMENTS, run_script

pytestmark = pytest.mark.nightly


def test_benchmark_of_the_filter(tmp_path):
    run_script("benchmarks/speed.py", "--smoke", "--clock", "cpu", "--out", tmp_path)
    rows = {r["what"]: r for r in read_csv(tmp_path / "speed.csv")}
    assert rows["bootstrap SV T=100 n=1000 / particles 0.4"]["median"] == "not measured"


def test_smoothing(tmp_path):
    run_script("benchmarks/smoothing.py", "--smoke", "--out", tmp_path / "smoothing.csv")
    methods = [row["method"] for row in read_csv(tmp_path / "smoothing.csv")]
    assert methods == ["exact", "mcmc", "mcmc, 3 steps", "rejection", "genealogy"]


def test_samplers(tmp_path):
    run_script("benchmarks/samplers.py", "--smoke", "--out", tmp_path / "samplers.csv")
    tasks = [row["task"] for row in read_csv(tmp_path / "samplers.csv")]
    assert len(tasks) == 9 and {"SMC^2", "SMC^2, one by one"} < set(tasks)


def test_calibration_of_the_partition_update(tmp_path):
    """The losses that are minimised are those of the table, and a forecast is better than knowing nothing."""
    run_script("partition_fit/calibration.py", "--smoke", "--out", tmp_path)
    rows = {(row["field"], row["value"]): row for row in read_csv(tmp_path / "calibration.csv")}
    assert float(rows["log_odds", "0.0"]["loss"]) < math.log(2)
    losses = [float(row["loss"]) for (_, value), row in rows.items() if value != "held out"]
    assert float(rows["log_odds", "held out"]["loss"]) >= min(losses) - 1e-4


def test_controls(tmp_path):
    arguments = ("controls/run.py", "--smoke", "--out", tmp_path / "out")
    assert "s1-0" in run_script(*arguments)
    rows = {row["what"]: row for row in read_csv(tmp_path / "out/summary.csv")}
    assert abs(float(rows["mst in order - samples at the start"]["mean"])) < 0.2
    assert int(rows["a still clip"]["n"]) >= 1
    # An object moved, and following it is better than leaving it.
    assert float(rows["moved: mst in order"]["mean"]) > float(rows["moved: frozen in order"]["mean"])
    assert "'scene'" not in run_script(*arguments), "finished scenes are not run again"


def test_past(tmp_path):
    """The differences are those of the means, and nothing is run again."""
    arguments = ("controls/past.py", "--smoke", "--out", tmp_path)
    run_script(*arguments)
    rows = {(row["score"], row["family"], row["arm"]): row for row in read_csv(tmp_path / "past.csv")}
    arms, most = (
        ("samples", "mst", "again", "stranger", "shuffled", "frozen"),
        {"quality": 1, "log_loss": math.log(2)},
    )
    assert set(rows) == {(score, family, arm) for score in most for family in ("all", "s1") for arm in arms}
    mean = {key: float(row["mean"]) for key, row in rows.items()}
    for (score, family, arm), row in rows.items():
        assert 0 < mean[score, family, arm] < most[score] and row["n"] == "2"
        of_samples, of_mst = mean[score, family, "samples"], mean[score, family, "mst"]
        assert float(row["minus_samples"]) == pytest.approx(mean[score, family, arm] - of_samples, abs=2e-4)
        assert float(row["mst_minus_it"]) == pytest.approx(of_mst - mean[score, family, arm], abs=2e-4)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "counts").iterdir()}
    run_script(*arguments)
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "counts").iterdir()}


def test_large_images():
    assert "s full, " in run_script("full_size/large_images.py", "--small")


def test_full_size(tmp_path):
    assert "peak_GiB: mst" in run_script("full_size/run.py", "--smoke", "--out", tmp_path)
    rows = read_csv(tmp_path / "full_size.csv")
    assert [(r["preset"], r["pause"]) for r in rows] == [(p, t) for p in ("mst", "mst_rules") for t in ("0", "1")]
    for r in rows:
        parts = [float(v) for k, v in r.items() if k.endswith("_s") and k != "step_s"]
        assert sum(parts) == pytest.approx(float(r["step_s"]), abs=0.01)


def test_latency(tmp_path):
    assert "after the last frame" in run_script("full_size/latency.py", "--smoke", "--out", tmp_path)
    (row,) = read_csv(tmp_path / "latency.csv")
    assert row["pause"] == "1" and float(row["latency_s"]) > 0


def test_readme_picture(tmp_path):
    run_script("readme_picture/make.py", "--smoke", "--out", tmp_path)
    assert read_rgb(tmp_path / "hidden.png").std() > 10 and (tmp_path / "hidden.webp").stat().st_size > 10_000
    run_script("readme_picture/answer.py", "--smoke", "--out", tmp_path / "answer.png")
    assert read_rgb(tmp_path / "answer.png").std() > 10
    run_script("readme_picture/differences.py", "--out", tmp_path / "differences.png")
    assert read_rgb(tmp_path / "differences.png").shape[1] >= 840


def test_pictures_of_changes(tmp_path):
    run_script("readme_picture/changes.py", "--smoke", "--out", tmp_path)
    pictures = sorted(tmp_path.glob("changes-*.png"))
    page = (EXPERIMENTS.parent / "docs" / "changes.md").read_text()
    assert all(f"(images/{path.name})" in page and read_rgb(path).std() > 10 for path in pictures)
    assert len(pictures) == page.count("](images/")


def test_segmentation_fit(tmp_path):
    assert "misclassified" in run_script("segmentation_fit/run.py", "--smoke", "--out", tmp_path / "weights.json")
    made, _ = LearnedTree(weights=str(tmp_path / "weights.json")).model()
    assert made != LearnedTree().model()[0]

    shutil.copytree(models_folder() / "border", tmp_path / "border")
    run_script("segmentation_fit/correction.py", "--smoke", "--border", tmp_path / "border", "--out", tmp_path)
    n = len(FEATURES)
    shipped, made = (PairNetwork.of(open_model(str(name)), n) for name in ("border", tmp_path / "border"))
    x = np.zeros((1, n))
    assert np.isfinite(made(x)) and made(x) != shipped(x)

    run_script("segmentation_fit/check.py", "--smoke", "--out", tmp_path)
    rows = {r["arm"]: r for r in read_csv(tmp_path / "quality.csv")}
    assert len(rows) == 9 and float(rows["true masks"]["image"]) == 1.0


def test_tracking(tmp_path):
    run_script("tracking/run.py", "--smoke", "--out", tmp_path)
    rows = {r["class"]: r for r in read_csv(tmp_path / "results.csv")}
    assert sum(int(r["n"]) for r in rows.values()) == 5, "one clip of five objects"
    assert rows["still"]["within_10_mm"] == rows["still"]["n"] and float(rows["still"]["median_mm"]) < 1
    assert all(int(r["within_10_mm"]) <= int(r["candidate_within_10_mm"]) for r in rows.values())


def test_miniature(tmp_path):
    run_script("miniature/run.py", "--smoke", "--out", tmp_path)
    rows = {(r["world"], r["n"], r["arm"]): float(r["tv"]) for r in read_csv(tmp_path / "distances.csv")}
    assert {key[0] for key in rows} == {"shelf", "row"}
    for (_, _, arm), tv in rows.items():
        assert (tv == 0) == (arm == "exact")
    tests = read_csv(tmp_path / "calibration.csv")
    ranks = [int(v) for r in tests for k, v in r.items() if k.startswith("rank_")]
    assert sum(ranks) == 10 * len(tests)


def test_osd_frames(tmp_path):
    find_shared("real/osd_learn/learn0_rgb.png")
    run_script("osd_frames/run.py", "--smoke", "--out", tmp_path)
    rows = read_csv(tmp_path / "frames.csv")
    assert [r["frame"] for r in rows] == ["learn0", "learn2"]
    committed = {r["frame"]: r for r in read_csv(EXPERIMENTS / "osd_frames/results/frames.csv")}
    floor = "floor: plane + components"  # does not depend on the other frames
    for r in rows:
        assert r[floor] == committed[r["frame"]][floor]


def test_inference(tmp_path):
    arguments = ("inference/run.py", "--smoke", "--out", tmp_path)
    assert "particle_gibbs: 4 data sets" in run_script(*arguments)
    ranks = read_csv(tmp_path / "ranks.csv")
    assert [row["method"] for row in ranks] == ["pmmh"] * 4 + ["particle_gibbs"] * 4 + ["control"] * 4
    assert {(row["method"], row["data sets"]) for row in read_csv(tmp_path / "summary.csv")} == {
        ("pmmh", "4"),
        ("particle_gibbs", "4"),
        ("control", "4"),
    }
    assert "4 data sets" not in run_script(*arguments).split("chi-square")[0], "finished data sets are not run again"


def test_newcomer(tmp_path):
    """The first hour of a new user: commands of the documentation in processes of their own."""
    assert "0 failed" in run_script("newcomer/run.py", "--smoke", "--out", tmp_path)
    rows = read_csv(tmp_path / "hour.csv")
    assert {row["part"] for row in rows} >= {"demo", "own arrays", "own component", "study", "viewer"}
    assert [row["step"] for row in rows if row["fault"]] == []


def test_planted_faults(tmp_path):
    """Some faults of the lists are named, and some right components are not rejected."""
    faults = ["SortedNoise", "Coin", "EachTwice", "LogOfNegative", "Cosine", "Flat"]
    right = ["Drift", "LoopUpdate", "Blob", "UniformDensity", "Same"]
    names = [*faults, *right]
    out = run_script("planted/run.py", "--only", *names, "--out", tmp_path)
    assert "named 6 of 6 faults, rejected 0 of 5 right ones" in out


def test_physics_of_simulated_scenes(tmp_path):
    run_script("worlds/run.py", "--smoke", "--out", tmp_path)
    rows = read_csv(tmp_path / "summary.csv")
    assert [row["family"] for row in rows] == ["row", "stack"]
    assert all(row[name] == "0" for row in rows for name in ("not_arranged", "sinks", "moves_at_rest", "explodes"))
