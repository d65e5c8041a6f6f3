"""Completions from other programs: meshes, point clouds or voxel arrays of objects.

>>> mst = mstfilter.preset("mst", "update.completer=external", "update.completer.folder=shapes")

The page "Your own front end" of the documentation describes the files.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from mstfilter.base.errors import InputError, naming
from mstfilter.base.fields import bound_to
from mstfilter.base.files import reading
from mstfilter.base.lazy import import_open3d
from mstfilter.base.reading import MAX_FILE, read_bytes, unpack_arrays
from mstfilter.mst.completion import ClipCompleter, Completer, Completion, SurfaceOnly, observed_box
from mstfilter.mst.frontends.mask_files import read_label_image, read_weights
from mstfilter.scene import (
    Camera,
    Clip,
    Frame,
    ObjectView,
    Recording,
    UsesFiles,
    VoxelGrid,
    component_key,
    content_key,
    frame_points,
    memo,
    occupied_box,
)

_MESHES = (".ply", ".obj", ".stl", ".off")
_MASK = "mask.png"
#: Smallest IoU at which a mask gets the shapes of a stored mask, over pixels that can belong to an object.
_MIN_IOU = 0.5
_WEIGHTS = "weights.json"
#: Directions of the rays of the inside test; not along the axes, so that they miss edges of axis-parallel meshes.
_RAYS = np.array([[1.0, 1.1e-4, 1.7e-4], [1.3e-4, 1.0, 0.7e-4], [0.9e-4, 1.9e-4, 1.0]], np.float32)


@dataclass(frozen=True, eq=False)
class ObjectShapes:
    """The shapes of one object at one pause."""

    mask: np.ndarray  #: (H, W) bool
    files: tuple[Path, ...]
    weights: np.ndarray  #: (k,) probabilities of the files, their sum is 1


@dataclass(frozen=True)
class ExternalCompletion(ClipCompleter, SurfaceOnly, UsesFiles):
    """Completion by the shapes in a folder.

    A mask gets the shapes of the stored mask with the highest IoU, which must be at least 0.5. If the object has
    several shapes, each hypothesis draws one shape by weight. Voxels observed as free are cleared, and the visible
    surface is occupied.

    Parameters
    ----------
    folder : str
        The folder of shapes.
    axes : {"camera", "world"}
        The coordinate frame of the shapes.
    other : Completer, optional
        Completer of masks that match no stored mask. By default, such masks are an error.
    """

    folder: str = ""
    axes: Literal["camera", "world"] = "camera"
    other: Completer | None = None

    stochastic: ClassVar[bool] = True
    of_one_recording: ClassVar[bool] = True

    def check_files(self, recording: Recording) -> None:
        """Read the masks of all pauses, and place all shapes."""
        for clip in recording.clips():
            for one in read_shapes(self.folder, clip.index, clip.after.depth.shape):
                for path in one.files:
                    self._volume(path, clip.after.camera, clip.grid)

    def at(self, clip: Clip) -> ExternalCompletion:
        """The completer with the shapes of the pause at the end of the clip."""
        found = read_shapes(self.folder, clip.index, clip.after.depth.shape)
        return bound_to(self, _shapes=found, other=self.other and self.other.at(clip))

    def complete_each(
        self,
        rngs: Sequence[np.random.Generator],
        frame: Frame,
        masks: Sequence[np.ndarray],
        grid: VoxelGrid,
        views: Sequence[tuple[ObjectView, ...]] | None = None,
    ) -> list[Completion]:
        """Extend several masks to volumes by the shapes in the folder. `views` is not used.

        Raises InputError if `at` was not called before, or if a mask has no shapes.
        """
        if "_shapes" not in self.__dict__:
            raise InputError("ExternalCompletion does not know the pause of a frame", "call at(clip) first")
        return [
            self._place(rng, frame, np.asarray(mask, dtype=bool), grid) for rng, mask in zip(rngs, masks, strict=True)
        ]

    def _place(self, rng: np.random.Generator, frame: Frame, mask: np.ndarray, grid: VoxelGrid) -> Completion:
        shapes: tuple[ObjectShapes, ...] = self.__dict__["_shapes"]
        # The given mask has only pixels with a reading in the grid, so other pixels of stored masks do not count.
        known = np.zeros(mask.size, bool)
        known[frame_points(frame, grid)[0]] = True
        ious = [(mask & s.mask).sum() / max((mask | (s.mask & known.reshape(mask.shape))).sum(), 1) for s in shapes]
        best = int(np.argmax(ious)) if shapes else -1
        if best < 0 or ious[best] < _MIN_IOU:
            if self.other is None:
                raise InputError(
                    f"no stored shape fits a mask of {int(mask.sum())} pixels in {self.folder}: "
                    f"the best IoU is {max(ious, default=0):.2f}, at least {_MIN_IOU:g} is needed",
                    "name a completer for other masks, for example update.completer.other=extrude",
                )
            return self.other.complete_each([rng], frame, [mask], grid)[0]
        chosen = shapes[best]
        path = chosen.files[int(rng.choice(len(chosen.files), p=chosen.weights))]
        shape = self._volume(path, frame.camera, grid)
        offset, seen = observed_box(frame, mask, grid, self._reaching(shape, frame, mask, grid))
        box = tuple(slice(int(a), int(a) + n) for a, n in zip(offset, seen.points.shape, strict=True))
        p = np.where(seen.free, 0, np.maximum(shape[box], self.fill(rng, seen))).astype(np.float32)
        key = content_key("shape", np.packbits(mask), frame.key, grid.key, component_key(self), shape, path.name)
        return Completion(offset, p, seen.points, key.hex()[:16])

    def _volume(self, path: Path, camera: Camera, grid: VoxelGrid) -> np.ndarray:
        """Occupancy (X, Y, Z) float32 of the shape in a file, computed only once."""
        data = read_bytes(path, "a shape")
        T = camera.pose.as_matrix() if self.axes == "camera" else np.eye(4)
        key = (content_key(path.suffix, data, T), grid.key)
        return memo("external_shape", key, lambda: place_shape(path, data, T, grid))

    def _reaching(self, shape: np.ndarray, frame: Frame, mask: np.ndarray, grid: VoxelGrid) -> ExternalCompletion:
        """A copy of the completer with enough padding that the box of the mask contains the `shape` (X, Y, Z)."""
        occupied = occupied_box(shape > 0)
        readings = grid.index_of(frame.points[mask & frame.valid])
        readings = readings[grid.contains(readings)]
        if occupied is None or not len(readings):
            return self
        low, high = np.array([[s.start, s.stop] for s in occupied]).T
        reach = max((readings.min(axis=0) - low).max(), (high - 1 - readings.max(axis=0)).max(), 0)
        return bound_to(self, padding=int(reach))


def read_shapes(folder: str | Path, pause: int, shape: tuple[int, int]) -> tuple[ObjectShapes, ...]:
    """The mask and the shape files of each object at a pause. `shape` is the shape (H, W) of the image.

    Shape files are not read. Raises InputError if a file or folder is missing, or a mask or weights.json is invalid.
    """
    if not str(folder):
        raise InputError(
            "the folder of shapes is not given", "set folder, for example update.completer.folder=shapes"
        )
    where = Path(folder) / f"{pause:06d}"
    if not where.is_dir():
        raise InputError(
            f"folder of shapes has none for pause {pause}: {where} does not exist", "an empty one is allowed"
        )
    return tuple(_read_object(path, shape) for path in sorted(where.iterdir()) if path.is_dir())


def _read_object(folder: Path, shape: tuple[int, int]) -> ObjectShapes:
    if not (folder / _MASK).is_file():
        raise InputError(f"{folder} has no {_MASK}", "it marks the pixels of the object")
    mask = read_label_image(folder / _MASK, shape) > 0
    files = [p for p in sorted(folder.iterdir()) if p.name not in (_MASK, _WEIGHTS) and not p.name.startswith(".")]
    for path in files:
        if path.suffix not in (*_MESHES, ".npz"):
            raise InputError(f"{path} is not a file of a shape", f"expected {', '.join((*_MESHES, '.npz'))}")
    if not files:
        raise InputError(f"{folder} has no shape", f"expected files {', '.join((*_MESHES, '.npz'))}")
    given = np.array(read_weights(folder, files) or [1.0] * len(files))
    return ObjectShapes(mask, tuple(files), given / given.sum())


def place_shape(path: Path, data: bytes, T: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Occupancy (X, Y, Z) float32 of the shape in a file, moved by `T` (4, 4) into the world.

    Raises InputError if the file is invalid, or the shape is outside the grid or larger than two grid diagonals.
    """
    if path.suffix == ".npz":
        with reading(path, "a shape", "expected arrays of numbers from numpy.savez"):
            arrays = unpack_arrays(io.BytesIO(data), MAX_FILE)
        if "points" not in arrays and not {"occupancy", "origin", "voxel_size"} <= set(arrays):
            raise InputError(f"{path} has {', '.join(arrays)}; expected points, or occupancy, origin and voxel_size")
        if "occupancy" in arrays:
            volume = _resample(path, arrays, T, grid)
        else:
            volume = _cloud(_checked(path, arrays["points"], T, grid), grid)
    else:
        points, triangles = _read_mesh(path)
        points = _checked(path, points, T, grid)
        volume = _mesh(points, triangles, grid) if len(triangles) else _cloud(points, grid)
    if not (volume > 0).any():
        raise InputError(
            f"{path} occupies no voxel of the workspace from {grid.origin.tolist()} to {grid.upper.tolist()} m",
            "shapes are in metres, in the frame that the field `axes` names",
        )
    return volume


