"""Results of the examination of a recording on correct recordings, and on wrong recordings made from them.

    python experiments/plausibility/run.py     # 12 minutes of one core; simulated recordings are cached
    python experiments/plausibility/run.py --only demo,s1 --out DIR   # recordings whose names begin so

Needs the real recordings in MSTFILTER_SHARED (default ../shared) under real/, and skips missing recordings.
Writes findings.csv (one row per recording and input) and statistics.csv (range of each statistic per input).
"""

from __future__ import annotations

import argparse
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.base.errors import InputError
from mstfilter.base.files import write_csv
from mstfilter.formats import PairedImages, open_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.scene import Camera, Frame, Recording, VoxelGrid, examine, find_world
from mstfilter.scene.alignment import edge_agreement
from mstfilter.scene.plausibility import Look, drift

HERE = Path(__file__).resolve().parent
REAL = Path(os.environ.get("MSTFILTER_SHARED", HERE.parents[2] / "shared")) / "real"
SHORT = {"fps": 1.0, "frames_per_clip": 3}
SIMULATED = [
    *(("demo", seed, {}) for seed in (1, 2, 3, 4, 5)),
    *((family, seed, SHORT) for family, seeds in (("table", (1, 2, 3)), ("s1", (1, 2, 1001))) for seed in seeds),
    *(("s2", seed, SHORT) for seed in (1, 2)),
    *(("s3", seed, SHORT | {"n_actions": 2}) for seed in (1, 1001)),
    ("table", 7, SHORT | {"n_actions": 1, "width": 1280, "height": 720, "supersample": False}),
    ("table", 8, SHORT | {"n_actions": 1, "camera_distance": 1.6}),
]
#: Recordings whose wrong variants are left out, to save time.
RIGHT_ONLY = ("demo-2", "demo-4", "demo-5", "table-2", "table-3", "s1-2", "s2-2")
GROUPS = [(0, 1), (2, 4), (6, 16), (17, 24), (25, 26), (27, 29), (31, 32), (33, 44), (5, 5), (30, 30)]


@dataclass(frozen=True)
class Scene:
    """The images at the pauses of a recording. Poses or workspace that are None are estimated from the images."""

    rgb: np.ndarray
    depth: np.ndarray
    K: np.ndarray
    poses: tuple[RigidTransform, ...] | None = None
    grid: VoxelGrid | None = None
    masks: np.ndarray | None = None

    @classmethod
    def of(cls, recording: Recording) -> Scene:
        frames = [recording.frames[p] for p in recording.pauses]
        masks = None
        if frames[0].robot_mask is not None:
            masks = np.stack(
                [np.zeros(f.depth.shape, bool) if f.robot_mask is None else f.robot_mask for f in frames]
            )
        poses = tuple(frame.camera.pose for frame in frames)
        images = np.stack([f.rgb for f in frames]), np.stack([f.depth for f in frames])
        return cls(*images, frames[0].camera.K, poses, recording.grid, masks)

    def first(self, n: int) -> Scene:
        """The first n pauses."""
        rest = {"poses": self.poses and self.poses[:n], "masks": None if self.masks is None else self.masks[:n]}
        return replace(self, rgb=self.rgb[:n], depth=self.depth[:n], **rest)

    def frames(self) -> tuple[list[Frame], VoxelGrid]:
        n, height, width = self.depth.shape
        masks = [None] * n if self.masks is None else list(self.masks)
        cameras = [Camera(self.K, width, height, None if self.poses is None else self.poses[k]) for k in range(n)]
        camera, grid, _ = find_world(Frame(self.rgb[0], self.depth[0], cameras[0], masks[0]), self.grid)
        cameras = cameras if self.poses is not None else [camera] * n
        return [Frame(*images) for images in zip(self.rgb, self.depth, cameras, masks, strict=True)], grid


