"""Real frames. The constants of the package were chosen on those of `osd_learn`, among others."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter import open_recording
from mstfilter.mst.segmentation.proposal import TreeCutProposal
from mstfilter.scene import Camera, Frame
from mstfilter.scoring import weighted_coverage


@pytest.mark.parametrize(
    "names",
    [
        ("learn3", "learn20"),
        pytest.param(("learn3", "learn10", "learn20", "learn25", "learn41"), marks=pytest.mark.nightly),
    ],
    ids=["two", "five"],
)
def test_optimal_cut_beats_components_on_touching_objects(shared_data, names):
    import cv2

    folder = shared_data("real/osd_learn")
    cut, floor = [], []
    for name in names:
        rgb = np.ascontiguousarray(cv2.imread(str(folder / f"{name}_rgb.png"))[..., ::-1])
        depth = cv2.imread(str(folder / f"{name}_depth.png"), cv2.IMREAD_UNCHANGED) * np.float32(0.001)
        label = cv2.imread(str(folder / f"{name}_label.png"), cv2.IMREAD_UNCHANGED)
        frame = Frame(rgb, depth, Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480))
        truth = np.where(label >= 2, label, 0)
        found = np.where(label == 0, 0, TreeCutProposal().label_image(frame))
        components = cv2.connectedComponents((found > 0).astype(np.uint8), connectivity=4)[1]
        cut.append(weighted_coverage(found, truth))
        floor.append(weighted_coverage(components, truth))
    assert np.mean(cut) > 0.85
    assert np.mean(cut) > np.mean(floor) + 0.2


@pytest.mark.nightly
def test_a_toy_in_full_view_is_one_object(shared_data):
    """A white toy touches a stick at some pauses, and a thin board lies on the table."""
    recording = open_recording(shared_data("real/jack"))
    on_toy = ((312, 337), (329, 315), (291, 304), (353, 310), (393, 300))  # column and row at each pause
    for clip, (column, row) in zip(recording.clips(), on_toy, strict=True):
        labels = TreeCutProposal().label_image(clip.after, clip.grid)
        toy = labels == labels[row, column]
        assert labels[row, column] > 0
        assert 1500 < toy.sum() < 6000, clip.index
        rows, columns = np.nonzero(toy)
        assert np.ptp(rows) < 110 and np.ptp(columns) < 110, clip.index
