"""Meshes as objects: volume against closed forms, thin walls, colours, normals and the cache of prepared meshes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation import surfaces
from mstfilter.lab.simulation.shapes import SHAPE_FAMILIES, Part, Shape, _thin_walls, draw_shape, label_voxels
from mstfilter.lab.simulation.surfaces import MeshSurface, prepare_mesh, prepared_mesh
from mstfilter.lab.simulation.volumes import volume_fractions
from mstfilter.scene import VoxelGrid
from tests.lab.simulation.meshes import box_mesh, cup_mesh, lathe_mesh, triangles

GRID = VoxelGrid((-0.15, -0.15, -0.15), 0.01, (30, 30, 30))


def surface_without_pieces(mesh, monkeypatch=None) -> MeshSurface:
    """A prepared mesh whose only piece is its hull, as labels and colours need no pieces."""
    kept, surfaces._convex_pieces = surfaces._convex_pieces, lambda vertices, faces: (vertices,)
    try:
        return prepare_mesh(surfaces.centred(mesh))
    finally:
        surfaces._convex_pieces = kept


def shape_of(mesh) -> Shape:
    return Shape.of_surface(surface_without_pieces(mesh), 1.0, "other", "test", 0.2, ("plain",))


def pose_of(angles=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", angles).as_matrix(), at
    return pose


@pytest.mark.parametrize("name", ["box", "cup", "turned box"])
def test_shares_of_cells_sum_to_the_closed_form(name):
    if name == "cup":
        (vertices, faces), sides = cup_mesh(sides=48), 48
        polygon = sides / 2 * np.sin(2 * np.pi / sides)
        volume = polygon * (0.04**2 * 0.09 - 0.037**2 * 0.087)
    else:
        vertices, faces = box_mesh((0.03, 0.04, 0.05))
        volume = 8 * 0.03 * 0.04 * 0.05
        if name == "turned box":
            vertices = vertices @ Rotation.from_euler("xyz", (0.3, 0.5, 0.7)).as_matrix().T
    found = volume_fractions(vertices, faces, 0.0015)
    assert found.share.sum(dtype=float) * 0.0015**3 == pytest.approx(volume, rel=0.02)
    assert found.agreement == pytest.approx(1.0, abs=0.01)  # lines of different axes pass a cell at different points


def test_rays_disagree_about_the_inside_of_an_open_surface():
    vertices, faces = box_mesh((0.03, 0.04, 0.05))
    assert volume_fractions(vertices, faces[:-2], 0.002).agreement < 0.9  # without its lid
    with pytest.raises(InputError, match="the surface is open"):
        prepare_mesh(triangles(vertices, faces[:-2]), 0.9)


def test_faces_given_twice_or_inside_out_do_not_change_the_volume():
    vertices, faces = box_mesh((0.03, 0.04, 0.05))
    twice = np.concatenate([faces, faces[:4]])
    turned = faces.copy()
    turned[::3] = turned[::3, ::-1]
    for other in (twice, turned):
        assert surface_without_pieces(triangles(vertices, other)).volume == pytest.approx(4.8e-4, rel=0.02)


@pytest.mark.parametrize("angles", [(0, 0, 0), (0.4, 0.7, 0.3)])
def test_a_solid_mesh_has_the_labels_of_the_same_piece(angles):
    half = (0.031, 0.042, 0.053)
    solid = Shape("test", "test", (surfaces.hull(box_mesh(half)[0]),), 0.2, "box", ((3, 1.0),), ("plain",))
    pose = pose_of(angles, (0.003, -0.004, 0.001))[None]
    mesh, piece = (label_voxels([shape], pose, GRID) for shape in (shape_of(triangles(*box_mesh(half))), solid))
    assert (mesh != piece).sum() <= 0.03 * piece.sum()  # centres within a fraction of a millimetre of the surface


@pytest.mark.parametrize("wall", [0.001, 0.002, 0.004, 0.006])
def test_a_thin_wall_is_one_layer_of_voxels_without_holes(wall):
    sheet = shape_of(triangles(*box_mesh((0.08, 0.08, wall / 2))))
    heights, doubled = np.arange(0.0007, 0.01, 0.0013), 0.0
    for height in heights:
        labels = label_voxels([sheet], pose_of(at=(0.0002, 0.0003, height))[None], GRID)
        columns = labels[8:22, 8:22].sum(axis=2)
        assert (columns >= 1).all() and columns.mean() <= 2, (wall, height)
        doubled += columns.mean() - 1
    assert doubled / len(heights) < 0.2  # only where the sheet is half in one layer and half in the next
    turned = label_voxels([sheet], pose_of((0.5, 0.0, 0.0), (0.001, 0.002, 0.003))[None], GRID)
    columns = turned[10:20, 10:20].sum(axis=2)
    assert (columns >= 1).all() and columns.mean() < 1.2


def test_a_cup_keeps_its_hollow():
    cup = shape_of(triangles(*cup_mesh()))
    labels = label_voxels([cup], pose_of((0.2, 0.1, 0.0), (0.002, 0.001, 0.0))[None], GRID)
    inside = label_voxels([shape_of(triangles(*lathe_mesh([(0, 0), (0.028, 0), (0.028, 0.06), (0, 0.06)])))],
                          pose_of((0.2, 0.1, 0.0), (0.002, 0.001, 0.0))[None], GRID)  # fmt: skip
    assert labels.any() and not labels[inside > 0].any()
    # A wall 3 mm thick becomes a layer of a voxel, not two: the surface of the cup times one voxel.
    surface = 2 * np.pi * 0.0385 * 0.09 + np.pi * 0.037**2
    assert labels.sum() * 1e-6 == pytest.approx(surface * 0.01, rel=0.25)


@pytest.mark.parametrize(
    "family", [pytest.param(name, marks=[pytest.mark.nightly] * (name == "bowl")) for name in SHAPE_FAMILIES]
)
def test_the_rule_of_thin_walls_adds_nothing_to_generated_objects_at_one_centimetre(family):
    shape = draw_shape(np.random.default_rng(3), family)
    pose = pose_of((0.3, 0.2, 0.1), (0.003, 0.002, 0.004))
    low, high = np.array([2, 2, 2]), np.array([28, 28, 28])
    thin = _thin_walls(shape, pose[:3, :3], pose[:3, 3], GRID, low, high)
    labels = label_voxels([shape], pose[None], GRID)[2:28, 2:28, 2:28]
    assert (thin & (labels == 0)).sum() <= 0.02 * labels.sum()


def test_a_body_of_parts_has_the_voxels_of_its_parts():
    part = draw_shape(np.random.default_rng(0), "can")
    body = Shape.of_parts("pack", "two", [Part(part, np.eye(3), np.array([s * part.half[0], 0, 0])) for s in (-1, 1)])
    assert body.half[0] == pytest.approx(2 * part.half[0])
    poses = np.array([pose_of(at=p.position) for p in body.parts])
    apart = label_voxels([part, part], poses, GRID)
    np.testing.assert_array_equal(label_voxels([body], np.eye(4)[None], GRID) > 0, apart > 0)
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (2000, 3))
    pieces = np.any([p.inside(points) for p in body.pieces], axis=0)
    np.testing.assert_array_equal(body.inside(points), pieces)


def test_colours_and_normals_of_surface_points():
    vertices, faces = box_mesh((0.03, 0.04, 0.05))
    colours = np.zeros((12, 3, 3), np.uint8)
    colours[:, :, 0] = 20 * np.arange(12)[:, None] // 40 * 40  # a colour for each side
    surface = surface_without_pieces(triangles(vertices, faces, colours=colours))
    rng = np.random.default_rng(0)
    for side, (axis, sign) in enumerate(((0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1))):
        points = rng.uniform(-0.9, 0.9, (200, 3)) * surface.half
        points[:, axis] = sign * surface.half[axis]
        normals = np.zeros((200, 3))
        normals[:, axis] = sign
        cells = surface.look_up(points, normals)
        expected = colours[2 * side, 0]
        assert (surface.colours[cells] == expected).all(axis=1).mean() > 0.98
        np.testing.assert_allclose(surface.smooth(cells, normals), normals, atol=0.02)
    round_ = surface_without_pieces(triangles(*lathe_mesh([(0, 0), (0.04, 0), (0.04, 0.1), (0, 0.1)], 24)))
    angle = rng.uniform(0, 2 * np.pi, 300)
    facet = (np.floor(angle / (2 * np.pi / 24)) + 0.5) * 2 * np.pi / 24
    flat = np.column_stack([np.cos(facet), np.sin(facet), 0 * facet])
    reach = 0.04 * np.cos(np.pi / 24) / np.cos(angle - facet)
    points = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(-0.04, 0.04, 300)])
    smooth = round_.smooth(round_.look_up(points, flat), flat)
    true = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    error = np.rad2deg(np.arccos(np.clip((smooth * true).sum(axis=1), -1, 1)))
    assert np.median(error) < 2.5 < np.median(np.rad2deg(np.abs(angle - facet)))


def test_rest_poses_of_a_mesh():
    surface = surface_without_pieces(triangles(*cup_mesh()))
    ups = np.array([up for up, _ in surface.stances])
    assert (ups[:, 2] > 0.999).any() and (ups[:, 2] < -0.999).any()
    np.testing.assert_allclose(surface.centre_of_mass[:2], 0, atol=5e-4)
    assert surface.centre_of_mass[2] < -0.003  # the floor is heavier than the open end


def test_prepared_meshes_are_stored(tmp_path):
    pytest.importorskip("coacd", reason="the library coacd is not installed (the extra `objects`)")
    mesh = surfaces.centred(triangles(*cup_mesh()))
    first = prepared_mesh(mesh, tmp_path)
    again = prepared_mesh(mesh, tmp_path)
    assert 6 <= len(first.hulls) <= 24
    for a, b in zip(first.hulls, again.hulls, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(first.inside.share, again.inside.share)
    # The hollow stays open: contacts of things in the cup are with its floor.
    pieces = Shape.of_surface(first, 1.0, "cup", "cup", 0.2, ("plain",)).pieces
    assert not any(piece.inside(np.array([0.0, 0.0, 0.02])) for piece in pieces)


def test_a_damaged_file_of_a_mesh_is_made_again(tmp_path):
    pytest.importorskip("coacd", reason="the library coacd is not installed (the extra `objects`)")
    mesh = surfaces.centred(triangles(*box_mesh((0.03, 0.04, 0.05))))
    first = prepared_mesh(mesh, tmp_path)
    (file,) = tmp_path.iterdir()
    Path(file).write_bytes(b"PK damaged")
    np.testing.assert_array_equal(prepared_mesh(mesh, tmp_path).cells, first.cells)
    assert surfaces._load(file) is not None


def test_pieces_reach_all_vertices_of_the_mesh():
    vertices, _ = box_mesh((0.03, 0.04, 0.05))
    tip = np.concatenate([vertices, [(0.0, 0.0, 0.09)]])
    lower, upper = (np.array([v for v in vertices if sign * v[2] > 0]) for sign in (-1, 1))
    halves = [np.concatenate([part, part * (1, 1, 0)]) for part in (lower, upper)]
    extended = surfaces._covering(halves, tip)
    inside = np.any([surfaces.hull(piece).inside(tip * (1 - 1e-9)) for piece in extended], axis=0)
    assert inside.all()
    np.testing.assert_array_equal(extended[0], halves[0])  # the tip belongs to the upper half


def test_key_depends_on_vertices_faces_and_colours():
    mesh = triangles(*box_mesh((0.03, 0.04, 0.05)))
    grey = np.full((12, 3, 3), 100, np.uint8)
    keys = {mesh.key, triangles(mesh.vertices * 1.1, mesh.faces).key, triangles(mesh.vertices, mesh.faces[:-1]).key}
    keys |= {replace(mesh, colours=grey).key, replace(mesh, colours=grey + 1).key}
    assert len(keys) == 5
