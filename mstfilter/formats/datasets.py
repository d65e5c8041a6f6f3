"""Data sets with ground truth: BOP scenes and DSR-Net sequences.

>>> Bop().open(Path("ycbv/test/000048"))
>>> Dsr(sequence="17").open(Path("real_test_data"))
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from mstfilter.errors import InputError, missing_library
from mstfilter.files import reading
from mstfilter.formats.pauses import EveryNth
from mstfilter.formats.video import KnownWorld, RecordingFormat, Video, object_numbers
from mstfilter.reading import MAX_FILE, open_regular, read_json
from mstfilter.scene import (
    Camera,
    Frame,
    LazyFrames,
    PauseRule,
    Recording,
    VoxelGrid,
    as_labels,
    look_at,
    read_depth,
    read_labels,
    read_rgb,
    render,
    rigid_from_matrix,
)


@dataclass(frozen=True)
class Bop(RecordingFormat):
    """BOP: the folder of a scene with scene_camera.json, rgb/, depth/. mask_visib/ becomes the true instances.

    ``scene_camera.json`` gives ``cam_K`` and ``depth_scale`` (millimetres per unit) of each image, and sometimes the
    camera pose ``cam_R_w2c``, ``cam_t_w2c`` (mm). The mask of the k-th annotated object has label k + 1 in the
    instance image. By default every image is a pause, because the scenes are single images and not videos. Format:
    Hodan et al. 2018, https://github.com/thodan/bop_toolkit.

    Parameters
    ----------
    images : tuple of int
        Numbers of the images to use, in order. By default, all images.
    fps : float
        Images per second, since the layout stores no times.
    pauses : PauseRule
        Rule that finds the pauses.
    world : KnownWorld
        Pose and workspace, if they are known.
    """

    images: tuple[int, ...] = ()
    fps: float = 1.0
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
        for k in chosen:
            if cameras[k]["cam_K"] != first["cam_K"]:
                raise InputError(
                    f"{path / 'scene_camera.json'}: cam_K of image {k} differs from that of image {chosen[0]}",
                    "choose images of one camera: images=0,1,2",
                )
        K = first["cam_K"]
        colour = [_image(path, ("rgb", "gray"), k) for k in chosen]
        depth = [_image(path, ("depth",), k) for k in chosen]
        scales = [cameras[k]["depth_scale"] / 1000 for k in chosen]

        return Video(
            f"{path.resolve().parent.name}-{path.resolve().name}",
            tuple(i / self.fps for i in range(len(chosen))),
            lambda index: read_rgb(colour[index]),
            lambda index: read_depth(depth[index], scales[index]),
            (K[0], K[4], K[2], K[5]),
            path,
            scales[0],
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


_KEYS = ("tsdf", "mask_3d", "color_heightmap")
_CAMERA_HEIGHT = 1.0  # metres above the table
_PIXELS = 2  # per voxel at the table


@dataclass(frozen=True)
class Dsr(RecordingFormat):
    """DSR-Net: hdf5 volumes of each step; frames are rendered from above, mask_3d is the ground truth.

    The data are one file per step, ``ID_k.hdf5``, with volumes at 4 mm: ``tsdf`` and ``mask_3d`` (true objects, also
    hidden parts), both (y, x, z), and a top view ``color_heightmap``. There are no camera images. The frames are
    rendered: a camera 1 m above the table looks down on the heights of the tsdf, with the colours of the height map.
    They show less than a slanted view and have no sensor noise; the manifest says so. Every step is a pause.
    Needs h5py (extra ``h5py``). Format: Xu, He et al. 2020, https://github.com/columbia-ai-robotics/dsr.

    Parameters
    ----------
    sequence : str or int
        The sequence: the part of the file names before the last ``_``. Default: the only one.
    voxel_size : float
        Metres.
    origin : tuple of 3 float
        World x, y, z (metres) of voxel 0, 0, 0; z is the height of the table.
    """

    sequence: str | int = ""
    voxel_size: float = 0.004
    origin: tuple[float, ...] = (0.244, -0.256, 0.0)

    @classmethod
    def detects(cls, path: Path) -> bool:
        return path.is_dir() and any(path.glob("*_0.hdf5"))

    def open(self, path: Path) -> Recording:
        steps = self._steps(path)
        shape = _read(steps[0])["tsdf"].shape
        # Voxel k of the data is centred at origin + k * size, of ours at origin + (k + 1/2) * size.
        corner = np.array(self.origin) - self.voxel_size / 2
        grid = VoxelGrid(corner, self.voxel_size, (shape[1], shape[0], shape[2]))
        middle = self.voxel_size * np.array(grid.shape) / 2 + corner
        table = np.array([middle[0], middle[1], self.origin[2]])
        width, height = grid.shape[0] * _PIXELS, grid.shape[1] * _PIXELS
        focal = _PIXELS * _CAMERA_HEIGHT / self.voxel_size
        pose = look_at(table + [0, 0, _CAMERA_HEIGHT], table, up=(0, 1, 0))
        camera = Camera.from_intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, pose)

        def volumes(index: int) -> dict[str, np.ndarray]:
            data = _read(steps[index])
            if data["tsdf"].shape != shape:
                raise InputError(f"{steps[index]}: tsdf has shape {data['tsdf'].shape}, the first {shape}")
            return data

        def truth(index: int) -> np.ndarray:
            return as_labels(np.swapaxes(volumes(index)["mask_3d"], 0, 1), f"{steps[index]}: mask_3d")

        return Recording(
            LazyFrames(lambda index: _rendered(volumes(index), grid, camera), len(steps)),
            grid,
            tuple(range(len(steps))),
            tuple(float(k) for k in range(len(steps))),
            name=f"{path.resolve().name}-{steps[0].stem.rpartition('_')[0]}",
            path=path,
            depth_scale=0.0001,
            manifest={"generator": "frames drawn from DSR-Net volumes, camera 1 m above the table"},
            truth=truth,
        )

    def _steps(self, path: Path) -> list[Path]:
        names = sorted({p.stem.rpartition("_")[0] for p in path.glob("*_*.hdf5")}, key=lambda s: (len(s), s))
        if not names:
            raise InputError(f"not a DSR-Net folder: {path} holds no ID_k.hdf5")
        wanted = str(self.sequence)
        if not wanted and len(names) > 1:
            raise InputError(
                f"{path} holds {len(names)} sequences: {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}",
                f"choose one: sequence={names[0]}",
            )
        chosen = wanted or names[0]
        if chosen not in names:
            raise InputError(f"{path} has no sequence {chosen!r}; there are {len(names)}: {', '.join(names[:8])}")
        found = {int(k): p for p in path.glob(f"{chosen}_*.hdf5") if (k := p.stem.rpartition("_")[2]).isdigit()}
        if sorted(found) != list(range(len(found))):
            raise InputError(f"{path}: steps of sequence {chosen} are {sorted(found)}, expected 0, 1, 2, ...")
        return [found[k] for k in range(len(found))]


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        import h5py
    except ImportError as error:
        raise missing_library(error, "a recording of DSR-Net", library="h5py") from error
    with reading(path, "a DSR-Net step", f"expected the arrays {', '.join(_KEYS)}"), open_regular(path):
        with h5py.File(path, "r") as file:
            if (size := sum(file[key].nbytes for key in _KEYS)) > MAX_FILE:
                raise ValueError(f"its arrays need {size} bytes, at most {MAX_FILE} are read")
            data: dict[str, Any] = {key: np.asarray(file[key]) for key in _KEYS}
        data["mask_3d"] = data["mask_3d"].astype(np.int64)
    volume, top = data["tsdf"].shape, data["color_heightmap"].shape
    if len(volume) != 3 or data["mask_3d"].shape != volume or top != (*volume[:2], 3):
        raise InputError(
            f"{path}: tsdf, mask_3d and color_heightmap have shapes {volume}, {data['mask_3d'].shape}, {top}",
            "expected (y, x, z), (y, x, z), (y, x, 3)",
        )
    return data


def _rendered(data: dict[str, np.ndarray], grid: VoxelGrid, camera: Camera) -> Frame:
    """Colour and depth from above: columns up to the highest voxel behind the surface, the table elsewhere."""
    behind = np.swapaxes(data["tsdf"], 0, 1) < 0
    behind[..., 0] = False  # the table itself
    top = np.where(behind.any(axis=2), grid.shape[2] - behind[..., ::-1].argmax(axis=2), 0)
    solid = (np.arange(grid.shape[2]) < top[..., None]).astype(np.uint16)
    seen = render(solid, grid, camera)
    table = camera.position[2] - (grid.origin[2] + grid.voxel_size / 2)
    depth = np.where(seen.labels > 0, seen.depth, table).astype(np.float32)
    column = np.clip(grid.index_of(camera.unproject(depth))[..., :2], 0, np.array(grid.shape[:2]) - 1)
    rgb = data["color_heightmap"].astype(np.uint8)[column[..., 1], column[..., 0]]
    return Frame(rgb, depth, camera)
