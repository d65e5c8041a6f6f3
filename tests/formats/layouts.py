"""A short video of a known scene, written in each layout by the test itself."""

from __future__ import annotations

import json

import numpy as np

from mstfilter.formats import write_image
from mstfilter.scene import render
from tests.scene.scenes import CAMERA, GRID, table_scene

K = (131.0, 131.0, 79.5, 59.5)
SHIFTS = (*[0] * 6, 1, 2, 3, 4, *[5] * 7)
FPS = 10.0
PAUSES = (2, 13)
"""Middle frames of the two intervals in which nothing moves."""


def video(shifts=SHIFTS):
    """Colour images, depth in whole millimetres, and true labels of the frames."""
    scenes = {s: table_scene(s) for s in set(shifts)}
    rgb = np.stack([scenes[s][0] for s in shifts])
    depth = np.round(np.stack([scenes[s][1] for s in shifts]).astype(float), 3)
    return rgb, depth, [scenes[s][2] for s in shifts]


def units(depth, scale):
    return np.rint(np.nan_to_num(depth) / scale).astype(np.uint16)


def write_tum(path, shifts=SHIFTS, scale=0.0002, lag=0.004):
    rgb, depth, _ = video(shifts)
    for part in ("rgb", "depth"):
        (path / part).mkdir(parents=True)
    lists = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for k in range(len(rgb)):
        stamps = {"rgb": 1305031102.175 + k / FPS, "depth": 1305031102.175 + k / FPS + lag}
        write_image(path / "rgb" / f"{stamps['rgb']:.6f}.png", rgb[k])
        write_image(path / "depth" / f"{stamps['depth']:.6f}.png", units(depth[k], scale))
        for part, stamp in stamps.items():
            lists[part].append(f"{stamp:.6f} {part}/{stamp:.6f}.png")
    for part, lines in lists.items():
        (path / f"{part}.txt").write_text("\n".join(lines) + "\n")
    return path


def write_redwood(path, shifts=SHIFTS, scale=0.001):
    rgb, depth, _ = video(shifts)
    for part in ("color", "depth"):
        (path / part).mkdir(parents=True)
    for k in range(len(rgb)):
        write_image(path / "color" / f"{k:05d}.png", rgb[k])
        write_image(path / "depth" / f"{k:05d}.png", units(depth[k], scale))
    matrix = CAMERA.K.T.ravel().tolist()
    (path / "intrinsic.json").write_text(json.dumps({"width": 160, "height": 120, "intrinsic_matrix": matrix}))
    return path


def write_stray(path, shifts=SHIFTS):
    """Stray Scanner with a phone that stands still: a video, and depth of half its size."""
    import cv2

    rgb, depth, _ = video(shifts)
    (path / "depth").mkdir(parents=True)
    movie = cv2.VideoWriter(str(path / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), FPS, (160, 120))
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for k, image in enumerate(rgb):
        movie.write(np.ascontiguousarray(image[..., ::-1]))
        write_image(path / "depth" / f"{k:06d}.png", units(depth[k][1::2, 1::2], 0.001))
        rows.append(f"{100 + k / FPS}, {k:06d}, 1, 2, 3, 0, 0, 0, 1")
    movie.release()
    (path / "odometry.csv").write_text("\n".join(rows) + "\n")
    (path / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in CAMERA.K) + "\n")
    return path


def write_bop(path, shifts=SHIFTS):
    """A BOP scene with a still camera, masks of the objects, and depth in units of 0.1 mm."""
    rgb, depth, labels = video(shifts)
    for part in ("rgb", "depth", "mask_visib"):
        (path / part).mkdir(parents=True)
    for k, image in enumerate(rgb):
        write_image(path / "rgb" / f"{k:06d}.png", image)
        write_image(path / "depth" / f"{k:06d}.png", units(depth[k], 0.0001))
        shown = render(labels[k], GRID, CAMERA).labels
        for j in range(2):
            write_image(path / "mask_visib" / f"{k:06d}_{j:06d}.png", (shown == j + 1).astype(np.uint8) * 255)
    camera = {"cam_K": CAMERA.K.ravel().tolist(), "depth_scale": 0.1}
    (path / "scene_camera.json").write_text(json.dumps({k: camera for k in range(len(rgb))}))
    (path / "scene_gt.json").write_text(json.dumps({k: [{"obj_id": 7}, {"obj_id": 9}] for k in range(len(rgb))}))
    return path
