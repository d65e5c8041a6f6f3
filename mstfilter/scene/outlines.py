"""Objects of a hypothesis in an image, with the outlines of the image.

>>> outlined(hypothesis, frame)         # (H, W) uint16

The outline of a projected object (`mstfilter.scene.project`) is made of voxels. With voxels of 1 cm at a distance of
1 m, it is up to 5 pixels from the outline that the image shows. If the frame is there, the pixels of objects
(`mstfilter.scene.foreground`) are known more precisely. So labels on readings of the table are removed, and pixels of
objects up to half a voxel beside a projected object get its label. The voxels stay as they are.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from mstfilter.scene.frame import Frame
from mstfilter.scene.rendering import render_hypothesis
from mstfilter.scene.support import foreground
from mstfilter.scene.voxels import Hypothesis


def outlined(hypothesis: Hypothesis, frame: Frame) -> np.ndarray:
    """Label image (H, W) uint16 of a hypothesis, with outlines that follow the image of a frame.

    Pixels without a reading keep their labels, because the sensor does not say what they show.
    """
    rendered = render_hypothesis(hypothesis, frame.camera)
    pixels = foreground(frame, hypothesis.grid).pixels
    labels = np.where(pixels | ~frame.valid, rendered.labels, 0)
    if not labels.any():
        return np.asarray(labels, np.uint16)
    distance, (rows, columns) = distance_transform_edt(labels == 0, return_indices=True)
    half = hypothesis.grid.voxel_size * frame.camera.K[0, 0] / (2 * rendered.depth[rows, columns])
    beside = pixels & (labels == 0) & (distance <= half + 1)
    return np.asarray(np.where(beside, labels[rows, columns], labels), np.uint16)
