"""Analytic scenes for the tracking tests: boxes and cylinders, ray-cast exactly, with known motion.

>>> scene = Scene([Box((0.1, 0.08, 0.06))], [[at(0, 0, 0.03)], [at(0.02, 0, 0.03)]])
>>> clip, truth = scene.clip(seed=0)        # truth: labels (X, Y, Z) of the first frame, T after_before per object
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.scene import Camera, Clip, Frame, Hypothesis, VoxelGrid, look_at

GRID = VoxelGrid((-0.4, -0.3, 0.0), 0.01, (80, 60, 30))


def at(x: float, y: float, z: float, yaw_deg: float = 0.0) -> np.ndarray:
    """Pose (4, 4) with a turn about the vertical."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    T[:3, 3] = (x, y, z)
    return T


def slide(start: np.ndarray, end: np.ndarray, n: int) -> list[np.ndarray]:
    """n poses from start to end: straight, turning evenly about the vertical."""
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    poses = []
    for s in np.linspace(0, 1, n):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(s * turn).as_matrix() @ start[:3, :3]
        T[:3, 3] = (1 - s) * start[:3, 3] + s * end[:3, 3]
        poses.append(T)
    return poses


@dataclass
class Solid:
    """Size in metres: (x, y, z) of a box, (diameter, diameter, height) of a cylinder."""

    size: tuple[float, float, float]
    colour: tuple[int, int, int] = (170, 110, 70)
    texture: float = 0.5
    seed: int = 0

    def inside(self, local: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def hit(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError


class Box(Solid):
    def inside(self, local: np.ndarray) -> np.ndarray:
        return (np.abs(local) <= np.array(self.size) / 2).all(-1)

    def hit(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = np.array(self.size) / 2
        a, b = (-half - o) / d, (half - o) / d
        near, far = np.minimum(a, b), np.maximum(a, b)
        axis = near.argmax(-1)
        t = np.take_along_axis(near, axis[..., None], -1)[..., 0]
        t = np.where((t < far.min(-1)) & (t > 0), t, np.inf)
        normal = np.zeros_like(d)
        np.put_along_axis(normal, axis[..., None], -np.sign(np.take_along_axis(d, axis[..., None], -1)), -1)
        return t, normal


class Cylinder(Solid):
    def inside(self, local: np.ndarray) -> np.ndarray:
        return (np.hypot(local[..., 0], local[..., 1]) <= self.size[0] / 2) & (abs(local[..., 2]) <= self.size[2] / 2)

    def hit(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r, h = self.size[0] / 2, self.size[2] / 2
        a = d[..., 0] ** 2 + d[..., 1] ** 2
        b = o[0] * d[..., 0] + o[1] * d[..., 1]
        disc = b**2 - a * (o[0] ** 2 + o[1] ** 2 - r**2)
        with np.errstate(invalid="ignore", divide="ignore"):
            side = (-b - np.sqrt(disc)) / a
            ok = (disc > 0) & (side > 0) & (np.abs(o[2] + side * d[..., 2]) <= h)
            side = np.where(ok, side, np.inf)
            top = (h - o[2]) / d[..., 2]
            p = o + top[..., None] * d
            top = np.where((top > 0) & (np.hypot(p[..., 0], p[..., 1]) <= r), top, np.inf)
        t = np.minimum(side, top)
        p = o + np.where(np.isfinite(t), t, 0.0)[..., None] * d
        normal = np.stack([p[..., 0] / r, p[..., 1] / r, np.zeros_like(t)], -1)
        normal[top <= side] = (0, 0, 1)
        return t, normal


def pattern(p: np.ndarray, seed: int) -> np.ndarray:
    """Solid value noise of two scales (12 and 5 mm) in [-1, 1] at points (..., 3)."""
    from scipy.ndimage import map_coordinates

    total = np.zeros(p.shape[:-1])
    for k, cell in enumerate((0.012, 0.005)):
        lattice = np.random.default_rng([seed, k]).uniform(-1, 1, (48, 48, 48))
        at_cell = np.moveaxis(p / cell + 100.3, -1, 0).reshape(3, -1)
        total += map_coordinates(lattice, at_cell, order=1, mode="grid-wrap").reshape(total.shape)
    return np.clip(total, -1, 1)


@dataclass
class Scene:
    """Solids and their poses in each frame: poses[frame][solid] is T_world_object (4, 4), or None: absent."""

    solids: list[Solid]
    poses: list[list[np.ndarray | None]]
    size: tuple[int, int] = (320, 240)
    table_texture: float = 0.25
    grid: VoxelGrid = field(default_factory=lambda: GRID)
    robot: int | None = None  # index of the solid that is the robot: in the robot mask, in no hypothesis

    def camera(self) -> Camera:
        w, h = self.size
        f = 0.84 * w
        pose = look_at(np.array([0.0, -0.62, 0.62]), np.array([0.0, 0.0, 0.03]))
        return Camera.from_intrinsics(f, f, (w - 1) / 2, (h - 1) / 2, w, h, pose)

    def trace(self, poses: list[np.ndarray | None]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Exact z-depth (H, W), ids (H, W) with 0 the table and i + 1 solid i, colour (H, W, 3) float."""
        camera = self.camera()
        M = camera.pose.as_matrix()
        origin, d = M[:3, 3], camera.rays() @ M[:3, :3].T
        best = -origin[2] / d[..., 2]
        normal = np.zeros_like(d)
        normal[..., 2] = 1.0
        ids = np.zeros(best.shape, int)
        colour = np.full(d.shape, 150.0)
        shade = 1 + self.table_texture * pattern(origin + best[..., None] * d, 99)
        for i, (solid, T) in enumerate(zip(self.solids, poses, strict=True)):
            if T is None:
                continue
            o_local = T[:3, :3].T @ (origin - T[:3, 3])
            d_local = d @ T[:3, :3]
            d_local[np.abs(d_local) < 1e-12] = 1e-12
            t, n = solid.hit(o_local, d_local)
            closer = t < best
            best[closer], ids[closer] = t[closer], i + 1
            normal[closer] = n[closer] @ T[:3, :3].T
            colour[closer] = solid.colour
            local = o_local + t[closer][:, None] * d_local[closer]
            shade[closer] = 1 + solid.texture * pattern(local, solid.seed + 7)
        light = 0.55 + 0.45 * np.clip(normal @ (np.array([0.3, -0.5, 0.81])), 0, 1)
        return best, ids, colour * (shade * light)[..., None]

    def frame(self, rng: np.random.Generator, poses: list[np.ndarray | None], noise: float = 1.0) -> Frame:
        """One noisy RGB-D image: disparity noise, quantisation, missing depth on edges, colour noise."""
        z, ids, colour = self.trace(poses)
        rgb = np.clip(np.round(colour + noise * rng.normal(0, 2.5, colour.shape)), 0, 255).astype(np.uint8)
        depth = z
        if noise:
            disparity = 315.0 / z + noise * rng.normal(0, 0.5, z.shape)
            depth = 315.0 / np.round(disparity)
            edge = np.zeros(z.shape, bool)
            for axis in (0, 1):
                jump = np.abs(np.diff(z, axis=axis)) > 0.02
                edge[(slice(None, -1), slice(None))[:: 1 if axis == 0 else -1]] |= jump
                edge[(slice(1, None), slice(None))[:: 1 if axis == 0 else -1]] |= jump
            depth[edge & (rng.random(z.shape) < 0.3)] = np.nan
        mask = None if self.robot is None else ids == self.robot + 1
        return Frame(rgb, depth.astype(np.float32), self.camera(), mask)

    def labels(self, poses: list[np.ndarray | None]) -> np.ndarray:
        """Truth: voxel centres inside the solids (first solid wins), uint16, solid i has label i + 1."""
        out = np.zeros(self.grid.shape, np.uint16)
        centres = self.grid.centres()
        for i in reversed(range(len(self.solids))):
            T = poses[i]
            if T is None or i == self.robot:
                continue
            out[self.solids[i].inside((centres - T[:3, 3]) @ T[:3, :3])] = i + 1
        return out

    def motions(self) -> dict[int, np.ndarray]:
        """T (4, 4) world, first to last frame, by label."""
        first, last = self.poses[0], self.poses[-1]
        return {
            i + 1: b @ np.linalg.inv(a)
            for i, (a, b) in enumerate(zip(first, last, strict=True))
            if a is not None and b is not None and i != self.robot
        }

    def clip(self, seed: int = 0, noise: float = 1.0) -> Clip:
        rng = np.random.default_rng(seed)
        frames = tuple(self.frame(rng, p, noise) for p in self.poses)
        return Clip(frames, self.grid, 1, tuple(0.2 * i for i in range(len(frames))))

    def hypothesis(self) -> Hypothesis:
        return Hypothesis.from_labels(self.labels(self.poses[0]), self.grid)


def errors(T: np.ndarray | RigidTransform, truth: np.ndarray, centre: np.ndarray) -> tuple[float, float]:
    """Error of a motion in millimetres at a point, and degrees."""
    D = np.linalg.inv(truth) @ (T.as_matrix() if isinstance(T, RigidTransform) else T)
    mm = 1000 * np.linalg.norm((D @ np.append(centre, 1.0))[:3] - centre)
    return float(mm), float(np.degrees(Rotation.from_matrix(D[:3, :3]).magnitude()))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def standard(
    n_frames: int = 12, texture: float = 0.5, size: tuple[int, int] = (320, 240), plain_table: bool = False
) -> Scene:
    """Six solids: 1 box pushed 12 cm and 25 deg, 2 cylinder 6 cm and 40 deg of spin, 3, 4, 6 static, 5 twin of 4
    that slides away 9 cm and 30 deg, 7 the pusher (robot)."""
    solids = [
        Box((0.12, 0.08, 0.10), (170, 110, 70), texture, 1),
        Cylinder((0.07, 0.07, 0.11), (80, 140, 90), texture, 2),
        Box((0.09, 0.14, 0.07), (90, 100, 170), texture, 3),
        Box((0.08, 0.08, 0.08), (170, 70, 90), texture, 4),
        Box((0.08, 0.08, 0.08), (170, 70, 90), texture, 4),
        Cylinder((0.10, 0.10, 0.04), (160, 150, 60), texture, 6),
        Cylinder((0.022, 0.022, 0.25), (60, 60, 60), 0.1, 7),
    ]
    ends = [
        (at(-0.20, -0.02, 0.05, 10), at(-0.09, -0.07, 0.05, 35)),
        (at(0.02, 0.10, 0.055), at(0.07, 0.13, 0.055, 40)),
        (at(-0.14, 0.18, 0.035, 20), at(-0.14, 0.18, 0.035, 20)),
        (at(0.16, -0.05, 0.04, 5), at(0.16, -0.05, 0.04, 5)),
        (at(0.24, -0.043, 0.04, 5), at(0.29, 0.03, 0.04, 35)),
        (at(0.02, -0.16, 0.02), at(0.02, -0.16, 0.02)),
    ]
    tracks = [slide(a, b, n_frames) for a, b in ends]
    tracks.append(
        [at(-0.30, -0.02, 0.3)]
        + slide(at(-0.28, -0.0, 0.14), at(-0.17, -0.05, 0.14), n_frames - 2)
        + [at(-0.30, 0.0, 0.5)]
    )
    poses = [[track[i] for track in tracks] for i in range(n_frames)]
    return Scene(solids, poses, size, 0.0 if plain_table else 0.25, robot=6)