def recordings() -> Iterator[tuple[str, Scene]]:
    """All correct recordings: simulated recordings with and without their pose, and real recordings."""
    for family, seed, changes in SIMULATED:
        scene = Scene.of(open_recording(cached_recording(family, seed, **changes)))
        yield f"{family}-{seed}", scene
        yield f"{family}-{seed} without pose", replace(scene, poses=None, grid=None)
    for path in sorted((REAL / "hots").glob("*")):
        yield path.name, replace(Scene.of(PairedImages().open(path)), poses=None, grid=None)
    for a, b in GROUPS if (REAL / "osd_learn").is_dir() else []:
        pairs = PairedImages(frames=tuple(f"learn{k}" for k in range(a, b + 1)))
        yield f"learn{a}-{b}", replace(Scene.of(pairs.open(REAL / "osd_learn")), poses=None, grid=None)
    if (REAL / "jack").is_dir():
        yield "jack", Scene.of(open_recording(REAL / "jack"))
    yield from two_cameras()


def two_cameras() -> Iterator[tuple[str, Scene]]:
    """Two cameras with known poses, and the second camera with a pose that is estimated from the table."""
    import json

    from mstfilter.formats import read_depth, read_rgb

    folder = REAL / "two_cameras"
    if not folder.is_dir():
        return
    poses = json.loads((folder / "poses.json").read_text())
    w = poses["workspace"]
    grid = VoxelGrid.from_bounds(np.array(w["min"]), np.array(w["max"]), w["voxel"])
    for k in (1, 2):
        fx, fy, cx, cy = json.loads((folder / f"camera{k}" / "info.json").read_text())["K"]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        names = sorted((folder / f"camera{k}").glob("*_rgb.png"))
        rgb = np.stack([read_rgb(name) for name in names])
        depth = np.stack([read_depth(name.with_name(name.name.replace("_rgb", "_depth")), 0.001) for name in names])
        pose = RigidTransform.from_matrix(np.array(poses[f"T_world_camera{k}"]))
        yield f"camera {k}", Scene(rgb, depth, K, (pose,) * len(rgb), grid)
        if k == 2:  # without its pose, the largest plane that camera 1 sees is a wall
            yield f"camera {k} without pose", Scene(rgb, depth, K)


