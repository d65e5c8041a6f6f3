"""The data sets of BOP, with ground truth.

>>> Bop().open(Path("ycbv/test/000048"))
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.errors import InputError
from mstfilter.files import reading
from mstfilter.formats.pauses import EveryNth
from mstfilter.formats.video import KnownWorld, RecordingFormat, Video, object_numbers
from mstfilter.reading import read_json
from mstfilter.scene import PauseRule, Recording, read_labels, rigid_from_matrix


@dataclass(frozen=True)
class Bop(RecordingFormat):
    """BOP: the folder of a scene with scene_camera.json, rgb/, depth/; mask_visib/ as true instances.

    ``scene_camera.json`` gives ``cam_K`` and ``depth_scale`` (millimetres per unit) of each image, and sometimes the
    camera pose ``cam_R_w2c``, ``cam_t_w2c`` (mm). The mask of the k-th annotated object has label k + 1 in the
    instance image. By default every image is a pause, because the scenes are single images rather than videos.
    Format: Hodan et al. 2018, https://github.com/thodan/bop_toolkit.

    Parameters
    ----------
    images : tuple of int
        Numbers of the images to use, in order. Default: all.
    pauses : PauseRule
        The rule that finds the pauses.
    world : KnownWorld
        Pose and workspace, if they are known.
    """

    images: tuple[int, ...] = ()
    pauses: PauseRule = field(default_factory=EveryNth)
    world: KnownWorld = field(default_factory=KnownWorld)

    @classmethod
    def detects(cls, path: Path) -> bool:
        return (path / "scene_camera.json").is_file()

    def open(self, path: Path) -> Recording:
        cameras = _cameras(path / "scene_camera.json")
        chosen = self.images or tuple(sorted(cameras))
        absent = [k for k in chosen if k not in cameras]
        if absent or not chosen:
            raise InputError(
                f"{path}: image {absent[0] if absent else ''} is not in scene_camera.json, which has {len(cameras)}"
            )
        first = cameras[chosen[0]]
        for k, name in itertools.product(chosen, ("cam_K", "depth_scale")):
            if cameras[k][name] != first[name]:
                raise InputError(
                    f"{path / 'scene_camera.json'}: {name} of image {k} differs from that of image {chosen[0]}",
                    "choose images of one camera: images=0,1,2",
                )
        K = first["cam_K"]
        return Video.of_files(
            f"{path.resolve().parent.name}-{path.resolve().name}",
            tuple(float(i) for i in range(len(chosen))),
            [(_image(path, ("rgb", "gray"), k), _image(path, ("depth",), k)) for k in chosen],
            (K[0], K[4], K[2], K[5]),
            path,
            first["depth_scale"] / 1000,
            motion=_motion(cameras, chosen),
            read_instance=lambda index: _instances(path, chosen[index]),
        ).recording(self.pauses, self.world)


def _cameras(path: Path) -> dict[int, dict[str, Any]]:
    """Entries of scene_camera.json by image number."""
    hints = "give the folder of one scene, for example test/000048", "depth_scale is in millimetres per unit"
    with reading(path, "a BOP scene", *hints):
        found = {int(k): dict(v) for k, v in read_json(path, "a BOP scene", *hints).items()}
        for k, entry in found.items():
            where = f"image {k}"
            if len(entry["cam_K"]) != 9 or not np.isfinite(entry["cam_K"]).all():
                raise ValueError(f"cam_K of {where} is not 9 numbers")
            if "depth_scale" not in entry:
                raise ValueError(f"{where} has no depth_scale")
            entry["depth_scale"] = float(entry["depth_scale"])
    return found


def _image(path: Path, parts: tuple[str, ...], k: int) -> Path:
    for part in parts:
        for suffix in (".png", ".jpg", ".tif"):
            file = path / part / f"{k:06d}{suffix}"
            if file.is_file():
                return file
    raise InputError(
        f"image is missing: {path / parts[0] / f'{k:06d}.png'}",
        "scene_camera.json lists it; each image needs colour and depth",
    )


def _motion(cameras: dict[int, dict[str, Any]], chosen: tuple[int, ...]) -> list[RigidTransform] | None:
    """T_world_camera of each image in the world of BOP; None if one is unknown."""
    if not all("cam_R_w2c" in cameras[k] and "cam_t_w2c" in cameras[k] for k in chosen):
        return None
    poses = []
    for k in chosen:
        matrix = np.eye(4)
        try:
            matrix[:3, :3] = np.reshape(cameras[k]["cam_R_w2c"], (3, 3))
            matrix[:3, 3] = np.asarray(cameras[k]["cam_t_w2c"], dtype=float) / 1000
        except ValueError as error:
            raise InputError(f"scene_camera.json: pose of image {k} is not a pose: {error}") from error
        poses.append(rigid_from_matrix(matrix, f"scene_camera.json: pose of image {k}").inv())
    return poses


def _instances(path: Path, k: int) -> np.ndarray | None:
    """Label image (H, W) uint16 from the masks of an image; None if there are none."""
    masks = sorted((path / "mask_visib").glob(f"{k:06d}_*.png"))
    if not masks:
        return None
    labels: np.ndarray | None = None
    for file in masks:
        mask = read_labels(file) > 0
        labels = np.zeros(mask.shape, np.uint16) if labels is None else labels
        if mask.shape != labels.shape:
            raise InputError(f"mask {file} has shape {mask.shape}, the others {labels.shape}")
        labels[mask] = int(file.stem.rpartition("_")[2]) + 1
    return None if labels is None else object_numbers(labels)
