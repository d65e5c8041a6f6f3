"""The wrong inputs of docs/troubleshooting.md: each makes a recording that is examined, from one that is right.

A case takes the arguments of `Recording.from_arrays` of a right recording and changes them; it may return hypotheses
instead, which are examined as those of the first step.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.formats import open_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.scene import Hypothesis, VoxelGrid, look_at
from tests.scene.scenes import CAMERA, table_scene


@cache
def right():
    """Arguments of `Recording.from_arrays` for three pauses of a simulated recording, and its pose."""
    recording = open_recording(cached_recording("demo", seed=3, fps=1.0, frames_per_clip=3))
    frames = [recording.frames[p] for p in recording.pauses]
    rgb, depth = np.stack([f.rgb for f in frames]), np.stack([f.depth for f in frames])
    return {"rgb": rgb, "depth": depth, "K": frames[0].camera.K, "pauses": "every"}, frames[0].camera.pose


def changed(**named):
    return {**right()[0], **named}


def posed(**named):
    return changed(T_world_camera=right()[1], **named)


def warped(images, T, fill=0.0):
    size = images.shape[2], images.shape[1]
    how = {"flags": cv2.INTER_NEAREST, "borderValue": (fill,) * 3}
    return np.stack([cv2.warpAffine(image, np.float32(T), size, **how) for image in images])


def shifted_camera(by=1.0):
    """From the second pause on, the camera is rolled and displaced. `by` scales the motion."""
    arrays, _ = right()
    T = [[1, -0.05 * by, 20 * by], [0.05 * by, 1, -14 * by]]
    rgb, depth = warped(arrays["rgb"][1:], T), warped(arrays["depth"][1:], T, np.nan)
    return changed(rgb=np.r_[arrays["rgb"][:1], rgb], depth=np.r_[arrays["depth"][:1], depth])


def marked(depth):
    """Depth with the value 8 m at the left tenth of the image."""
    found = depth.copy()
    found[..., : depth.shape[-1] // 10] = 8.0
    return found


def beyond_the_table(surface):
    """The exact scene; `surface` gives the depth (H, W) of what is beyond the table from pose and directions."""
    pose = look_at((0.0, -0.9, 0.45), (0, 0, 0.2))
    camera = CAMERA.scaled(2).at(pose)
    rgb, depth, _ = table_scene(camera=camera)
    directions = camera.rays() @ pose.as_matrix()[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = surface(depth, camera, directions)
    return {"rgb": rgb, "depth": depth.astype(np.float32), "K": camera.K}


def wall(depth, camera, directions):
    back = (0.2 - camera.position[1]) / directions[..., 1]
    return np.where((back > 0) & (back < depth) | (directions[..., 2] >= 0), back, depth)


def floor(depth, camera, directions):
    points = camera.position + depth[..., None] * directions
    below = (-0.7 - camera.position[2]) / np.minimum(directions[..., 2], -1e-6)
    return np.where((np.abs(points[..., :2]) > (0.45, 0.3)).any(axis=-1), np.where(below < 6, below, np.nan), depth)


def sparse(depth, share):
    return np.where(np.random.default_rng(0).random(depth.shape) < share, depth, np.float32(np.nan))


def depth_times(factor):
    return lambda: changed(depth=right()[0]["depth"] * np.float32(factor))


def K_times(*factors):
    return lambda: changed(K=right()[0]["K"] * np.reshape(factors, (-1, 3)))


def full_of(share):
    """One hypothesis with an object that fills a share of the workspace."""

    def make():
        grid = VoxelGrid((-0.4, -0.4, 0.0), 0.01, (80, 80, 30))
        labels = np.zeros(grid.shape, np.uint16)
        labels[: round(share * 80)] = 1
        return (Hypothesis.from_labels(labels, grid),)

    return make


def turned(degrees):
    """A pose whose table is tilted."""
    return changed(
        T_world_camera=RigidTransform.from_rotation(Rotation.from_rotvec([np.radians(degrees), 0, 0])) * right()[1]
    )


def lowered(metres):
    pose = right()[1]
    return changed(T_world_camera=RigidTransform.from_translation([0, 0, -metres]) * pose)


#: Wrong input, as the page names it -> arguments of `Recording.from_arrays`, or hypotheses.
WRONG = {
    "the camera moves, without poses": shifted_camera,
    "poses for another number of frames": lambda: changed(T_world_camera=[right()[1]] * 2),
    "inverse pose": lambda: changed(T_world_camera=right()[1].inv()),
    "table of the pose tilted": lambda: turned(6),
    "table of the pose too low": lambda: lowered(0.06),
    "images upside down, with a pose": lambda: posed(
        rgb=right()[0]["rgb"][:, ::-1, ::-1], depth=right()[0]["depth"][:, ::-1, ::-1]
    ),
    "a wall taken for the table": lambda: beyond_the_table(wall),
    "the floor taken for the table": lambda: beyond_the_table(floor),
    "principal point at the corner": K_times(1, 1, 0, 1, 1, 0, 1, 1, 1),
    "principal point off the centre": K_times(1, 1, 0.4, 1, 1, 1, 1, 1, 1),
    "K of images of another size": K_times(2, 1, 2, 1, 2, 2, 1, 1, 1),
    "K of the images before a turn by 90 degrees": lambda: changed(K=right()[0]["K"][[1, 0, 2]][:, [1, 0, 2]]),
    "normalised K": K_times(1 / 320, 1, 1 / 320, 1, 1 / 240, 1 / 240, 1, 1, 1),
    "K transposed": lambda: changed(K=right()[0]["K"].T),
    "focal lengths that differ": K_times(1, 1, 1, 1, 1.5, 1, 1, 1, 1),
    "millimetres taken for metres": depth_times(1000),
    "depth 5 times too large (millimetres at TUM scale)": depth_times(5),
    "depth 5 times too small": depth_times(0.2),
    "depth 4 times too large (RealSense L515, 0.25 mm)": depth_times(4),
    "depth without any reading": depth_times(np.nan),
    "depth at a fifth of the pixels": lambda: changed(depth=sparse(right()[0]["depth"], 0.2)),
    "a constant for missing depth": lambda: changed(depth=marked(right()[0]["depth"])),
    "inverse depth, without a pose": lambda: changed(depth=0.5 / right()[0]["depth"]),
    "constant depth": lambda: changed(depth=np.full_like(right()[0]["depth"], 0.8)),
    "depth not registered to colour": lambda: changed(
        depth=warped(right()[0]["depth"], [[1, 0, 8], [0, 1, -6]], np.nan)
    ),
    "depth and colour in different order": lambda: changed(depth=right()[0]["depth"][::-1]),
    "uniform colour": lambda: changed(rgb=np.full_like(right()[0]["rgb"], 90)),
    "a robot mask over all pixels": lambda: posed(robot_masks=np.ones(right()[0]["depth"].shape, bool)),
    "workspace in millimetres": lambda: posed(grid=VoxelGrid((-400, -400, 0), 10.0, (80, 80, 30))),
    "the camera or its pose leaves the table": lambda: changed(
        T_world_camera=np.stack([right()[1].as_matrix(), np.eye(4), np.eye(4)])
    ),
    "workspace that starts above the table": lambda: posed(grid=VoxelGrid((-0.4, -0.4, 0.05), 0.01, (80, 80, 30))),
    "workspace beside the table": lambda: posed(grid=VoxelGrid((2.0, -3.0, 0.0), 0.01, (80, 80, 30))),
    "workspace below the objects' tops": lambda: posed(grid=VoxelGrid((-0.4, -0.4, 0.0), 0.01, (80, 80, 2))),
    "the same images at all pauses": lambda: changed(
        rgb=right()[0]["rgb"][[0, 0, 0]], depth=right()[0]["depth"][[0, 0, 0]]
    ),
    "one pause in a video of a change": lambda: changed(pauses=[0]),
    "no pauses given for many frames": lambda: changed(
        rgb=right()[0]["rgb"].repeat(8, axis=0), depth=right()[0]["depth"].repeat(8, axis=0), pauses=None
    ),
    "no object in any hypothesis, but readings above the table": full_of(0),
    "an object that fills a tenth of the workspace": full_of(0.15),
}
