"""Meshes of hypotheses: closed, and read back by open3d."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.app.report import write_report
from mstfilter.app.report.export import export_mesh, voxel_faces
from mstfilter.app.report.pictures import PALETTE
from mstfilter.base.errors import MissingLibraryError
from mstfilter.base.lazy import import_open3d
from mstfilter.scene import Hypothesis, VoxelGrid
from tests.app.report.runs import make_run


@pytest.fixture
def o3d():
    try:
        return import_open3d()
    except MissingLibraryError as error:
        pytest.skip(error.message)


def two_boxes():
    """Labels 4 (8 voxels) and 9 (12 voxels), which touch."""
    labels = np.zeros((6, 5, 4), np.uint16)
    labels[1:3, 1:3, :2] = 4
    labels[3:5, 1:3, :3] = 9
    return Hypothesis.from_labels(labels, VoxelGrid((0, 0, 0), 0.01, labels.shape))


def signed_volume(vertices, triangles):
    """Volume inside a closed mesh, positive if its triangles are counter-clockwise seen from outside."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def objects_of(o3d, path):
    """Colour -> mesh of each object in a file."""
    mesh = o3d.io.read_triangle_mesh(str(path))
    colours = np.rint(255 * np.asarray(mesh.vertex_colors)).astype(int)
    found = {}
    for colour in np.unique(colours, axis=0):
        part = mesh.select_by_index(np.flatnonzero((colours == colour).all(axis=1)))
        found[tuple(colour.tolist())] = part
    assert sum(len(part.triangles) for part in found.values()) == len(mesh.triangles)
    return found


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_voxel_faces_are_closed_turned_outwards_and_hold_the_volume(seed, size):
    mask = np.random.default_rng(seed).random((size, size + 1, size + 2)) < 0.4
    mask[0, 0, 0] = True
    vertices, triangles = voxel_faces(mask)
    assert signed_volume(vertices, triangles) == pytest.approx(mask.sum(), rel=1e-9)
    # Every directed edge is met by its reverse as often: no hole, no flipped face.
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    names, counts = np.unique(edges, axis=0, return_counts=True)
    table = {tuple(e): c for e, c in zip(names.tolist(), counts.tolist(), strict=True)}
    assert all(table.get((b, a)) == c for (a, b), c in table.items())


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_meshes_read_back_are_watertight_and_hold_the_volume_of_the_voxels(o3d, tmp_path, ending):
    path = export_mesh(two_boxes(), tmp_path / f"a.{ending}")
    assert list(tmp_path.iterdir()) == [path]
    objects = objects_of(o3d, path)
    assert set(objects) == {PALETTE[0], PALETTE[1]}
    for mesh, voxels in zip((objects[PALETTE[0]], objects[PALETTE[1]]), (8, 12), strict=True):
        assert mesh.is_watertight()
        assert mesh.get_volume() == pytest.approx(voxels * 0.01**3, rel=1e-4)
        assert signed_volume(np.asarray(mesh.vertices), np.asarray(mesh.triangles)) > 0
    # 8 voxels in a cube of 24 faces, 12 in a block of 32: two triangles each.
    assert [len(objects[c].triangles) for c in PALETTE[:2]] == [48, 64]
    corners = np.concatenate([np.asarray(mesh.vertices) for mesh in objects.values()])
    assert corners.min(axis=0) == pytest.approx([0.01, 0.01, 0], abs=1e-7)
    assert corners.max(axis=0) == pytest.approx([0.05, 0.03, 0.03], abs=1e-7)


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_the_same_hypothesis_gives_the_same_file(o3d, tmp_path, ending):
    first = export_mesh(two_boxes(), tmp_path / f"a.{ending}").read_bytes()
    assert export_mesh(two_boxes(), tmp_path / f"a.{ending}").read_bytes() == first


def test_without_open3d_the_report_is_written_and_a_mesh_is_one_clear_error(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", pauses=1)
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert write_report(run).is_file()
    with pytest.raises(MissingLibraryError, match="needs open3d, which cannot be imported"):
        export_mesh(two_boxes(), tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()
