"""The scripts on the simulated families run from end to end in their small form, and go on where they were."""

from __future__ import annotations

import csv
import subprocess
import sys

from tests.conftest import REPOSITORY

FOLDER = REPOSITORY / "experiments/families"


def lines(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_counts_and_difficulty(tmp_path):
    command = [sys.executable, str(FOLDER / "run.py"), "--smoke", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    difficulty, counts = lines(tmp_path / "difficulty.csv"), lines(tmp_path / "counts.csv")
    assert [row["seed"] for row in difficulty] == [row["seed"] for row in counts] == ["0", "1"]
    assert all(row["restless"] == row["left_workspace"] == row["without_voxels"] == "0" for row in counts)
    assert all(float(row["single_frame_image"]) > float(row["one_blob_image"]) for row in difficulty)
    assert {row["measure"] for row in lines(tmp_path / "summary.csv")} >= {"single_frame_image", "hidden"}
    # The second time nothing is run: a line that was changed by hand stays.
    text = (tmp_path / "counts.csv").read_text()
    (tmp_path / "counts.csv").write_text(text.replace(counts[0]["median_pixels"], "1.5"))
    subprocess.run(command, check=True, capture_output=True)
    assert lines(tmp_path / "counts.csv")[0]["median_pixels"] == "1.5"


def test_speed_compares_equal_pictures(tmp_path):
    command = [sys.executable, str(FOLDER / "speed.py"), "--smoke", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    (row,) = lines(tmp_path / "speed.csv")
    assert row["family"] == "s1" and int(row["frames"]) == 15


def test_committed_figures_are_of_tuning_seeds_and_of_stable_scenes():
    rows = lines(FOLDER / "results/counts.csv")
    assert {row["family"] for row in rows} == {"s1", "s2", "s3"}
    assert all(int(row["seed"]) < 100 and float(row["overlap_mm"]) < 2.0 for row in rows)
    assert all(int(row["seed"]) < 100 for row in lines(FOLDER / "results/difficulty.csv"))