def _checked(path: Path, points: np.ndarray, T: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Points (n, 3) moved by `T` into the world, after checks of shape, values and size."""
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
        raise InputError(f"{path} has points of shape {points.shape}, expected (n, 3)")
    if points.dtype.kind not in "fiu" or not np.isfinite(points).all():
        raise InputError(f"{path} has a point that is not finite")
    extent = float(np.linalg.norm(np.ptp(points.astype(np.float64), axis=0)))
    limit = 2 * float(np.linalg.norm(grid.upper - grid.origin))
    if extent > limit:
        raise InputError(f"{path} is {extent:.3g} m large, the workspace {limit / 2:.3g} m", "shapes are in metres")
    return points @ T[:3, :3].T + T[:3, 3]


def _resample(path: Path, arrays: dict[str, np.ndarray], T: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Occupancy (X, Y, Z): the value of the array's voxel at the centre of each grid voxel; 0 outside the array."""
    values = arrays["occupancy"]
    if values.ndim != 3 or values.dtype.kind not in "bfiu" or not values.size:
        raise InputError(f"{path}: occupancy has shape {values.shape} and type {values.dtype}, expected (A, B, C)")
    values = values.astype(np.float32)
    if not np.isfinite(values).all() or values.min() < 0 or values.max() > 1:
        raise InputError(f"{path}: occupancy is not between 0 and 1")
    with naming(str(path)):
        own = VoxelGrid(arrays["origin"], arrays["voxel_size"], values.shape)  # type: ignore[arg-type]
    centres = (grid.centres().reshape(-1, 3) - T[:3, 3]) @ T[:3, :3]
    index = own.index_of(centres)
    inside = own.contains(index)
    out = np.zeros(len(index), np.float32)
    out[inside] = values[tuple(index[inside].T)]
    return out.reshape(grid.shape)


def _cloud(points: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Occupancy (X, Y, Z): 1 for voxels that contain points, and for voxels that these voxels enclose."""
    from scipy.ndimage import binary_fill_holes

    index = grid.index_of(points)
    hit = np.zeros(grid.shape, dtype=bool)
    hit[tuple(index[grid.contains(index)].T)] = True
    box = occupied_box(hit)
    if box is not None:
        hit[box] = binary_fill_holes(hit[box])
    return hit.astype(np.float32)


def _read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) in a file; a point cloud has no triangles."""
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh: Any = o3d.io.read_triangle_mesh(str(path))
        points, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
        if not len(triangles) and path.suffix == ".ply":
            points = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    if not len(points):
        raise InputError(f"file of a shape cannot be read: {path} (open3d finds no vertices)", "export it again")
    return points, triangles


def _mesh(points: np.ndarray, triangles: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """Occupancy (X, Y, Z): 1 if rays in at least two of three directions cross the mesh an odd number of times."""
    o3d = import_open3d()
    low = np.clip(grid.index_of(points.min(axis=0)) - 1, 0, grid.shape)
    high = np.clip(grid.index_of(points.max(axis=0)) + 2, 0, grid.shape)
    out = np.zeros(grid.shape, np.float32)
    if (high <= low).any():
        return out
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    centre = points.mean(axis=0)  # subtracted, since rays have 32-bit floats
    scene.add_triangles(
        o3d.core.Tensor((points - centre).astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
    )
    index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), axis=-1)
    origins = (grid.centre_of(index).reshape(-1, 3) - centre).astype(np.float32)
    votes = np.zeros(len(origins), np.int64)
    for direction in _RAYS:
        rays = np.concatenate([origins, np.broadcast_to(direction, origins.shape)], axis=1)
        votes += scene.count_intersections(o3d.core.Tensor(rays)).numpy() % 2
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    out[box] = (votes >= 2).reshape(tuple(high - low))
    return out
