"""Scores of runs and volumes against the truth, checked by sums written out here."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.formats import RecordingWriter, open_recording
from mstfilter.scene import Hypothesis, VoxelGrid, render
from mstfilter.scoring import PauseEstimate, PauseTruth, read_truth, score_pauses
from tests.scene.scenes import CAMERA, GRID, table_scene

SMALL = VoxelGrid((0, 0, 0), 0.01, (6, 1, 1))


def line(text):
    return np.array([int(c) for c in text], np.uint16).reshape(6, 1, 1)


def rows_of(hypotheses, weights, truth):
    rows = score_pauses(
        [PauseEstimate([line(h) for h in hypotheses], np.array(weights), 0)], [PauseTruth(line(truth), 0)]
    )
    return {row.form: row for row in rows}


def test_by_hand():
    """Truth 110220. One blob over both: J = 2/4 with each; perfect: 1; half of one object: see the sums."""
    rows = rows_of(["110220", "110110", "110000"], [0.5, 0.3, 0.2], "110220")
    q = np.array([1.0, 0.5, (1.0 + 0.5) / 2])  # third: own side 2*1/2, true side (2*1 + 2*0)/4
    row = rows["objects"]
    assert (row.pause, row.where, row.n) == (0, "volume", 3)
    np.testing.assert_allclose([row.mean, row.weighted, row.best, row.top], [q.mean(), q @ [0.5, 0.3, 0.2], 1.0, 1.0])
    # Floors keep the occupied voxels: as one blob .5, .5, .75; as components 1, 1, .75.
    np.testing.assert_allclose([row.one_blob, row.components], [0.5 * 0.8 + 0.75 * 0.2, 0.8 + 0.75 * 0.2])
    # The literal form counts free space: of the second hypothesis 4 * 2/4 + 2 * 1 and the same back, over 2 * 6.
    np.testing.assert_allclose(rows_of(["110110"], [1.0], "110220")["paper"].mean, (4 + 4) / 12)
    # The authors' form divides both sides by the hypothesis's volume: (2 + 2) / (2 * 2).
    np.testing.assert_allclose(rows_of(["110000"], [1.0], "110220")["authors"].mean, 1.0)


def test_the_heaviest_is_top_not_the_best():
    row = rows_of(["110110", "110220"], [0.9, 0.1], "110220")["objects"]
    assert (row.top, row.best) == (0.5, 1.0)


def write_recording(path, volumes=True, instance=True, grid=GRID):
    with RecordingWriter(path, CAMERA, grid) as writer:
        for k, shift in enumerate((0, 2, 4)):
            rgb, depth, labels = table_scene(shift)
            seen = render(labels, GRID, CAMERA).labels.astype(np.uint8)
            seen[:, :3] = 255
            writer.add_frame(
                rgb, depth, float(k), "static" if k != 1 else "action", instance=seen if instance else None
            )
            if k != 1 and volumes:
                writer.add_voxels(labels)
    return path


def test_volumes_against_a_recording(tmp_path):
    """Pauses are matched by frame, whatever the order and however many there are."""
    truth = read_truth(open_recording(write_recording(tmp_path / "r")))
    whole = [PauseEstimate([table_scene(shift)[2]], np.ones(1), shift // 2, GRID) for shift in (0, 4)]
    assert [row.mean for row in score_pauses(whole, truth)] == [1.0] * 6
    other = PauseEstimate([np.zeros(GRID.shape, np.uint16)], np.ones(1), 1, GRID)
    rows = score_pauses([whole[1], other], truth)
    assert [(row.pause, row.form, row.mean) for row in rows] == [(0, f, 1.0) for f in ("objects", "paper", "authors")]


def test_instance_images_score_visible_parts(tmp_path):
    """Without volumes the truth is the image: right volumes are perfect there, wrong hidden voxels cost nothing."""
    recording = open_recording(write_recording(tmp_path / "r", volumes=False))
    truth = read_truth(recording)
    assert truth[0].camera is not None
    right = table_scene(0)[2].copy()
    row = score_pauses([PauseEstimate([right], np.ones(1), 0, GRID)], truth)[0]
    assert (row.where, row.mean) == ("image", 1.0)
    hidden = right.copy()
    hidden[16:24, 26:34, 1:11] = 0  # inside of a box
    assert score_pauses([PauseEstimate([hidden], np.ones(1), 0, GRID)], truth)[0].mean == 1.0
    swapped = np.where(right == 2, 1, right).astype(np.uint16)
    assert 0.3 < score_pauses([PauseEstimate([swapped], np.ones(1), 0, GRID)], truth)[0].mean < 0.9
    with pytest.raises(InputError, match="without a grid"):
        score_pauses([PauseEstimate([right], np.ones(1), 0)], truth)


def test_a_run_scores_as_its_own_metrics_say(tmp_path):
    """Rows equal what the run wrote while it was running."""
    from mstfilter.runs.presets import load_config
    from mstfilter.runs.run import filter_recording

    recording = open_recording(write_recording(tmp_path / "r"))
    run = filter_recording(recording, load_config("mst", ["n=3"]), tmp_path / "run", 0)
    rows = score_pauses(run.estimates(), read_truth(recording))
    written = list(csv.DictReader((run.path / "metrics.csv").open()))
    for row in rows:
        q = np.array([float(m[f"quality_{row.form}"]) for m in written if int(m["pause"]) == row.pause])
        w = np.array([float(m["weight"]) for m in written if int(m["pause"]) == row.pause])
        np.testing.assert_allclose([row.mean, row.weighted, row.best], [q.mean(), w @ q, q.max()], atol=2e-6)


def test_input_that_does_not_match_is_an_error(tmp_path):
    path = write_recording(tmp_path / "r")
    truth = read_truth(open_recording(path))
    other = VoxelGrid((1, 1, 0), 0.01, GRID.shape)
    labels = table_scene(0)[2]
    for estimate, message in (
        ([PauseEstimate([labels], np.ones(1), 0, other)], r"is VoxelGrid\(.*shape=\(60, 60, 30\)\), but the truth"),
        ([PauseEstimate([labels], np.ones(1), 7, GRID)], "no pause has both"),
    ):
        with pytest.raises(InputError, match=message):
            score_pauses(estimate, truth)
    with pytest.raises(InputError, match="has no ground truth"):
        read_truth(open_recording(write_recording(tmp_path / "bare", volumes=False, instance=False)))


def test_weights_and_grids_are_checked():
    with pytest.raises(InputError, match="2 with the weights"):
        PauseEstimate([line("110000"), line("110220")], np.ones(2), 0)
    shifted = Hypothesis.from_labels(line("110220"), VoxelGrid((0.1, 0, 0), 0.01, (6, 1, 1)))
    with pytest.raises(InputError, match="but the truth has"):
        score_pauses([PauseEstimate([shifted], np.ones(1), 0)], [PauseTruth(line("110220"), 0, SMALL)])
    with pytest.raises(InputError, match="a hypothesis at frame 0"):
        PauseEstimate([Hypothesis.from_labels(line("110220"), SMALL), shifted], np.full(2, 0.5), 0)
