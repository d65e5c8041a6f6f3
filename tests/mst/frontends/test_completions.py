"""Shapes of other programs as completions: placement, draws, and files that cannot be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.base.lazy import import_open3d
from mstfilter.formats import write_image
from mstfilter.mst.completion import Extrude
from mstfilter.mst.frontends import ExternalCompletion, MaskProposal, write_masks
from mstfilter.mst.frontends.completions import place_shape
from mstfilter.scene import render
from tests.mst.segmentation.scenes import GRID, boxes, clip_of

SCENE = boxes(((8, 20, 0), (20, 34, 12)), ((34, 22, 0), (46, 36, 8)))
CLIP = clip_of(SCENE, width=160)
FRAME = CLIP.after
SHOWN = render(SCENE, GRID, FRAME.camera).labels
T_CAMERA = FRAME.camera.pose.as_matrix()


@pytest.fixture
def o3d():
    try:
        return import_open3d()
    except MissingLibraryError as error:
        pytest.skip(error.message)


def corners(k: int) -> tuple[np.ndarray, np.ndarray]:
    """The box k of the scene, in world metres."""
    index = np.argwhere(k == SCENE)
    return GRID.origin + 0.01 * index.min(axis=0), GRID.origin + 0.01 * (index.max(axis=0) + 1)


def to_camera(points: np.ndarray) -> np.ndarray:
    return (points - T_CAMERA[:3, 3]) @ T_CAMERA[:3, :3]


def surface(k: int, n: int = 40) -> np.ndarray:
    """Points just inside the faces of box k, denser than the voxels."""
    low, high = corners(k)
    unit = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    unit = unit[((unit == 0) | (unit == 1)).any(axis=1)]
    return low + 1e-4 + unit * (high - low - 2e-4)


def folder_of(path: Path, k: int, pause: int = 0) -> Path:
    folder = path / f"{pause:06d}" / f"box{k}"
    folder.mkdir(parents=True)
    write_image(folder / "mask.png", (255 * (k == SHOWN)).astype(np.uint8))
    return folder


def occupied(completer: ExternalCompletion, k: int, seed: int = 0) -> np.ndarray:
    """Probability (X, Y, Z) of the completion of the mask of box k."""
    (one,) = completer.at(CLIP).complete(np.random.default_rng(seed), FRAME, [k == SHOWN], GRID)
    out = np.zeros(GRID.shape)
    out[one.box] = one.probability
    return out


def write_shape(path: Path, k: int, kind: str, o3d, camera: bool) -> None:
    low, high = corners(k)
    move = to_camera if camera else (lambda points: points)
    if kind == "npz points":
        np.savez(path / "a.npz", points=move(surface(k)))
    elif kind == "npz occupancy":
        index = np.argwhere(k == SCENE)
        part = SCENE[tuple(slice(a, b) for a, b in zip(index.min(0), index.max(0) + 1, strict=True))] == k
        np.savez(path / "a.npz", occupancy=part, origin=low, voxel_size=0.01)
    elif kind == "cloud ply":
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(move(surface(k))))
        o3d.io.write_point_cloud(str(path / "a.ply"), cloud)
    else:
        mesh = o3d.geometry.TriangleMesh.create_box(*(high - low))
        mesh.vertices = o3d.utility.Vector3dVector(move(np.asarray(mesh.vertices) + low))
        mesh.compute_triangle_normals()
        o3d.io.write_triangle_mesh(str(path / f"a.{kind}"), mesh)


@pytest.mark.parametrize("kind", ["npz points", "npz occupancy", "cloud ply", "ply", "obj", "stl", "off"])
@pytest.mark.parametrize("axes", ["camera", "world"])
def test_shapes_of_all_kinds_are_placed_where_they_are(tmp_path, o3d, kind, axes):
    """The true box in each format; voxels that differ can only be those at the visible surface."""
    if kind == "npz occupancy" and axes == "camera":
        pytest.skip("the voxels of the box are along the axes of the world")
    write_shape(folder_of(tmp_path, 1), 1, kind, o3d, axes == "camera")
    volume = place_shape(*one_file(tmp_path), T_CAMERA if axes == "camera" else np.eye(4), GRID)
    truth = SCENE == 1
    assert ((volume > 0.5) & truth).sum() / ((volume > 0.5) | truth).sum() > 0.97
    found = occupied(ExternalCompletion(folder=str(tmp_path), axes=axes), 1) > 0.5
    assert (found & truth).sum() / (found | truth).sum() > 0.9


def one_file(path: Path) -> tuple[Path, bytes]:
    (file,) = path.rglob("a.*")
    return file, file.read_bytes()


def test_an_array_of_voxels_in_the_frame_of_the_camera(tmp_path):
    """A ball, so that the axes of the array do not matter."""
    centre, radius, edge = corners(1)[0] + 0.06, 0.05, 0.004
    index = np.stack(np.meshgrid(*[np.arange(30)] * 3, indexing="ij"), axis=-1)
    ball = np.linalg.norm((index + 0.5 - 15) * edge, axis=-1) < radius
    np.savez(
        folder_of(tmp_path, 1) / "a.npz", occupancy=0.9 * ball, origin=to_camera(centre) - 15 * edge, voxel_size=edge
    )
    volume = place_shape(*one_file(tmp_path), T_CAMERA, GRID)
    truth = np.linalg.norm(GRID.centres() - centre, axis=-1) < radius
    assert (truth == (volume > 0)).mean() > 0.999
    assert volume.max() == np.float32(0.9)


def test_a_mesh_with_a_hole_is_filled(tmp_path, o3d):
    folder = folder_of(tmp_path, 1)
    low, high = corners(1)
    mesh = o3d.geometry.TriangleMesh.create_box(*(high - low))
    mesh.vertices = o3d.utility.Vector3dVector(np.asarray(mesh.vertices) + low)
    mesh.triangles = o3d.utility.Vector3iVector(np.asarray(mesh.triangles)[2:])  # one face is missing
    o3d.io.write_triangle_mesh(str(folder / "a.ply"), mesh)
    volume = place_shape(*one_file(tmp_path), np.eye(4), GRID)
    assert ((volume > 0) == (SCENE == 1)).all()


def two_draws(path: Path) -> None:
    """Box 1 as it is with weight 3, and a shape that also reaches 4 voxels behind it with weight 1."""
    folder = folder_of(path, 1)
    low, _ = corners(1)
    size = np.ptp(np.argwhere(SCENE == 1), axis=0) + 1
    np.savez(folder / "a.npz", occupancy=np.ones(size), origin=low, voxel_size=0.01)
    np.savez(folder / "b.npz", occupancy=np.ones(size + (0, 4, 0)), origin=low, voxel_size=0.01)
    (folder / "weights.json").write_text('{"a.npz": 3, "b.npz": 1}')


def test_draws_follow_their_weights_and_differ_between_hypotheses(tmp_path):
    two_draws(tmp_path)
    write_masks(tmp_path / "masks", 0, [(SHOWN == 1).astype(int)])
    completer = ExternalCompletion(folder=str(tmp_path), axes="world")
    proposal = MaskProposal(str(tmp_path / "masks"), completer=completer)
    population = proposal.sample(np.random.default_rng(0), CLIP, 400)
    volumes = np.array([h.volumes()[1] for h in population.particles])
    large = (volumes > volumes.min()).sum()
    assert len(set(volumes.tolist())) == 2
    assert abs(large - 100) < 5 * np.sqrt(400 * 0.25 * 0.75)  # wrong with probability 6e-7
    again = proposal.sample(np.random.default_rng(0), CLIP, 400)
    assert [h.key for h in again.particles] == [h.key for h in population.particles]


def test_masks_without_a_shape(tmp_path):
    two_draws(tmp_path)
    completer = ExternalCompletion(folder=str(tmp_path), axes="world")
    with pytest.raises(InputError, match=r"no stored shape fits a mask .* best IoU is 0.00"):
        occupied(completer, 2)
    extruded = occupied(replace(completer, other=Extrude()), 2)
    (expected,) = Extrude().complete(np.random.default_rng(0), FRAME, [SHOWN == 2], GRID)
    assert (extruded[expected.box] == expected.probability).all()
    with pytest.raises(InputError, match="does not know the pause"):
        completer.complete(np.random.default_rng(0), FRAME, [SHOWN == 1], GRID)


def test_the_measurement_has_priority(tmp_path):
    """A shape that fills the workspace keeps no voxel that is observed as free, and all of the visible surface."""
    folder = folder_of(tmp_path, 1)
    np.savez(folder / "a.npz", occupancy=np.ones(GRID.shape), origin=GRID.origin, voxel_size=0.01)
    p = occupied(ExternalCompletion(folder=str(tmp_path), axes="world"), 1)
    (extruded,) = Extrude().complete(np.random.default_rng(0), FRAME, [SHOWN == 1], GRID)
    surface_ = np.zeros(GRID.shape, bool)
    surface_[extruded.box] = extruded.probability == 1
    assert (p[surface_] == 1).all()
    assert p[:, :, 20:].mean() < 0.5  # the camera looks through most of the upper space
    np.savez(folder / "a.npz", occupancy=np.zeros((1, 1, 1)), origin=GRID.origin, voxel_size=0.01)
    with pytest.raises(InputError, match="occupies no voxel of the workspace"):
        occupied(ExternalCompletion(folder=str(tmp_path), axes="world"), 1)


def broken(name: str, **arrays):
    return lambda folder: np.savez(folder / name, **arrays)


def raw(name: str, content: bytes):
    return lambda folder: (folder / name).write_bytes(content)


POINTS = np.ones((3, 3))
HOSTILE = {
    "no files": (lambda folder: None, "has no shape"),
    "unknown file": (raw("a.blend", b"x"), "is not a file of a shape"),
    "text for npz": (raw("a.npz", b"x"), "cannot be read"),
    "pickle": (broken("a.npz", points=np.array([[None] * 3])), "cannot be read"),
    "other arrays": (broken("a.npz", x=POINTS), "expected points, or occupancy"),
    "points of wrong shape": (broken("a.npz", points=np.ones((3, 2))), "expected (n, 3)"),
    "points with nan": (broken("a.npz", points=POINTS * np.nan), "not finite"),
    "millimetres": (broken("a.npz", points=np.array([[0, 0, 0], [100.0, 100, 100]])), "shapes are in metres"),
    "elsewhere": (broken("a.npz", points=POINTS + 50), "occupies no voxel"),
    "occupancy above 1": (
        broken("a.npz", occupancy=np.full((2, 2, 2), 2), origin=np.zeros(3), voxel_size=0.1),
        "not between 0 and 1",
    ),
    "three voxel sizes": (
        broken("a.npz", occupancy=np.ones((2, 2, 2)), origin=np.zeros(3), voxel_size=[0.1, 0.1, 0.1]),
        "voxel size is array([0.1, 0.1, 0.1])",
    ),
    "flat occupancy": (broken("a.npz", occupancy=np.ones((2, 2)), origin=np.zeros(3), voxel_size=0.1), "(A, B, C)"),
    "voxels of size 0": (
        broken("a.npz", occupancy=np.ones((2, 2, 2)), origin=np.zeros(3), voxel_size=0),
        "voxel size",
    ),
    "broken mesh": (raw("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n"), "cannot be read"),
    "empty mesh": (raw("a.obj", b""), "cannot be read"),
    "weights": (raw("weights.json", b"[1]"), "has no shape"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_files_that_cannot_be_used_are_one_clear_error(tmp_path, o3d, case):
    write, message = HOSTILE[case]
    write(folder_of(tmp_path, 1))
    with pytest.raises(InputError) as caught:
        occupied(ExternalCompletion(folder=str(tmp_path), axes="world"), 1)
    assert message in caught.value.message + " ".join(caught.value.hints)
    assert "\n" not in caught.value.message


def test_the_memory_of_a_file_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr("mstfilter.mst.frontends.completions.MAX_FILE", 1000)
    np.savez_compressed(folder_of(tmp_path, 1) / "a.npz", points=np.zeros((1000, 3)))
    with pytest.raises(InputError, match="at most 1000 are read"):
        occupied(ExternalCompletion(folder=str(tmp_path), axes="world"), 1)


def test_folders_that_are_missing(tmp_path):
    for folder, message in (("", "is not given"), (str(tmp_path), "none for pause 0")):
        with pytest.raises(InputError, match=message):
            ExternalCompletion(folder=folder).at(CLIP)
    (tmp_path / "000000" / "cup").mkdir(parents=True)
    with pytest.raises(InputError, match=r"has no mask\.png"):
        ExternalCompletion(folder=str(tmp_path)).at(CLIP)
    write_image(tmp_path / "000000" / "cup" / "mask.png", np.ones((4, 5), np.uint8))
    with pytest.raises(InputError, match="are 4 x 5 pixels, the image is"):
        ExternalCompletion(folder=str(tmp_path)).at(CLIP)


def test_open3d_is_needed_for_meshes_only(tmp_path, monkeypatch):
    def absent():
        raise MissingLibraryError("open3d cannot be imported: no module", "pip install open3d")

    monkeypatch.setattr("mstfilter.mst.frontends.completions.import_open3d", absent)
    two_draws(tmp_path)
    occupied(ExternalCompletion(folder=str(tmp_path), axes="world"), 1)
    (tmp_path / "000000/box1/weights.json").unlink()
    for name in "ab":
        (tmp_path / f"000000/box1/{name}.npz").unlink()
    (tmp_path / "000000/box1/a.obj").write_text("v 0 0 0\n")
    with pytest.raises(MissingLibraryError, match="open3d cannot be imported"):
        occupied(ExternalCompletion(folder=str(tmp_path), axes="world"), 1)
