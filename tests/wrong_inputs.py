"""The wrong inputs of docs/troubleshooting.md: each makes a recording that is examined, from one that is right.

A case takes the arguments of `Recording.from_arrays` of a right recording and changes them.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.formats import open_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.scene import VoxelGrid, look_at
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


def beyond_the_table(surface, matrix):
    """The exact scene; `surface` gives the depth (H, W) of what is beyond the table from pose and directions.

    `matrix` (3, 4) maps points of the world, in which the table is at z = 0, to the world of the pose that is given.
    """
    pose = look_at((0.0, -0.9, 0.45), (0, 0, 0.2))
    camera = CAMERA.scaled(2).at(pose)
    rgb, depth, _ = table_scene(camera=camera)
    directions = camera.rays() @ pose.as_matrix()[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = surface(depth, camera, directions)
    wrong = RigidTransform.from_matrix(np.vstack([matrix, [0, 0, 0, 1]])) * pose
    return {"rgb": rgb, "depth": depth.astype(np.float32), "K": camera.K, "T_world_camera": wrong}


def wall(depth, camera, directions):
    back = (0.2 - camera.position[1]) / directions[..., 1]
    return np.where((back > 0) & (back < depth) | (directions[..., 2] >= 0), back, depth)


def floor(depth, camera, directions):
    points = camera.position + depth[..., None] * directions
    below = (-0.7 - camera.position[2]) / np.minimum(directions[..., 2], -1e-6)
    return np.where((np.abs(points[..., :2]) > (0.45, 0.3)).any(axis=-1), np.where(below < 6, below, np.nan), depth)


def depth_times(factor):
    return lambda: changed(depth=right()[0]["depth"] * np.float32(factor))


def K_times(*factors):
    return lambda: changed(K=right()[0]["K"] * np.reshape(factors, (-1, 3)))


def turned(degrees):
    """A pose whose table is tilted."""
    return changed(
        T_world_camera=RigidTransform.from_rotation(Rotation.from_rotvec([np.radians(degrees), 0, 0])) * right()[1]
    )


def lowered(metres):
    pose = right()[1]
    return changed(T_world_camera=RigidTransform.from_translation([0, 0, -metres]) * pose)


#: Wrong input, as the page names it -> arguments of `Recording.from_arrays`.
WRONG = {
    "the camera moves, without poses": shifted_camera,
    "poses for another number of frames": lambda: changed(T_world_camera=[right()[1]] * 2),
    "inverse pose": lambda: changed(T_world_camera=right()[1].inv()),
    "table of the pose tilted": lambda: turned(6),
    "table of the pose too low": lambda: lowered(0.06),
    "images upside down, with a pose": lambda: posed(
        rgb=right()[0]["rgb"][:, ::-1, ::-1], depth=right()[0]["depth"][:, ::-1, ::-1]
    ),
    "a pose with a wall at z = 0": lambda: beyond_the_table(wall, [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.2]]),
    "a pose with the floor at z = 0": lambda: beyond_the_table(
        floor, np.eye(3, 4) + [[0] * 4, [0] * 4, [0, 0, 0, 0.7]]
    ),
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
    "constant depth": lambda: changed(depth=np.full_like(right()[0]["depth"], 0.8)),
    "depth not registered to colour": lambda: changed(
        depth=warped(right()[0]["depth"], [[1, 0, 8], [0, 1, -6]], np.nan)
    ),
    "uniform colour": lambda: changed(rgb=np.full_like(right()[0]["rgb"], 90)),
    "a robot mask over all pixels": lambda: posed(robot_masks=np.ones(right()[0]["depth"].shape, bool)),
    "workspace in millimetres": lambda: posed(grid=VoxelGrid((-400, -400, 0), 10.0, (80, 80, 30))),
    "the camera or its pose leaves the table": lambda: changed(
        T_world_camera=np.stack([right()[1].as_matrix(), np.eye(4), np.eye(4)])
    ),
    "workspace beside the table": lambda: posed(grid=VoxelGrid((2.0, -3.0, 0.0), 0.01, (80, 80, 30))),
    "the same images at all pauses": lambda: changed(
        rgb=right()[0]["rgb"][[0, 0, 0]], depth=right()[0]["depth"][[0, 0, 0]]
    ),
    "no pauses given for many frames": lambda: changed(
        rgb=right()[0]["rgb"].repeat(8, axis=0), depth=right()[0]["depth"].repeat(8, axis=0), pauses=None
    ),
}
