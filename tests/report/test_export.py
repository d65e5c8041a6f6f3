"""Exports: closed meshes that are read back by open3d, and label images that equal the projection."""

from __future__ import annotations

import csv
import sys

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.errors import InputError, MissingLibraryError
from mstfilter.open3d_import import import_open3d
from mstfilter.report import write_report
from mstfilter.report.export import export_mesh, export_run, voxel_faces
from mstfilter.report.pictures import PALETTE
from mstfilter.scene import Hypothesis, VoxelGrid, project, read_labels
from tests.report.runs import make_run
from tests.test_cli import call


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


def test_export_of_a_run(o3d, tmp_path):
    run = make_run(tmp_path / "run")
    files = export_run(run, tmp_path / "out")
    assert len(files) == 3 * 3 * 2 + 1 and all(f.is_file() for f in files)
    for t in range(3):
        for k, hypothesis in enumerate(run.hypotheses(t)):
            stem = tmp_path / "out" / f"pause_{t:03d}" / f"hypothesis_{k:03d}"
            image = read_labels(stem.with_suffix(".png"))
            assert image.dtype == np.uint16
            np.testing.assert_array_equal(image, project(hypothesis, run.camera(t)))
            assert len(objects_of(o3d, stem.with_suffix(".ply"))) == hypothesis.n_objects
    with (tmp_path / "out" / "objects.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(h.n_objects for t in range(3) for h in run.hypotheses(t))


def test_a_hypothesis_without_objects_has_a_label_image_and_no_mesh(o3d, tmp_path):
    run = make_run(tmp_path / "run", pauses=1, empty=True)
    names = {path.name for path in export_run(run, tmp_path / "out")}
    assert names == {"objects.csv", *(f"hypothesis_{k:03d}.png" for k in range(3))}


def test_errors(o3d, tmp_path):
    make_run(tmp_path / "run", pauses=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write exports"):
        export_run(tmp_path / "run", tmp_path / "file")
    assert not (tmp_path / "out").exists()


def test_command(o3d, tmp_path, capsys):
    run = make_run(tmp_path / "run", pauses=1)
    code, out, _ = call("report", run.path, "--export", tmp_path / "out", capsys=capsys)
    assert code == 0 and str(tmp_path / "out") in out
    assert len(list((tmp_path / "out").rglob("*.ply"))) == 3


def test_without_open3d_the_report_is_written_and_an_export_is_one_clear_error(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", pauses=1)
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert write_report(run).is_file()
    with pytest.raises(MissingLibraryError, match="needs open3d, which cannot be imported"):
        export_run(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()
