"""Meshes of hypotheses for other programs, written with open3d.

>>> export_mesh(hypothesis, "scene.ply")
>>> export_mesh(hypothesis, "scene.obj", assign_identities(run).colours(t, k))      # the colours of the report

Objects share no vertices. The z axis points up as in the recording.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mstfilter.app.report.pictures import Colour, colour
from mstfilter.base.errors import InputError
from mstfilter.base.files import atomic_path
from mstfilter.base.lazy import import_open3d
from mstfilter.mst.belief import BelievedObject
from mstfilter.scene import Hypothesis

# Corners of the face of a unit voxel towards +axis, counter-clockwise seen from outside; reversed towards -axis.
_CORNERS = {
    0: np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]),
    1: np.array([[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]]),
    2: np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]),
}


def voxel_faces(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of the faces between the voxels of a mask (X, Y, Z) bool, which must not be empty, and other voxels.

    Returns corners (v, 3) int, in voxels from the lower corner of the grid, and the indices (f, 3) int of the corners
    of each triangle. Seen from outside, the corners of a triangle are in counter-clockwise order.
    """
    padded = np.pad(mask, 1)
    quads = []
    for axis, face in _CORNERS.items():
        for sign in (1, -1):
            neighbour = np.roll(padded, -sign, axis=axis)
            corners = face
            if sign < 0:
                corners = face[::-1].copy()
                corners[:, axis] = 0
            quads.append(np.argwhere(padded & ~neighbour)[:, None, :] - 1 + corners)
    vertices, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def object_mesh(hypothesis: Hypothesis, label: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (v, 3) in world metres and triangles (f, 3) of the surface of an object; see `voxel_faces`."""
    hypothesis.record(label)
    corners, triangles = voxel_faces(hypothesis.mask(label))
    return hypothesis.grid.origin + corners * hypothesis.grid.voxel_size, triangles


def smooth_mesh(one: BelievedObject) -> tuple[np.ndarray, np.ndarray]:
    """Corners (v, 3) in world metres and triangles (f, 3) of the surface on which an object has probability .5.

    The surface is closed (marching cubes). Seen from outside, the corners of a triangle are in counter-clockwise
    order. If no voxel has probability .5, because hypotheses disagree on the place, the level is half of the largest.
    """
    from skimage.measure import marching_cubes

    p = np.pad(np.asarray(one.shape.probability, dtype=np.float32), 1)
    level = min(0.5, float(p.max()) / 2)
    corners, triangles, _, _ = marching_cubes(p, level, gradient_direction="ascent")
    return one.origin + (one.shape.offset + corners - 0.5) * one.voxel_size, triangles


def export_mesh(hypothesis: Hypothesis, path: str | Path, colours: Mapping[int, Colour] | None = None) -> Path:
    """Write the mesh of a hypothesis to a ply or obj file, in world metres. The hypothesis must have an object.

    The triangles are the outer faces of the objects. The mesh of an object encloses exactly the volume of its voxels.
    `colours` is ``{label: (r, g, b)}``. By default, the colours of the palette are used in order of labels. Raises
    MissingLibraryError if open3d cannot be imported.
    """
    path, o3d = Path(path), import_open3d()
    mesh = o3d.geometry.TriangleMesh()
    for k, record in enumerate(hypothesis.objects):
        corners, triangles = object_mesh(hypothesis, record.label)
        vertices = o3d.utility.Vector3dVector(corners)
        part = o3d.geometry.TriangleMesh(vertices, o3d.utility.Vector3iVector(triangles))
        part.paint_uniform_color(np.array(colour(k) if colours is None else colours[record.label]) / 255)
        mesh += part
    with atomic_path(path) as partial, TemporaryDirectory(dir=partial.parent) as folder:
        work = str(Path(folder) / path.name)  # open3d writes the name into OBJ files
        if not o3d.io.write_triangle_mesh(work, mesh):
            raise InputError(f"open3d cannot write the mesh {path}", "choose another folder")
        os.replace(work, partial)
    return path
