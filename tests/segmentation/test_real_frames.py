"""Five real frames of five camera set-ups (the package's constants were chosen on them, among others)."""

from __future__ import annotations

import numpy as np

from mstfilter.scene import Camera, Frame
from mstfilter.scoring import weighted_coverage
from mstfilter.segmentation.proposal import TreeCutProposal


def test_optimal_cut_beats_components_on_touching_objects(shared_data):
    import cv2

    folder = shared_data("real/osd_learn")
    cut, floor = [], []
    for name in ("learn3", "learn10", "learn20", "learn25", "learn41"):
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
