"""A short video of a known scene, written in each layout by the test itself."""

from __future__ import annotations

import json

import numpy as np

from mstfilter.formats import write_image
from tests.scene.scenes import CAMERA, table_scene

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
