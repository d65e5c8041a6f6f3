"""BOP: one folder a scene with ``scene_camera.json``, ``rgb/``, ``depth/`` and, where known, ``mask_visib/``.

>>> Bop().open(Path("ycbv/test/000048"))

``scene_camera.json`` gives ``cam_K`` and ``depth_scale`` (a stored unit in millimetres) for each image, and
sometimes the camera's pose ``cam_R_w2c``, ``cam_t_w2c`` (mm). Masks become instance images: the k-th annotated
object is label k + 1. The scenes are shots rather than videos: every image is a pause unless another rule is given.
Format: Hodan et al. 2018, https://github.com/thodan/bop_toolkit.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.errors import InputError
from mstfilter.formats.interfaces import Format
from mstfilter.formats.pauses import Every, PauseRule
from mstfilter.formats.video import Images, Video, World
from mstfilter.scene import Recording, read_depth, read_labels, read_rgb, rigid_from_matrix

__all__ = ["Bop"]


@dataclass(frozen=True)
class Bop(Format):
    """BOP: a scene's folder with scene_camera.json, rgb/, depth/; mask_visib/ as true instances.

    Parameters
    ----------
    images : tuple of int
        Numbers of the images to use, in order. Default: all.
    fps : float
        The layout has no times: image k is at k / fps seconds.
    pauses : PauseRule
        Which images are pauses.
    world : World
        Pose and workspace, where known.
    """

    images: tuple[int, ...] = ()
    fps: float = 1.0
    pauses: PauseRule = field(default_factory=Every)
    world: World = field(default_factory=World)

    @classmethod
    def detects(cls, path: Path) -> bool:
        """See `Format`."""
        return (path / "scene_camera.json").is_file()

    def open(self, path: Path) -> Recording:
        """See `Format`."""
        cameras = _cameras(path / "scene_camera.json")
        chosen = self.images or tuple(sorted(cameras))
        absent = [k for k in chosen if k not in cameras]
        if absent or not chosen:
            raise InputError(
                f"{path}: image {absent[0] if absent else ''} is not in scene_camera.json, which has {len(cameras)}"
            )
        first = cameras[chosen[0]]
        for k in chosen:
            if cameras[k]["cam_K"] != first["cam_K"]:
                raise InputError(
                    f"{path / 'scene_camera.json'}: cam_K of image {k} differs from that of image {chosen[0]}",
                    "choose images of one camera: images=0,1,2",
                )
        K = first["cam_K"]
        colour = {k: _image(path, ("rgb", "gray"), k) for k in chosen}
        depth = {k: _image(path, ("depth",), k) for k in chosen}

        def read(index: int) -> Images:
            k = chosen[index]
            scale = cameras[k]["depth_scale"] / 1000
            names = f"colour image {colour[k]}", f"depth image {depth[k]}"
            return Images(read_rgb(colour[k]), read_depth(depth[k], scale), *names)

        return Video(
            f"{path.resolve().parent.name}-{path.resolve().name}",
            tuple(i / self.fps for i in range(len(chosen))),
            read,
            (K[0], K[4], K[2], K[5]),
            path,
            first["depth_scale"] / 1000,
            read_rgb=lambda index: read_rgb(colour[chosen[index]]),
            motion=_motion(cameras, chosen),
            read_instance=lambda index: _instances(path, chosen[index]),
        ).recording(self.pauses, self.world)


def _cameras(path: Path) -> dict[int, dict[str, Any]]:
    """Entries of scene_camera.json by image number."""
    try:
        found = {int(k): dict(v) for k, v in json.loads(path.read_text()).items()}
        for k, entry in found.items():
            where = f"image {k}"
            if len(entry["cam_K"]) != 9 or not np.isfinite(entry["cam_K"]).all():
                raise ValueError(f"cam_K of {where} is not 9 numbers")
            if "depth_scale" not in entry:
                raise KeyError(f"{where} has no depth_scale")
            entry["depth_scale"] = float(entry["depth_scale"])
    except FileNotFoundError:
        raise InputError(
            f"not a BOP scene: {path} is missing", "give the folder of one scene, like test/000048"
        ) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} does not give cam_K and depth_scale of each image: {error}",
            "depth_scale times a stored value is millimetres",
        ) from error
    return found


def _image(path: Path, parts: tuple[str, ...], k: int) -> Path:
    """The file of an image number."""
    for part in parts:
        for suffix in (".png", ".jpg", ".tif"):
            file = path / part / f"{k:06d}{suffix}"
            if file.is_file():
                return file
    raise InputError(
        f"image is missing: {path / parts[0] / f'{k:06d}.png'}",
        "scene_camera.json names it; each image needs colour and depth",
    )


def _motion(cameras: dict[int, dict[str, Any]], chosen: tuple[int, ...]) -> list[RigidTransform] | None:
    """T_world_camera of each image in BOP's world, None where one is unknown."""
    if not all("cam_R_w2c" in cameras[k] and "cam_t_w2c" in cameras[k] for k in chosen):
        return None
    poses = []
    for k in chosen:
        matrix = np.eye(4)
        try:
            matrix[:3, :3] = np.reshape(cameras[k]["cam_R_w2c"], (3, 3))
            matrix[:3, 3] = np.asarray(cameras[k]["cam_t_w2c"], dtype=float) / 1000
        except ValueError as error:
            raise InputError(f"scene_camera.json: pose of image {k} is no pose: {error}") from error
        poses.append(rigid_from_matrix(matrix, f"scene_camera.json: pose of image {k}").inv())
    return poses


def _instances(path: Path, k: int) -> np.ndarray | None:
    """Label image (H, W) uint16 from the masks of an image; None where there are none."""
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
    return labels
