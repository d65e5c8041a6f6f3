"""Objects with a triangle mesh as surface: colours and normals of surface points, convex pieces for the physics.

A `MeshSurface` is a mesh that is prepared for simulation. Rays hit the mesh itself, contacts use convex pieces of the
mesh, and the true volume comes from parallel rays (`volumes`).

The convex pieces are made by the library CoACD (Wei, Liu, Ling and Su, "Approximate convex decomposition for 3D
meshes with collision-aware concavity and tree search", ACM Transactions on Graphics 41(4), 2022), which takes
seconds. So a prepared surface is stored in the user's cache folder, under a hash of the mesh (`prepared_mesh`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, missing_library
from mstfilter.base.files import atomic_path, make_folders
from mstfilter.base.reading import read_arrays
from mstfilter.lab.simulation.solids import Piece, hull, perpendicular
from mstfilter.lab.simulation.volumes import OFF_MIDDLE, Volume, lattice_points, volume_fractions
from mstfilter.scene import content_key

_FORMAT = 2  # raised whenever the content of prepared surfaces changes
_CELL, _MOST_CELLS = 0.0015, 256  # edge of the cells of the volume, metres; most of them along an axis
_UNCOVERED = 0.0007  # distance of a vertex from all convex pieces that is accepted, metres
_TEXEL = 0.00125  # edge of the cells that hold colours and normals, metres
_CREASE = np.cos(np.deg2rad(40.0))  # faces at a sharper edge are not shaded smoothly


@dataclass(frozen=True, eq=False)
class Triangles:
    """A triangle mesh as read from a file, in metres, z up.

    Colours are sRGB 0 .. 255. A mesh has at most one kind of colour for each face: of its corners, or from an image.
    """

    vertices: np.ndarray  #: (V, 3) float64
    faces: np.ndarray  #: (F, 3) int64, numbers of vertices
    colours: np.ndarray | None = None  #: (F, 3, 3) uint8: of the corners of each face
    image: np.ndarray | None = None  #: (F,) int32: which of `images` colours the face, -1 for none
    place: np.ndarray | None = None  #: (F, 3, 2) float32: corners in the image, 0 .. 1 from its upper left corner
    images: tuple[np.ndarray, ...] = ()  #: (h, w, 3) uint8

    @functools.cached_property
    def key(self) -> str:
        """A hash of the mesh and its colours."""
        return content_key(self.vertices, self.faces, self.colours, self.image, self.place, *self.images).hex()

    def at(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray | None:
        """Colours (n, 3) uint8 of points on faces (n,) with barycentric `weights` (n, 3); None without colours."""
        if self.colours is None:
            return None
        found = np.einsum("nk,nkc->nc", weights, self.colours[face].astype(np.float32))
        if self.image is not None and self.place is not None:
            for k, image in enumerate(self.images):
                on = np.flatnonzero(self.image[face] == k)
                uv = np.einsum("nk,nkc->nc", weights[on], self.place[face[on]]) % 1.0
                h, w = image.shape[:2]
                row, column = (uv[:, ::-1] * (h, w)).astype(np.int64).clip(0, (h - 1, w - 1)).T
                found[on] = image[row, column]
        return np.asarray(np.rint(found).clip(0, 255), np.uint8)


def _directions(normal: np.ndarray) -> np.ndarray:
    """Which of the six axis directions (n,) normals (n, 3) point to most."""
    axis = np.abs(normal).argmax(axis=1)
    return 2 * axis + (normal[np.arange(len(axis)), axis] > 0)


@dataclass(frozen=True, eq=False)
class MeshSurface:
    """A mesh that is prepared for simulation. The origin is the middle of the bounding box."""

    vertices: np.ndarray  #: (V, 3) float64, metres
    faces: np.ndarray  #: (F, 3) int32
    half: np.ndarray  #: (3,) metres, half edges of the bounding box
    hulls: tuple[np.ndarray, ...]  #: (n, 3) each: corners of the convex pieces
    inside: Volume
    #: (k,) int64, ascending: cells of the surface, and the direction to which it faces there.
    cells: np.ndarray
    normals: np.ndarray  #: (k, 3) int8, times 127: smooth normal of each cell
    colours: np.ndarray | None  #: (k, 3) uint8 sRGB; None for a mesh without colours

    @functools.cached_property
    def volume(self) -> float:
        """Cubic metres inside the mesh."""
        return float(self.inside.share.sum(dtype=np.float64)) * self.inside.cell**3

    @functools.cached_property
    def centre_of_mass(self) -> np.ndarray:
        """Middle (3,) of the volume, metres."""
        share = self.inside.share.astype(np.float64)
        total = share.sum()
        sums = [(share.sum(axis=tuple(b for b in range(3) if b != a)) @ np.arange(share.shape[a])) for a in range(3)]
        return np.asarray(self.inside.origin + self.inside.cell * (np.array(sums) / total + 0.5))

    @functools.cached_property
    def stances(self) -> tuple[tuple[np.ndarray, float], ...]:
        """Directions (3,) that can point up at rest, and the tangent of the angle by which each can be tilted."""
        from scipy.spatial import ConvexHull, QhullError

        hull = ConvexHull(self.vertices)
        corners = self.vertices[hull.vertices]
        _, first = np.unique(np.rint(hull.equations[:, :3] / 0.05), axis=0, return_index=True)
        found = []
        for normal in hull.equations[first, :3]:
            along = corners @ normal
            x = perpendicular(normal)
            plane = np.stack([x, np.cross(normal, x)])
            foot = corners[along > along.max() - 0.001] @ plane.T - plane @ self.centre_of_mass
            try:
                edge = float(-ConvexHull(foot).equations[:, 2].max())  # distance of the centre of mass from the edges
            except (QhullError, ValueError):
                continue
            tilt = edge / max(float(along.max() - normal @ self.centre_of_mass), 1e-4)
            if tilt > 0.1:
                found.append((-normal, tilt))
        return tuple(found)

    @functools.cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """The convex pieces."""
        return tuple(hull(corners) for corners in self.hulls)

    def look_up(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Indices (n,) of the cells at surface points (n, 3) with normals (n, 3) that point to the viewer."""
        index = np.floor((points + self.half) / _TEXEL + 1.0).astype(np.int64)
        facing = _directions(normals)
        found = np.zeros(len(points), np.int64)
        left = np.arange(len(points))
        for flip in (0, 1):  # a mesh may have faces that are turned inside out
            key = _cell_keys(index[left], facing[left] ^ flip, self.half)
            at = np.searchsorted(self.cells, key).clip(0, len(self.cells) - 1)
            before = np.maximum(at - 1, 0)
            nearer = np.abs(self.cells[before] - key) < np.abs(self.cells[at] - key)
            at = np.where(nearer, before, at)
            if not flip:
                found[:] = at
            hit = self.cells[at] == key
            found[left[hit]] = at[hit]
            left = left[~hit]
        return found

    def smooth(self, at: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Smooth unit normals (n, 3) of cells (n,), on the side of the normals (n, 3)."""
        n = self.normals[at].astype(np.float64) / 127.0
        agree = (n * normals).sum(axis=1)
        n *= np.where(agree < 0, -1.0, 1.0)[:, None]
        n[np.abs(agree) < 0.5] = normals[np.abs(agree) < 0.5]  # a cell of another face
        return n / np.linalg.norm(n, axis=1, keepdims=True)


def _cell_keys(index: np.ndarray, facing: np.ndarray, half: np.ndarray) -> np.ndarray:
    """One number for each cell (n, 3) and direction (n,). Neighbours along z have neighbouring numbers."""
    nx, ny, nz = (np.ceil(2 * half / _TEXEL).astype(np.int64) + 3).tolist()
    x, y, z = index.T.clip(0, np.array([[nx], [ny], [nz]]) - 1)
    return np.asarray(((facing * nx + x) * ny + y) * nz + z)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-30)


def _corner_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (F, 3, 3) of the corners: the mean over the faces at the vertex that are not beyond a sharp edge."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    flat = _unit(weighted)
    order = np.argsort(faces.ravel(), kind="stable")
    vertex, face = faces.ravel()[order], order // 3
    count = np.bincount(vertex, minlength=len(vertices))
    first = np.cumsum(count) - count
    near = np.minimum(count, 32)  # of the centre of a fan, the first faces are enough
    sums = np.zeros((len(faces) * 3, 3))
    for k in range(int(near.max(initial=0))):
        at = np.flatnonzero(k < near[vertex])
        other = face[first[vertex[at]] + (k + at - first[vertex[at]]) % count[vertex[at]]]
        alike = (flat[face[at]] * flat[other]).sum(axis=1) > _CREASE
        np.add.at(sums, order[at[alike]], weighted[other[alike]])
    return _unit(sums + 1e-12 * np.repeat(flat, 3, axis=0)).reshape(-1, 3, 3)


def _surface_cells(mesh: Triangles, half: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The fields `cells`, `normals` and `colours` of a `MeshSurface`."""
    vertices, faces = mesh.vertices, mesh.faces
    corner = _corner_normals(vertices, faces)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    facing = _directions(_unit(np.cross(b - a, c - a)))
    keys, normals, colours = [], [], []
    for axis in range(3):
        on = np.flatnonzero(facing // 2 == axis)
        others = [k for k in range(3) if k != axis]
        step = _TEXEL / 2
        for face, _, weights in lattice_points(vertices[faces[on]][:, :, others] / step - OFF_MIDDLE):
            face = on[face]
            point = np.einsum("nk,nkc->nc", weights, vertices[faces[face]])
            index = np.floor((point + half) / _TEXEL + 1.0).astype(np.int64)
            keys.append(_cell_keys(index, facing[face], half))
            normals.append(np.einsum("nk,nkc->nc", weights, corner[face]))
            colours.append(mesh.at(face, weights))
    # Triangles between the lines of all lattices are represented by their middle.
    third = np.full((len(faces), 3), 1 / 3)
    index = np.floor((vertices[faces].mean(axis=1) + half) / _TEXEL + 1.0).astype(np.int64)
    keys.append(_cell_keys(index, facing, half))
    normals.append(corner.mean(axis=1))
    colours.append(mesh.at(np.arange(len(faces)), third))
    cells, first = np.unique(np.concatenate(keys), return_index=True)
    normal = np.rint(127 * _unit(np.concatenate(normals)[first])).astype(np.int8)
    colour = None if mesh.colours is None else np.concatenate([one for one in colours if one is not None])[first]
    return cells, normal, colour


def _merged(mesh: Triangles) -> Triangles:
    """The mesh with vertices at one place merged, without faces of no area and without repeated faces."""
    where = np.rint(mesh.vertices / 1e-6).astype(np.int64)
    _, first, same = np.unique(where, axis=0, return_index=True, return_inverse=True)
    vertices, faces = mesh.vertices[first], same.reshape(-1)[mesh.faces]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    keep = np.sort(once[area[once] > 1e-12])
    pick: dict[str, Any] = {
        name: value[keep] for name in ("colours", "image", "place") if (value := getattr(mesh, name)) is not None
    }
    return replace(mesh, vertices=vertices, faces=faces[keep], **pick)


def centred(mesh: Triangles) -> Triangles:
    """The mesh with the middle of the bounding box at the origin."""
    used = mesh.vertices[np.unique(mesh.faces)]
    return replace(mesh, vertices=mesh.vertices - (used.min(axis=0) + used.max(axis=0)) / 2)


def _convex_pieces(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, ...]:
    try:
        import coacd
    except ModuleNotFoundError as error:
        raise missing_library(error, "a mesh as a rigid body") from error
    coacd.set_log_level("off")
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=0.05,
        max_convex_hull=24,
        # A shorter search than by default: pieces of the same volume within a tenth, in a tenth of the time.
        preprocess_resolution=30,
        resolution=500,
        mcts_nodes=8,
        mcts_iterations=20,
        mcts_max_depth=2,
        decimate=True,
        max_ch_vertex=32,
        seed=0,
    )
    # The clipping of pieces leaves some that are nearly flat, which a physics engine cannot use. Pieces may reach a
    # few millimetres beyond the mesh; within its bounding box, the mesh stands on the table itself.
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    pieces = [np.clip(np.asarray(corners), low, high) for corners, _ in parts]
    return _covering([corners for corners in pieces if _is_solid(corners)] or [vertices], vertices)


def _covering(pieces: list[np.ndarray], vertices: np.ndarray) -> tuple[np.ndarray, ...]:
    """The pieces, each extended by the vertices of the mesh that no piece contains and that it is nearest to.

    Without this, thin ends of long objects would sink into the table, because no piece reaches them.
    """
    from scipy.spatial import ConvexHull

    nearest, piece_of = np.full(len(vertices), np.inf), np.zeros(len(vertices), int)
    for k, corners in enumerate(pieces):
        outside = np.full(len(vertices), -np.inf)  # distance to the farthest plane that has the vertex outside
        for plane in ConvexHull(corners).equations:
            np.maximum(outside, vertices @ plane[:3] + plane[3], out=outside)
        closer = outside < nearest
        nearest[closer], piece_of[closer] = outside[closer], k
    extended = []
    for k, corners in enumerate(pieces):
        missing = vertices[(piece_of == k) & (nearest > _UNCOVERED)]
        if len(missing):
            both = np.concatenate([corners, missing])
            corners = both[ConvexHull(both).vertices]
        extended.append(corners)
    return tuple(extended)


def _is_solid(corners: np.ndarray) -> bool:
    if len(corners) < 4:
        return False
    spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    return bool(spread[2] / np.sqrt(len(corners)) > 2e-4)


def prepare_mesh(mesh: Triangles, agreement_at_least: float = 0.0) -> MeshSurface:
    """Prepare a centred mesh: volume, convex pieces, colours and normals.

    Raises InputError if fewer rays than `agreement_at_least` agree whether points are inside.
    """
    mesh = _merged(mesh)
    half = np.abs(mesh.vertices[np.unique(mesh.faces)]).max(axis=0)
    cell = max(_CELL, 2 * float(half.max()) / _MOST_CELLS)
    inside = volume_fractions(mesh.vertices, mesh.faces, cell)
    if inside.agreement < agreement_at_least or not inside.share.any():
        raise InputError(
            f"the surface is open: of six rays from a point, {inside.agreement:.0%} agree in the mean whether the "
            f"point is inside, expected at least {agreement_at_least:.0%}",
            "close the holes, give sheets a thickness, or leave the object out",
        )
    cells, normals, colours = _surface_cells(mesh, half)
    hulls = _convex_pieces(mesh.vertices, mesh.faces)
    return MeshSurface(mesh.vertices, mesh.faces.astype(np.int32), half, hulls, inside, cells, normals, colours)


def prepared_mesh(mesh: Triangles, folder: Path, agreement_at_least: float = 0.0) -> MeshSurface:
    """The prepared surface of a centred mesh, from the cache `folder` if it is there.

    Several processes may prepare the same mesh at the same time. A file is written under a temporary name and
    renamed.
    """
    try:
        coacd = version("coacd")
    except ModuleNotFoundError as error:
        raise missing_library(error, "a mesh as a rigid body") from error
    path = folder / f"{mesh.key}-{_FORMAT}-{coacd}.npz"
    if (found := _load(path)) is None:
        found = prepare_mesh(mesh, agreement_at_least)
        try:
            make_folders(folder, 0o700)
            _store(found, path)
        except OSError as error:
            raise InputError(
                f"cannot keep prepared meshes in {folder}: {error.strerror}",
                "set MSTFILTER_CACHE to a folder that can be written",
            ) from error
        found = _load(path) or found  # the same numbers, rounded as in the file, in the first process and the next
    return found


def _store(surface: MeshSurface, path: Path) -> None:
    arrays = {
        "vertices": surface.vertices,
        "faces": surface.faces,
        "half": surface.half,
        "corners": np.concatenate(surface.hulls),
        "counts": np.array([len(corners) for corners in surface.hulls]),
        "origin": surface.inside.origin,
        "cell": np.array([surface.inside.cell, surface.inside.agreement]),
        "share": np.rint(surface.inside.share * 255).astype(np.uint8),
        "cells": surface.cells,
        "normals": surface.normals,
    }
    if surface.colours is not None:
        arrays["colours"] = surface.colours
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)


def _load(path: Path) -> MeshSurface | None:
    """The stored surface; None if there is none, or its file is damaged."""
    try:
        z = read_arrays(path, "a prepared mesh")
        hulls = np.split(z["corners"], np.cumsum(z["counts"])[:-1])
        cell, agreement = z["cell"].tolist()
        inside = Volume(z["origin"], cell, z["share"].astype(np.float32) / 255, agreement)
        surface = z["vertices"], z["faces"], z["half"], tuple(hulls), inside
        return MeshSurface(*surface, z["cells"], z["normals"], z.get("colours"))
    except (InputError, ValueError, KeyError):
        return None
