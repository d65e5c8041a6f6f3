"""Exports: closed meshes turned outwards, read back by a parser of our own; label images equal to Project."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.errors import InputError
from mstfilter.report.export import export_label_images, export_ply, export_run, surface
from mstfilter.report.pictures import PALETTE
from mstfilter.scene import Hypothesis, VoxelGrid, project, read_labels
from tests.report.runs import make_run


def read_ply(path):
    """Vertices, colours and triangles of a binary PLY, by its own header."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    vertex = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    points = np.frombuffer(body, vertex, counts["vertex"])
    face = np.dtype([("n", "u1"), ("i", "<i4", 3)])
    faces = np.frombuffer(body, face, counts["face"], offset=points.nbytes)
    assert len(body) == points.nbytes + faces.nbytes
    assert (faces["n"] == 3).all()
    xyz = np.stack([points[a] for a in "xyz"], axis=-1).astype(float)
    return xyz, np.stack([points[c] for c in ("red", "green", "blue")], axis=-1), faces["i"]


def volume(vertices, triangles):
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 5))
def test_each_surface_is_closed_turned_outwards_and_holds_its_volume(seed, n_labels, size):
    labels = np.random.default_rng(seed).integers(0, n_labels + 1, (size, size + 1, size + 2)).astype(np.uint16)
    grid = VoxelGrid((0.3, -1.0, 0.05), 0.02, labels.shape)
    hypothesis = Hypothesis.from_labels(labels, grid)
    vertices, triangles, owner = surface(hypothesis)
    assert (owner[triangles] == owner[triangles[:, :1]]).all()
    for label, voxels in hypothesis.volumes().items():
        own = triangles[owner[triangles[:, 0]] == label]
        assert volume(vertices, own) == pytest.approx(voxels * 0.02**3, rel=1e-9)
        # Every directed edge is met by its reverse as often: no hole, no flipped face.
        edges = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]])
        names, counts = np.unique(edges, axis=0, return_counts=True)
        table = {tuple(e): c for e, c in zip(names.tolist(), counts.tolist(), strict=True)}
        assert all(table.get((b, a)) == c for (a, b), c in table.items())


def test_ply_reads_back(tmp_path):
    labels = np.zeros((6, 5, 4), np.uint16)
    labels[1:3, 1:3, :2] = 4
    labels[3:5, 1:3, :3] = 9
    hypothesis = Hypothesis.from_labels(labels, VoxelGrid((0, 0, 0), 0.01, labels.shape))
    xyz, rgb, triangles = read_ply(export_ply(hypothesis, tmp_path / "a.ply"))
    assert volume(xyz, triangles) == pytest.approx(20 * 0.01**3, rel=1e-4)
    assert {tuple(c) for c in rgb.tolist()} == {PALETTE[0], PALETTE[1]}
    assert xyz.min(axis=0) == pytest.approx([0.01, 0.01, 0]) and xyz.max(axis=0) == pytest.approx([0.05, 0.03, 0.03])
    # 8 voxels in a cube of 24 faces, 12 in a block of 32: 56 quads.
    assert len(triangles) == 112
    first = (tmp_path / "a.ply").read_bytes()
    assert export_ply(hypothesis, tmp_path / "a.ply").read_bytes() == first


def test_a_hypothesis_without_objects_is_an_empty_mesh(tmp_path):
    grid = VoxelGrid((0, 0, 0), 0.01, (3, 3, 3))
    xyz, _, triangles = read_ply(
        export_ply(Hypothesis.from_labels(np.zeros((3, 3, 3), int), grid), tmp_path / "e.ply")
    )
    assert len(xyz) == len(triangles) == 0


def test_export_of_a_run(tmp_path):
    run = make_run(tmp_path / "run")
    files = export_run(run, tmp_path / "out")
    assert len(files) == 3 * 3 * 2 + 1 and all(f.is_file() for f in files)
    for t in range(3):
        for k, hypothesis in enumerate(run.hypotheses(t)):
            stem = tmp_path / "out" / f"pause_{t:03d}" / f"hypothesis_{k:03d}"
            image = read_labels(stem.with_suffix(".png"))
            assert image.dtype == np.uint16
            np.testing.assert_array_equal(image, project(hypothesis, run.camera(t)))
            xyz, _, triangles = read_ply(stem.with_suffix(".ply"))
            voxels = sum(hypothesis.volumes().values())
            assert volume(xyz, triangles) == pytest.approx(voxels * hypothesis.grid.voxel_size**3, rel=1e-4)
    with (tmp_path / "out" / "objects.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(h.n_objects for t in range(3) for h in run.hypotheses(t))


def test_export_takes_a_path_and_says_where_it_cannot_write(tmp_path):
    make_run(tmp_path / "run", pauses=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write exports"):
        export_label_images(tmp_path / "run", tmp_path / "file")
