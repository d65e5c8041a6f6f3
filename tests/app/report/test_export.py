"""Meshes of hypotheses: closed, and read back by trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st

from mstfilter.app.report.export import export_mesh, voxel_faces
from mstfilter.app.report.pictures import PALETTE
from mstfilter.base.errors import InputError
from mstfilter.mst.belief import Belief
from mstfilter.scene import Hypothesis, VoxelGrid
from mstfilter.smc import Population


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


def objects_of(path):
    """Colour -> mesh of each object in a file."""
    mesh = trimesh.load_mesh(path, process=False, maintain_order=True)
    colours = mesh.visual.vertex_colors[:, :3][mesh.faces]
    assert (colours == colours[:, :1]).all()  # no triangle joins two objects
    found = {}
    for colour in np.unique(colours[:, 0], axis=0):
        part = mesh.submesh([np.flatnonzero((colours[:, 0] == colour).all(axis=1))], append=True, repair=False)
        part.merge_vertices(merge_norm=True)
        found[tuple(colour.tolist())] = part
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
def test_meshes_read_back_are_watertight_and_hold_the_volume_of_the_voxels(tmp_path, ending):
    path = export_mesh(two_boxes(), tmp_path / f"a.{ending}")
    assert list(tmp_path.iterdir()) == [path]
    objects = objects_of(path)
    assert set(objects) == {PALETTE[0], PALETTE[1]}
    for mesh, voxels in zip((objects[PALETTE[0]], objects[PALETTE[1]]), (8, 12), strict=True):
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(voxels * 0.01**3, rel=1e-4)
    # 8 voxels in a cube of 24 faces, 12 in a block of 32: two triangles each.
    assert [len(objects[c].faces) for c in PALETTE[:2]] == [48, 64]
    corners = np.concatenate([np.asarray(mesh.vertices) for mesh in objects.values()])
    assert corners.min(axis=0) == pytest.approx([0.01, 0.01, 0], abs=1e-7)
    assert corners.max(axis=0) == pytest.approx([0.05, 0.03, 0.03], abs=1e-7)


@pytest.mark.parametrize("ending", ["ply", "obj", "glb", "stl"])
def test_the_same_hypothesis_gives_the_same_file(tmp_path, ending):
    first = export_mesh(two_boxes(), tmp_path / f"a.{ending}").read_bytes()
    assert first and export_mesh(two_boxes(), tmp_path / f"a.{ending}").read_bytes() == first


def test_smooth_objects_in_gltf_are_named_turned_to_y_up_and_closed(tmp_path):
    table = Belief(Population((two_boxes(),))).objects()
    scene = trimesh.load_scene(export_mesh(table, tmp_path / "a.glb", {1: (9, 8, 7), 2: (1, 2, 3)}), process=False)
    assert set(scene.graph.nodes_geometry) == {"object 1", "object 2"}
    whole = scene.to_geometry()
    assert whole.is_watertight and 0.7 * 20e-6 < whole.volume < 20e-6
    np.testing.assert_allclose(whole.bounds, [[0.01, 0, -0.03], [0.05, 0.03, -0.01]], atol=1e-7)  # x, z, -y
    assert set(map(tuple, whole.visual.vertex_colors[:, :3].tolist())) == {(9, 8, 7), (1, 2, 3)}


def test_errors_leave_nothing(tmp_path):
    with pytest.raises(InputError, match="ending of a mesh file"):
        export_mesh(two_boxes(), tmp_path / "a.dae")
    with pytest.raises(InputError, match="no objects"):
        export_mesh(Hypothesis.from_labels(np.zeros((2, 2, 2), int), VoxelGrid((0, 0, 0), 0.01, (2, 2, 2))), "a.ply")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="mesh"):
        export_mesh(two_boxes(), tmp_path / "file" / "a.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
