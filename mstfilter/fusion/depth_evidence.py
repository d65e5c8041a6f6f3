"""Does the surface of a hypothesis lie where the depth image has measured it?

>>> DepthAgreement().log_score(hypotheses, clip)

Data used: the depth of the clip's last frame. The same image has been used before: free space clears what it looks
through from the predictions (and its Q is in the weight of the pair), the proposal's samples are segmented and
completed from it, and `BoundaryAgreement` sees its creases. So this term counts that image again; what it adds is
that the built candidate is judged, and that what is missing costs as well as what is too much.

The hypothesis is rendered, with the table behind it, and compared with the reading of each pixel. A voxel's face is
up to a voxel from the true surface, and neighbouring pixels that see one voxel err alike. The scale of a difference
is therefore the voxel's extent together with the sensor's noise, and pixels are counted by blocks as wide as a few
voxels: a block is one piece of evidence. Few pixels of a block tell as much as all, so only some are looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import (
    Camera,
    Clip,
    Evidence,
    Frame,
    Hypothesis,
    VoxelGrid,
    component_key,
    depth_sigma,
    memo,
    render_hypothesis,
)

__all__ = ["DepthAgreement"]


class _Readings(NamedTuple):
    """What the sensor says at some pixels: (n,) arrays, lengths in metres.

    Camera of these pixels; flat index in its image; reading; the table's depth (inf: none); whether the point read
    lies in the workspace; scale of a difference; weight, such that those of a block that is all known sum to 1.
    """

    camera: Camera
    pixel: np.ndarray
    depth: np.ndarray
    table: np.ndarray
    inside: np.ndarray
    scale: np.ndarray
    weight: float


@dataclass(frozen=True)
class DepthAgreement(Evidence):
    """Robust log likelihood of the depth image, one reading a block of pixels.

    Parameters
    ----------
    strength : float
        Power of the likelihood; 1 takes every block for an independent reading.
    block : float
        Edge of a block in voxels, at the range of the middle of the workspace.
    spacing : float
        Voxels from one pixel that is looked at to the next, there; never less than a pixel.
    voxels : float
        Standard deviation of the rendered surface, in voxels.
    cap : float
        Largest squared difference, in scales: a block that is all wrong costs half of it in nats.
    """

    strength: float = 1.0
    block: float = 2.0
    spacing: float = 0.5
    voxels: float = 1.0
    cap: float = 9.0

    def __post_init__(self) -> None:
        values = (self.strength, self.block, self.spacing, self.voxels, self.cap)
        if not (np.isfinite(values).all() and min(values) > 0):
            raise InputError(
                f"depth has strength {self.strength}, block {self.block}, spacing {self.spacing}, "
                f"voxels {self.voxels} and cap {self.cap}, expected finite numbers > 0"
            )

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """Minus `strength` times half the capped squared differences, averaged in each block, summed over blocks.

        Pixels without a reading, of the robot, and where neither an object nor the table is expected say nothing.
        """
        frame, scores = clip.after, {}
        for hypothesis in hypotheses:
            if hypothesis.key not in scores:
                scores[hypothesis.key] = self._score(hypothesis, frame)
        return np.array([scores[h.key] for h in hypotheses], dtype=float)

    def _score(self, hypothesis: Hypothesis, frame: Frame) -> float:
        grid = hypothesis.grid
        seen = memo("depth_readings", (frame.key, grid.key, component_key(self)), lambda: self._readings(frame, grid))
        rendered = render_hypothesis(hypothesis, seen.camera).depth.ravel()[seen.pixel]
        expected = np.fmin(rendered, seen.table)
        # Where nothing is expected nothing is wrong; and what is outside the workspace may hide what is inside.
        known = np.isfinite(expected) & (seen.inside | (expected < seen.depth))
        error = (expected[known] - seen.depth[known]) / seen.scale[known]
        return -0.5 * self.strength * seen.weight * float(np.minimum(error**2, self.cap).sum())

    def _readings(self, frame: Frame, grid: VoxelGrid) -> _Readings:
        middle = (grid.origin + grid.upper) / 2
        voxel = frame.camera.K[0, 0] * grid.voxel_size / max(float(frame.camera.project(middle)[1]), grid.voxel_size)
        step = int(np.clip(round(self.spacing * voxel), 1, min(frame.depth.shape)))
        camera = _every(frame.camera, step)
        depth, valid = (image[step // 2 :: step, step // 2 :: step] for image in (frame.depth, frame.valid))
        pixel = np.flatnonzero(valid)
        depth = depth.ravel()[pixel].astype(np.float64)
        directions = camera.rays().reshape(-1, 3)[pixel] @ camera.pose.as_matrix()[:3, :3].T
        eye = camera.position
        downwards = directions[:, 2] < 0
        table = np.where(downwards, -eye[2] / np.where(downwards, directions[:, 2], -1.0), np.inf)
        ground = eye[:2] + np.where(downwards, table, 0.0)[:, None] * directions[:, :2]
        beside = ((ground < grid.origin[:2]) | (ground > grid.upper[:2])).any(axis=1)
        table[beside | (table <= 0)] = np.inf
        point = eye + depth[:, None] * directions
        # The table itself is read a little below the lowest voxel as often as above.
        margin = grid.voxel_size
        inside = ((point >= grid.origin - margin) & (point <= grid.upper + margin)).all(axis=1)
        scale = np.hypot(depth_sigma(depth), self.voxels * grid.voxel_size)
        weight = min(1.0, (step / (self.block * voxel)) ** 2)
        return _Readings(camera, pixel, depth, table, inside, scale, weight)


def _every(camera: Camera, step: int) -> Camera:
    """The camera of every `step`-th pixel of an image, from the middle of the first `step` on."""
    if step == 1:
        return camera
    first = step // 2
    K = camera.K.copy()
    K[:2, 2] -= first
    K[:2] /= step
    size = (camera.width - first + step - 1) // step, (camera.height - first + step - 1) // step
    return Camera(K, *size, camera.T_world_camera)
