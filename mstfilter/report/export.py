"""Hypotheses for other programs: PLY meshes and 16-bit label images.

>>> export_ply(hypothesis, "scene.ply")                      # closed meshes, one an object, coloured
>>> export_label_images(run, "out")                          # what the camera would see of each hypothesis
>>> export_run(run, "out")                                   # both, and a table of objects

Layout of an exported run::

    objects.csv                          pause, hypothesis, weight, label, id, birth, voxels, colour
    pause_000/hypothesis_000.ply         faces between an object and anything else; world metres
    pause_000/hypothesis_000.png         label of the object that each pixel shows, 0 none
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mstfilter.errors import InputError
from mstfilter.report.identities import identity_colours
from mstfilter.report.pictures import GREY, Colour, colour, hexadecimal
from mstfilter.scene import Hypothesis, project, write_image
from mstfilter.study import RunFolder

__all__ = ["export_label_images", "export_ply", "export_run", "surface"]

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_FACE = np.dtype([("n", "u1"), ("index", "<i4", 3)])

# Corners of the face of a unit voxel towards +axis, counter-clockwise seen from outside; towards -axis reversed.
_CORNERS = {
    0: np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]),
    1: np.array([[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]]),
    2: np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]),
}


def surface(hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles of all voxel faces where an object meets free space or another object.

    Every object's surface is closed on its own and turned outwards: where two objects touch, each has its face.

    Returns
    -------
    vertices : (v, 3) float64
        World metres; a corner is shared by the faces of one object only.
    triangles : (f, 3) int64
        Counter-clockwise seen from outside.
    labels : (v,) int64
        Object of each vertex.
    """
    padded = np.pad(hypothesis.labels, 1).astype(np.int64)
    corners, owners = [], []
    inner = padded[1:-1, 1:-1, 1:-1]
    for axis, face in _CORNERS.items():
        for sign in (1, -1):
            neighbour = np.roll(padded, -sign, axis=axis)[1:-1, 1:-1, 1:-1]
            voxel = np.argwhere((inner > 0) & (neighbour != inner))
            quad = face
            if sign < 0:
                quad = face[::-1].copy()
                quad[:, axis] = 0
            corners.append(voxel[:, None, :] + quad)
            owners.append(inner[tuple(voxel.T)])
    quads = np.concatenate(corners)
    owner = np.concatenate(owners)
    size = np.array(hypothesis.labels.shape, np.int64) + 1
    flat = (quads[..., 0] * size[1] + quads[..., 1]) * size[2] + quads[..., 2]
    named = flat + owner[:, None] * size.prod()
    names, index = np.unique(named, return_inverse=True)
    index = index.reshape(-1, 4)
    labels, cell = np.divmod(names, size.prod())
    lattice = np.stack(np.unravel_index(cell, tuple(size)), axis=-1)
    vertices = hypothesis.grid.origin + lattice * hypothesis.grid.voxel_size
    triangles = index[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return vertices, triangles, labels


def export_ply(hypothesis: Hypothesis, path: str | Path, colours: Mapping[int, Colour] | None = None) -> Path:
    """Write a hypothesis as a binary little-endian PLY mesh with a colour a vertex.

    Parameters
    ----------
    hypothesis : Hypothesis
        See `surface` for the mesh.
    path : path
        The file.
    colours : mapping, optional
        ``{label: (r, g, b)}``. Default: the palette in order of labels.
    """
    if colours is None:
        colours = {record.label: colour(k) for k, record in enumerate(hypothesis.objects)}
    vertices, triangles, labels = surface(hypothesis)
    points = np.zeros(len(vertices), _VERTEX)
    points["xyz"] = vertices
    for label in np.unique(labels).tolist():
        points["rgb"][labels == label] = colours.get(label, GREY)
    faces = np.zeros(len(triangles), _FACE)
    faces["n"], faces["index"] = 3, triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment world metres, z up",
        *(f"comment object label={r.label} id={r.id} birth={r.birth}" for r in hypothesis.objects),
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    path = Path(path)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(("\n".join(header) + "\n").encode() + points.tobytes() + faces.tobytes())
    os.replace(partial, path)
    return path


def export_label_images(run: RunFolder | str | Path, out: str | Path) -> list[Path]:
    """Write what the pause's camera would see of every hypothesis, as 16-bit PNG label images."""
    run = run if isinstance(run, RunFolder) else RunFolder.open(run)
    paths = []
    for t in range(run.n_pauses):
        folder, camera = _folder(out, t), run.camera(t)
        for k, hypothesis in enumerate(run.hypotheses(t)):
            paths.append(folder / f"hypothesis_{k:03d}.png")
            write_image(paths[-1], project(hypothesis, camera))
    return paths


def export_run(run: RunFolder | str | Path, out: str | Path) -> list[Path]:
    """Write meshes and label images of all pauses, and a table of all objects; the files written."""
    run = run if isinstance(run, RunFolder) else RunFolder.open(run)
    paths = export_label_images(run, out)
    identities = identity_colours(run)
    rows: list[list[object]] = []
    for t in range(run.n_pauses):
        weights = run.info(t)["weights"]
        for k, hypothesis in enumerate(run.hypotheses(t)):
            colours, volumes = identities.colours(t, k), hypothesis.volumes()
            paths.append(export_ply(hypothesis, _folder(out, t) / f"hypothesis_{k:03d}.ply", colours))
            for r in hypothesis.objects:
                shown = hexadecimal(colours[r.label])
                rows.append([t, k, f"{weights[k]:.6g}", r.label, r.id, r.birth, volumes[r.label], shown])
    table = Path(out) / "objects.csv"
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["pause", "hypothesis", "weight", "label", "id", "birth", "voxels", "colour"])
        writer.writerows(rows)
    return [*paths, table]


def _folder(out: str | Path, t: int) -> Path:
    folder = Path(out) / f"pause_{t:03d}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write exports to {out}: {error.strerror}", "choose another folder") from error
    return folder