def seen_from(scene: Scene, k: int, motion: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Images (rgb, depth) of pause k for a camera displaced by `motion` in its own axes; small holes are filled."""
    height, width = scene.depth.shape[1:]
    camera = Camera(scene.K, width, height)
    known = np.isfinite(scene.depth[k])
    points = motion.inv().apply(camera.unproject(scene.depth[k])[known])
    u, v, z, inside = camera.pixels_of(points)
    far_first = np.argsort(-z[inside])
    at = v[inside][far_first], u[inside][far_first]
    rgb, depth = np.zeros_like(scene.rgb[k]), np.full((height, width), np.nan, np.float32)
    rgb[at], depth[at] = scene.rgb[k][known][inside][far_first], z[inside][far_first]
    holes = ~np.isfinite(depth)
    nearest, around = cv2.dilate(np.nan_to_num(depth), np.ones((3, 3))), cv2.dilate(rgb, np.ones((3, 3)))
    filled = holes & (nearest > 0)
    depth[filled], rgb[filled] = nearest[filled], around[filled]
    return rgb, depth


def moved(x: float = 0, y: float = 0, pan: float = 0, tilt: float = 0) -> Callable[[Scene], Scene | None]:
    """Displaces the camera from pause 1 on: x m to the right, y m down, pan and tilt in degrees."""
    motion = RigidTransform.from_components([x, y, 0], Rotation.from_euler("yx", [pan, tilt], degrees=True))

    def change(scene: Scene) -> Scene | None:
        if len(scene.rgb) == 1:
            return None
        images = [(scene.rgb[0], scene.depth[0]), *(seen_from(scene, k, motion) for k in range(1, len(scene.rgb)))]
        return replace(scene, rgb=np.stack([i[0] for i in images]), depth=np.stack([i[1] for i in images]))

    return change


def followed(scene: Scene) -> Scene | None:
    """A moved camera with its true poses, which is a correct recording."""
    changed = moved(0.05, 0.03, 4, 3)(scene)
    if scene.poses is None or changed is None:
        return None
    motion = RigidTransform.from_components([0.05, 0.03, 0], Rotation.from_euler("yx", [4, 3], degrees=True))
    return replace(changed, poses=(scene.poses[0], *(pose * motion for pose in scene.poses[1:])))


def shifted(x: float = 0, y: float = 0, scale: float = 1) -> Callable[[Scene], Scene | None]:
    """Shifts depth by shares x and y of the image width, and scales it about the image centre."""

    def change(scene: Scene) -> Scene:
        height, width = scene.depth.shape[1:]
        tx, ty = x * width + (1 - scale) * width / 2, y * width + (1 - scale) * height / 2
        T = np.array([[scale, 0, tx], [0, scale, ty]], np.float32)
        size, nearest = (width, height), cv2.INTER_NEAREST
        fill = (float("nan"),)
        return replace(
            scene, depth=np.stack([cv2.warpAffine(d, T, size, flags=nearest, borderValue=fill) for d in scene.depth])
        )

    return change


def scaled_depth(factor: float) -> Callable[[Scene], Scene | None]:
    return lambda scene: replace(scene, depth=scene.depth * np.float32(factor))


def scaled_K(focal: float, centre: float) -> Callable[[Scene], Scene | None]:
    factors = np.array([[focal, 1, centre], [1, focal, centre], [1, 1, 1]])
    return lambda scene: replace(scene, K=scene.K * factors)


def on_floor(scene: Scene) -> Scene | None:
    """A table that ends 0.3 m (x) and 0.2 m (y) from the middle of the workspace, with the floor 0.7 m below."""
    frames, grid = scene.frames()
    middle = (grid.origin + grid.upper)[:2] / 2
    depth = []
    for frame in frames:
        beyond = (np.abs(frame.points[..., :2] - middle) > (0.3, 0.2)).any(axis=-1)
        direction = frame.camera.rays() @ frame.camera.pose.as_matrix()[2, :3]
        floor = (-0.7 - frame.camera.position[2]) / np.minimum(direction, -1e-6)
        depth.append(np.where(beyond, np.where(floor < 6, floor, np.nan), frame.depth))
    return replace(scene, depth=np.stack(depth).astype(np.float32))


def with_poses(change: Callable[[Scene], Scene]) -> Callable[[Scene], Scene | None]:
    return lambda scene: None if scene.poses is None else change(scene)


def several(change: Callable[[Scene], Scene]) -> Callable[[Scene], Scene | None]:
    return lambda scene: None if len(scene.rgb) < 2 else change(scene)


def turned(scene: Scene) -> Scene:
    return replace(scene, rgb=scene.rgb[:, ::-1, ::-1], depth=scene.depth[:, ::-1, ::-1])


INPUTS: dict[str, Callable[[Scene], Scene | None]] = {
    "right": lambda scene: scene,
    "right: moved camera with poses": followed,
    "camera moves 5 cm to the right": moved(x=0.05),
    "camera moves 5 cm up": moved(y=-0.05),
    "camera turns 8 degrees": moved(pan=8),
    "camera tilts 6 degrees": moved(tilt=6),
    "principal point at the corner": scaled_K(1, 0),
    "K of images twice as large": scaled_K(2, 2),
    "K of images half as large": scaled_K(0.5, 0.5),
    "normalised K": lambda s: replace(s, K=s.K * np.array([[1], [1], [640]]) / 640),
    "depth 5 times too large": scaled_depth(5),
    "depth 5 times too small": scaled_depth(0.2),
    "depth 4 times too large": scaled_depth(4),
    "inverse pose": with_poses(lambda s: replace(s, poses=tuple(pose.inv() for pose in s.poses or ()))),
    "pose, images upside down": with_poses(turned),
    "workspace in millimetres": with_poses(
        lambda s: replace(s, grid=VoxelGrid(1000 * s.grid.origin, 10.0, s.grid.shape)) if s.grid else s
    ),
    "floor around the table, without pose": lambda s: None if s.poses is not None else on_floor(s),
    "depth shifted by 3 % of the width": shifted(x=0.03),
    "depth shifted by -2.5 % and 2 %": shifted(-0.025, 0.02),
    "depth enlarged by 20 %": shifted(scale=1.2),
    "robot mask everywhere": with_poses(lambda s: replace(s, masks=np.ones(s.depth.shape, bool))),
    "constant depth": with_poses(lambda s: replace(s, depth=np.full_like(s.depth, 0.8))),
    "no pose from pause 1 on": with_poses(
        several(lambda s: replace(s, poses=(s.poses or ())[:1] + (RigidTransform.identity(),) * (len(s.rgb) - 1)))
    ),
    "uniform colour": lambda s: replace(s, rgb=np.full_like(s.rgb, 120)),
    "pauses all identical": several(
        lambda s: replace(s, rgb=s.rgb[[0] * len(s.rgb)], depth=s.depth[[0] * len(s.rgb)])
    ),
}


def statistics(looks: list[Look]) -> dict[str, float]:
    """The statistics that the examination compares with its limits."""
    first, camera = looks[0], looks[0].frame.camera
    tilt, height = (first.table.tilt, first.table.height) if first.table else (np.nan, np.nan)
    drifts = np.array([drift(first, look) for look in looks[1:]]).reshape(-1, 3)
    corners = [first.corners.moved(look.corners) for look in looks[1:]]
    peak, lost, _ = edge_agreement([look.edges for look in looks])
    return {
        "distance": float(np.median(first.frame.depth[first.frame.valid])),
        "tilt": tilt,
        "height": abs(height),
        "field": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.K[0, 0])))),
        "off_centre": max(abs((camera.K[:2, 2] + 0.5) / (camera.width, camera.height) - 0.5)),
        "drift_tilt": max(drifts[:, 0], default=np.nan),
        "drift_height": max(drifts[:, 1], default=np.nan),
        "drift_shift": max(drifts[:, 2], default=np.nan),
        "corners_moved": max((m for _, m, _ in corners), default=np.nan),
        "edge_lost": lost if peak >= 0.15 else np.nan,
    }


def examined(scene: Scene) -> dict[str, object]:
    """Findings, statistics, and milliseconds per pause of the examination."""
    try:
        frames, grid = scene.frames()
    except InputError as error:
        return {"result": "stop", "text": error.message}
    started = time.process_time()
    found = examine(frames, range(len(frames)), grid)
    seconds = (time.process_time() - started) / len(frames)
    result = "silent" if not found else "stop" if found[0].stop else "warning"
    row: dict[str, object] = {
        "result": result,
        "text": "; ".join(f.message for f in found),
        "ms": round(1000 * seconds),
    }
    if np.isfinite([frame.depth for frame in frames]).any():
        looks = [Look(frame, grid, k) for k, frame in enumerate(frames)]
        if all(look.frame.valid.any() for look in looks):
            row |= {key: round(float(value), 4) for key, value in statistics(looks).items()}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    arguments = parser.parse_args()
    rows: list[dict[str, object]] = []
    for name, scene in recordings():
        if not name.startswith(tuple(arguments.only.split(","))):
            continue
        for title, change in INPUTS.items():
            if title != "right" and name.startswith(RIGHT_ONLY):
                break
            changed = change(scene if title == "right" else scene.first(3))
            if changed is not None:
                rows.append({"recording": name, "input": title, **examined(changed)})
        print(name, flush=True)
    keys = ["recording", "input", "result", "ms", *statistics_names(rows), "text"]
    arguments.out.mkdir(exist_ok=True)
    write_csv(arguments.out / "findings.csv", [{key: row.get(key, "") for key in keys} for row in rows])
    write_csv(arguments.out / "statistics.csv", summary(rows))


def statistics_names(rows: list[dict[str, object]]) -> list[str]:
    return [key for key in max(rows, key=len) if key not in ("recording", "input", "result", "ms", "text")]


def summary(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """One row for each input: results, and the range of every statistic."""
    groups = defaultdict(list)
    for row in rows:
        groups[str(row["input"])].append(row)
    table = []
    for title, group in groups.items():
        results = [row["result"] for row in group]
        line: dict[str, object] = {"input": title, "recordings": len(group)}
        line |= {result: results.count(result) for result in ("stop", "warning", "silent")}
        for key in statistics_names(rows):
            values = np.array([row[key] for row in group if key in row], float)
            values = values[np.isfinite(values)]
            line[key] = f"{values.min():.3g} to {values.max():.3g}" if len(values) else ""
        table.append(line)
    return table


if __name__ == "__main__":
    main()
