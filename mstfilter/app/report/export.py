"""Meshes for other programs: smooth surfaces of believed objects, or the voxels of a hypothesis.

>>> export_mesh(belief.objects(), "scene.glb")                                      # for viewers and planners
>>> export_mesh(hypothesis, "scene.ply")
>>> export_mesh(hypothesis, "scene.obj", assign_identities(run).colours(t, k))      # the colours of the report
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mstfilter.app.report.pictures import Colour, colour
from mstfilter.base.errors import InputError, check_choice
from mstfilter.base.files import atomic_path, writing
from mstfilter.mst.belief import BelievedObject, ObjectTable
from mstfilter.scene import Hypothesis

_KINDS = ("glb", "ply", "obj", "stl")
_Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # from axes with z up

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


def export_mesh(
    scene: Hypothesis | ObjectTable, path: str | Path, colours: Mapping[int, Colour] | None = None
) -> Path:
    """Write the meshes of all objects to a file: .glb, .ply, .obj or .stl.

    Parameters
    ----------
    scene : Hypothesis or ObjectTable
        Of a hypothesis, the outer faces of the voxels, which enclose exactly their volume; of a table of objects
        (`Belief.objects`), smooth surfaces. It must have an object.
    path : path
        Coordinates are world metres with z up, but in .glb, whose axis up is y by definition. Objects are separate
        nodes ("object 3") in .glb, and share no vertices in the others. STL has no colours.
    colours : mapping, optional
        ``{label: (r, g, b)}``, of a table ``{number: (r, g, b)}``. Default: the palette in the order of the objects.

    Raises InputError for another ending, a scene without objects, and a file that cannot be written.
    """
    path = Path(path)
    kind = path.suffix[1:].lower()
    check_choice("ending of a mesh file", kind, _KINDS)
    data = mesh_bytes(scene, kind, colours)
    with writing(f"mesh {path}", "choose another file"), atomic_path(path) as partial:
        partial.write_bytes(data)
    return path


def mesh_bytes(scene: Hypothesis | ObjectTable, kind: str, colours: Mapping[int, Colour] | None = None) -> bytes:
    """The content of a mesh file of this kind ("glb"); see `export_mesh`."""
    import trimesh

    if isinstance(scene, Hypothesis):
        meshes = {record.label: object_mesh(scene, record.label) for record in scene.objects}
    else:
        meshes = {one.number: smooth_mesh(one) for one in scene}
    if not meshes:
        raise InputError("the scene has no objects, so there is no mesh", "check hypothesis.n_objects or len(table)")
    parts = {}
    for k, (name, (corners, triangles)) in enumerate(meshes.items()):
        part = trimesh.Trimesh(corners, triangles, process=False)
        part.visual = trimesh.visual.ColorVisuals(part, vertex_colors=colour(k) if colours is None else colours[name])
        parts[f"object {name}"] = part
    if kind == "glb":
        whole = trimesh.Scene(parts)
        whole.apply_transform(_Y_UP)
    else:
        whole = trimesh.util.concatenate(list(parts.values()))
    data = whole.export(file_type=kind)
    return data.encode() if isinstance(data, str) else bytes(data)
