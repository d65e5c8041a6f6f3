"""The benchmark on real sequences: its scores on small images that are known, and its small form."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from mstfilter.base.files import read_csv
from mstfilter.scene import Camera, Frame, Hypothesis, VoxelGrid
from tests.experiments.scripts import EXPERIMENTS, own_modules, run_script

#: A camera 1 m above the table, looking down: a pixel is 1 cm there.
DOWN = RigidTransform.from_matrix(np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]]))
GRID = VoxelGrid(np.array([-0.3, -0.2, 0.0]), 0.01, (60, 40, 20))


@pytest.fixture(scope="module")
def scores():
    with own_modules(EXPERIMENTS / "real"):
        yield importlib.import_module("scores")


def frame(depth):
    h, w = depth.shape
    K = np.array([[100.0, 0, (w - 1) / 2], [0, 100, (h - 1) / 2], [0, 0, 1]])
    return Frame(np.zeros((h, w, 3), np.uint8), depth, Camera(K, w, h, DOWN))


def truth_of(scores, labels):
    return scores.Truth(labels, {1: "box", 2: "can"})


def test_counts_of_an_image(scores):
    """Two true objects; the first one is in two pieces, the second one is missed, and one object is invented."""
    labels, image, depth = np.zeros((40, 60), int), np.zeros((40, 60), int), np.ones((40, 60))
    labels[5:15, 5:25], labels[25:35, 5:25] = 1, 2
    image[5:15, 5:15], image[5:15, 15:25], image[25:35, 40:50] = 1, 2, 3
    depth[5:15, 5:25], depth[25:35, 5:25] = 0.9, 0.97  # 10 cm and 3 cm high
    found = scores.image_scores(image, truth_of(scores, labels), frame(depth), GRID)
    expected = {"objects": 3, "true_objects": 2, "pieces": 1, "merged": 0, "missed": 1, "invented": 1}
    assert {key: found[key] for key in expected} == expected
    assert (found["tall"], found["tall_missed"], found["found"]) == (1, 0, 0.25)
    merged = scores.image_scores((labels > 0).astype(int), truth_of(scores, labels), frame(depth), GRID)
    assert (merged["merged"], merged["pieces"], merged["missed"], merged["found"]) == (1, 0, 0, 1)


def test_unknown_pixels_and_pixels_beside_the_workspace_do_not_count(scores):
    labels, image = np.zeros((40, 60), int), np.zeros((40, 60), int)
    labels[5:15, 5:25], labels[30:40] = 1, -1
    image[5:15, 5:25], image[30:40, :] = 1, 2
    depth = np.ones((40, 60))
    assert scores.image_scores(image, truth_of(scores, labels), frame(depth), GRID)["quality"] == 1
    image[:, 50:] = 3  # these readings lie outside a narrower workspace
    narrow = VoxelGrid(GRID.origin, 0.01, (50, 40, 20))
    assert scores.image_scores(image, truth_of(scores, labels), frame(depth), narrow)["quality"] == 1
    assert scores.image_scores(image, truth_of(scores, labels), frame(depth), GRID)["quality"] < 1


def test_objects_without_readings_count_in_one_of_the_qualities(scores):
    labels, image, depth = np.zeros((40, 60), int), np.zeros((40, 60), int), np.ones((40, 60))
    labels[5:15, 5:25], labels[25:35, 5:25], image[5:15, 5:25] = 1, 2, 1
    depth[25:35, 5:25] = np.nan
    found = scores.image_scores(image, truth_of(scores, labels), frame(depth), GRID)
    assert found["quality"] < found["quality_readable"] == 1


def test_identities_follow_the_names(scores):
    labels = np.zeros(GRID.shape, np.uint16)
    labels[:30, :, :5], labels[30:, :, :5] = 1, 2
    hypothesis = Hypothesis.from_labels(labels, GRID)
    image, true = np.zeros((40, 60), int), np.zeros((40, 60), int)
    image[:, :30], image[:, 30:], true[:, :30], true[:, 32:] = 1, 2, 1, 2
    named = scores.identities(image, hypothesis, truth_of(scores, true))
    assert named == {"box": hypothesis.record(1).id, "can": hypothesis.record(2).id}
    assert scores.kept([named, named, {"box": -1}]) == (2, 3)


def test_a_witness_sees_what_is_hidden(scores):
    """The filtered camera sees the top of a shelf, the witness looks below it."""
    shelf = np.full((40, 60), 0.9)
    under = Camera(frame(shelf).camera.K, 60, 40, RigidTransform.from_translation([0.0, 0.0, -0.5]))  # looks up
    witness = Frame(np.zeros((40, 60, 3), np.uint8), np.full((40, 60), 0.55), under)  # surface at z = 5 cm
    labels = np.zeros(GRID.shape, np.uint16)
    labels[:30, :, 5] = 1
    found = scores.witness_scores(Hypothesis.from_labels(labels, GRID), frame(shelf), witness)
    assert found["in_free_space"] == 0 and found["covered"] == pytest.approx(0.5, abs=0.05)
    assert found["covered_objects"] == found["covered"]
    labels[:, :, 0] = 2  # in front of what the witness sees
    found = scores.witness_scores(Hypothesis.from_labels(labels, GRID), frame(shelf), witness)
    assert found["in_free_space"] > 0.4


def test_the_wall_is_no_object(scores, monkeypatch):
    """As above, with a wall at the part of the surface that is not covered."""
    shelf = np.full((40, 60), 0.9)
    under = Camera(frame(shelf).camera.K, 60, 40, RigidTransform.from_translation([0.0, 0.0, -0.5]))
    witness = Frame(np.zeros((40, 60, 3), np.uint8), np.full((40, 60), 0.55), under)
    labels = np.zeros(GRID.shape, np.uint16)
    labels[:30, :, 5] = 1  # x < 0
    monkeypatch.setattr(scores, "WALL", ((1.0, 0.0, 0.0), 0.15))
    monkeypatch.setattr(scores, "_AT_WALL", 0.145)
    found = scores.witness_scores(Hypothesis.from_labels(labels, GRID), frame(shelf), witness)
    assert found["covered"] < 0.6
    assert found["covered_objects"] > 0.9


def test_certainty_pays_only_if_it_is_deserved():
    """Recalibrated by the other sequences, a method with one answer has the loss of its frequency of errors."""
    with own_modules(EXPERIMENTS / "real"):
        run = importlib.import_module("run")
    certain = [("0.00", 70, 30), ("1.00", 20, 80)]
    graded = [("0.00", 60, 0), ("0.40", 20, 20), ("1.00", 10, 90)]
    rows = [
        {"sequence": name, "method": method, "of": "all", "p": p, "no": f"{times * no}", "yes": f"{times * yes}"}
        for name, times in (("a", 1), ("b", 3))
        for method, table in (("certain", certain), ("graded", graded))
        for p, no, yes in table
    ]
    found = run.recalibrated(rows)

    def entropy(p):
        return -p * np.log(p) - (1 - p) * np.log(1 - p)

    for name in "ab":
        assert found[name, "certain"][run.LOG_LOSS] == pytest.approx((entropy(0.3) + entropy(0.2)) / 2, abs=1e-3)
        expected = (40 * entropy(0.5) + 100 * entropy(0.1)) / 200
        assert found[name, "graded"][run.LOG_LOSS] == pytest.approx(expected, abs=2e-3)
    assert not run.recalibrated([row for row in rows if row["sequence"] == "a"])  # nothing to fit it to


@pytest.mark.nightly
def test_small_form(tmp_path, shared_data):
    shared_data("real/osd_learn")
    run_script("real/run.py", "--smoke", "--out", tmp_path)
    rows = read_csv(tmp_path / "pauses.csv")
    assert [(row["method"], row["pause"]) for row in rows] == [("mst", "0"), ("floor_image", "0")]
    means = {row["method"]: float(row["quality"]) for row in read_csv(tmp_path / "sequences.csv")}
    assert means["mst"] == pytest.approx(float(rows[0]["quality"]), abs=1e-4)
