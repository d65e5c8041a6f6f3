"""DSR-Net: one hdf5 file of volumes a step, ``ID_k.hdf5``; several steps of one sequence are a recording.

>>> Dsr(sequence="17").open(Path("real_test_data"))

The data are volumes at 4 mm: ``tsdf`` and ``mask_3d`` (true objects, also hidden parts), both (y, x, z), and a top
view ``color_heightmap``. There are no camera images, so the frames are drawn: a camera 1 m above the table looks down
on the heights of the tsdf, coloured by the height map. That loses what a slanted view would show, has no sensor
noise, and is said in the manifest. Every step is a pause, and the truth is ``mask_3d``. Needs h5py (extra ``h5py``).
Format: Xu, He et al. 2020 (DSR-Net), https://github.com/columbia-ai-robotics/dsr.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError, MissingLibraryError
from mstfilter.formats.interfaces import Format
from mstfilter.scene import Camera, Frame, LazyFrames, Recording, VoxelGrid, as_labels, look_at, render

__all__ = ["Dsr"]

_KEYS = ("tsdf", "mask_3d", "color_heightmap")
_ABOVE = 1.0  # metres from the table to the drawn camera
_PIXELS = 2  # along a voxel at the table


@dataclass(frozen=True)
class Dsr(Format):
    """DSR-Net: hdf5 volumes of each step; frames are drawn from above, mask_3d is the truth.

    Parameters
    ----------
    sequence : str or int
        Which sequence, the part of the file names before the last ``_``. Default: the only one.
    voxel_size : float
        Metres.
    origin : tuple of 3 float
        World x, y, z (metres) of voxel 0, 0, 0; its z is the table's.
    """

    sequence: str | int = ""
    voxel_size: float = 0.004
    origin: tuple[float, ...] = (0.244, -0.256, 0.0)

    @classmethod
    def detects(cls, path: Path) -> bool:
        """See `Format`."""
        return path.is_dir() and any(path.glob("*_0.hdf5"))

    def open(self, path: Path) -> Recording:
        """See `Format`."""
        steps = self._steps(path)
        shape = _read(steps[0])["tsdf"].shape
        # Voxel k of the data is centred at origin + k * size, of ours at origin + (k + 1/2) * size.
        corner = np.array(self.origin) - self.voxel_size / 2
        grid = VoxelGrid(corner, self.voxel_size, (shape[1], shape[0], shape[2]))
        middle = self.voxel_size * np.array(grid.shape) / 2 + corner
        table = np.array([middle[0], middle[1], self.origin[2]])
        width, height = grid.shape[0] * _PIXELS, grid.shape[1] * _PIXELS
        focal = _PIXELS * _ABOVE / self.voxel_size
        pose = look_at(table + [0, 0, _ABOVE], table, up=(0, 1, 0))
        camera = Camera.from_intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, pose)

        def volumes(index: int) -> dict[str, np.ndarray]:
            data = _read(steps[index])
            if data["tsdf"].shape != shape:
                raise InputError(f"{steps[index]}: tsdf has shape {data['tsdf'].shape}, the first {shape}")
            return data

        def truth(index: int) -> np.ndarray:
            return as_labels(np.swapaxes(volumes(index)["mask_3d"], 0, 1), f"{steps[index]}: mask_3d")

        return Recording(
            LazyFrames(lambda index: _draw(volumes(index), grid, camera), range(len(steps)), OrderedDict()),
            grid,
            tuple(range(len(steps))),
            tuple(float(k) for k in range(len(steps))),
            name=f"{path.resolve().name}-{steps[0].stem.rpartition('_')[0]}",
            path=path,
            depth_scale=0.0001,
            manifest={"generator": "frames drawn from DSR-Net volumes, camera 1 m above the table"},
            read_truth=truth,
        )

    def _steps(self, path: Path) -> list[Path]:
        """Files of the chosen sequence in order."""
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
    """The volumes of a step."""
    try:
        import h5py
    except ImportError as error:
        raise MissingLibraryError(
            "DSR-Net data need h5py, which is not installed", "pip install 'mstfilter[h5py]'"
        ) from error
    try:
        with h5py.File(path, "r") as file:
            data: dict[str, Any] = {key: np.asarray(file[key]) for key in _KEYS}
    except (OSError, KeyError, RuntimeError) as error:
        raise InputError(f"{path} does not hold {', '.join(_KEYS)}: {error}") from error
    volume, top = data["tsdf"].shape, data["color_heightmap"].shape
    if len(volume) != 3 or data["mask_3d"].shape != volume or top != (*volume[:2], 3):
        raise InputError(
            f"{path}: tsdf, mask_3d and color_heightmap have shapes {volume}, {data['mask_3d'].shape}, {top}",
            "expected (y, x, z), (y, x, z), (y, x, 3)",
        )
    data["mask_3d"] = data["mask_3d"].astype(np.int64)
    return data


def _draw(data: dict[str, np.ndarray], grid: VoxelGrid, camera: Camera) -> Frame:
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
