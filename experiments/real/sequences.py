"""Real sequences with what is known about them: label images, classes, marked points, a second camera.

>>> for sequence in sequences(shared / "real"):
...     sequence.recording.clips(), sequence.truth(0)

HOTS and OSD (the groups of frames of one camera set-up) have label images at every pause and no video between pauses.
`jack` is a video of one toy. Of the two cameras, the first one is filtered and the second one is a witness.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial.transform import RigidTransform

from mstfilter import open_recording
from mstfilter.formats import PairedImages, read_depth, read_labels, read_rgb
from mstfilter.scene import Camera, Frame, Recording, VoxelGrid

SHARED = Path(os.environ.get("MSTFILTER_SHARED", Path(__file__).resolve().parents[3] / "shared")) / "real"
HOTS = ("mix_1", "office_6", "office_9", "table_7")
#: First and last frame of each group of OSD with one camera set-up.
OSD_GROUPS = ((0, 1), (2, 4), (6, 16), (17, 24), (25, 26), (27, 29), (31, 32), (33, 44))
#: Fold of the fit of the border model -> sequences that are left out: all of one camera set-up, or one sequence.
FOLDS = {
    "hots": HOTS,
    "osd, even": tuple(f"learn{a}-{b}" for a, b in OSD_GROUPS[::2]),
    "osd, odd": tuple(f"learn{a}-{b}" for a, b in OSD_GROUPS[1::2]),
} | {name: (name,) for name in HOTS}
#: A pixel (column, row) on each of the four objects of `two_cameras`, at every pause, marked by hand.
POINTS = {
    "carton": ((243, 299),) * 3
    + ((330, 280), (345, 241), (346, 244), (346, 241), (369, 244), (415, 258), (424, 248), (424, 248)),
    "yellow box": ((427, 258), (425, 258), (434, 308), (434, 311), (434, 311), (341, 343))
    + ((338, 345), (341, 345), (304, 341), (257, 323), (199, 336)),
    "blue box": ((185, 225),) * 3
    + ((211, 244), (204, 244), (206, 244), (207, 253), (207, 253), (202, 243), (193, 234), (239, 234)),
    "skateboard": ((475, 214),) * 3
    + ((483, 218), (485, 218), (478, 218), (475, 218), (468, 218), (478, 218), (483, 218), (485, 218)),
}
#: Normal and offset in metres of the wall in the workspace of `two_cameras`, fitted to the readings of camera 2.
WALL = (-0.795, 0.606, -0.029), 1.108
#: A pixel (column, row) on the toy at the five pauses of `jack`, marked by hand.
TOY = ((312, 337), (329, 315), (291, 304), (353, 310), (393, 300))
_ABOVE = 0.015  # metres: readings above the table that may belong to the toy
_WHITE = (90, 70)  # largest saturation and smallest value of the toy's pixels


@dataclass(frozen=True)
class Truth:
    """What is known about an image."""

    labels: np.ndarray  #: (H, W) int, true object of each pixel; 0 is no object, -1 is unknown
    names: dict[int, str] = field(default_factory=dict)  #: object -> name that is the same at all pauses


@dataclass(frozen=True)
class Sequence:
    """A recording and what is known about it."""

    name: str
    source: str  #: data set
    recording: Recording
    truth: Callable[[int], Truth]  #: of pause t
    witness: Callable[[int], Frame] | None = None  #: frame of another camera at pause t, in the same world


def sequences(folder: Path) -> Iterator[Sequence]:
    """All sequences that the folder has."""
    yield from (_hots(path) for path in sorted((folder / "hots").glob("*")))
    if (folder / "osd_learn").is_dir():
        yield from (_osd(folder / "osd_learn", *group) for group in OSD_GROUPS)
    if (folder / "jack").is_dir():
        yield _jack(folder / "jack")
    if (folder / "two_cameras").is_dir():
        yield _two_cameras(folder / "two_cameras")


def _hots(path: Path) -> Sequence:
    files, classes = sorted(path.glob("*_label.png")), json.loads((path / "info.json").read_text())["classes"]

    def truth(t: int) -> Truth:
        labels = read_labels(files[t]).astype(np.int64)
        kinds = read_labels(files[t].with_name(files[t].name.replace("_label", "_class")))
        names = {k: classes[np.bincount(kinds[labels == k]).argmax()] for k in np.unique(labels[labels > 0]).tolist()}
        return Truth(labels, {k: name for k, name in names.items() if list(names.values()).count(name) == 1})

    return Sequence(path.name, "hots", PairedImages().open(path), truth)


def _osd(folder: Path, first: int, last: int) -> Sequence:
    names = tuple(f"learn{k}" for k in range(first, last + 1))

    def truth(t: int) -> Truth:
        return Truth(read_labels(folder / f"{names[t]}_label.png").astype(np.int64) - 1)  # 0 is unknown, 1 the table

    return Sequence(f"learn{first}-{last}", "osd", PairedImages(frames=names).open(folder), truth)


def _jack(path: Path) -> Sequence:
    recording = open_recording(path)

    def truth(t: int) -> Truth:
        frame = recording.frames[recording.pauses[t]]
        hsv = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2HSV)
        with np.errstate(invalid="ignore"):
            white = (hsv[..., 1] <= _WHITE[0]) & (hsv[..., 2] >= _WHITE[1]) & (frame.points[..., 2] > _ABOVE)
        regions, _ = ndimage.label(white & frame.valid)
        column, row = TOY[t]
        return Truth(
            np.where(regions == regions[row, column], 1, -1) if regions[row, column] else -np.ones_like(regions)
        )

    return Sequence("jack", "jack", recording, truth)


def _two_cameras(folder: Path) -> Sequence:
    poses = json.loads((folder / "poses.json").read_text())
    space = poses["workspace"]
    grid = VoxelGrid.from_bounds(np.array(space["min"]), np.array(space["max"]), space["voxel"])

    def frames(k: int) -> list[Frame]:
        own = folder / f"camera{k}"
        fx, fy, cx, cy = json.loads((own / "info.json").read_text())["K"]
        pose, made = RigidTransform.from_matrix(np.array(poses[f"T_world_camera{k}"])), []
        for file in sorted(own.glob("*_rgb.png")):
            rgb = read_rgb(file)
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            depth = read_depth(file.with_name(file.name.replace("_rgb", "_depth")), 0.001)
            made.append(Frame(rgb, depth, Camera(K, rgb.shape[1], rgb.shape[0], pose)))
        return made

    first, second = frames(1), frames(2)
    recording = Recording.from_arrays(
        np.stack([f.rgb for f in first]),
        np.stack([f.depth for f in first]),
        first[0].camera.K,
        pauses=range(len(first)),
        name="two_cameras",
        T_world_camera=first[0].camera.T_world_camera,
        grid=grid,
    )

    def truth(t: int) -> Truth:
        labels = -np.ones(first[t].depth.shape, np.int64)
        for k, points in enumerate(POINTS.values(), start=1):
            column, row = points[t]
            labels[row - 2 : row + 3, column - 2 : column + 3] = k
        return Truth(labels, dict(enumerate(POINTS, start=1)))

    return Sequence("two_cameras", "two_cameras", replace(recording), truth, second.__getitem__)
