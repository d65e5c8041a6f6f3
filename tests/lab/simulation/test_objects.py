"""Folders of meshes: what is read, which errors are reported, pools, and recordings of a user's own objects."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.lab.simulation import SimulatedScene, open_objects, scene_family, simulate_recording
from mstfilter.lab.simulation.objects import pool_of
from mstfilter.lab.simulation.recorder import recipe_key
from mstfilter.lab.simulation.world import play_push
from tests.lab.simulation.meshes import box_mesh, cup_mesh, five_objects, write_obj, write_ply

for _name in ("coacd", "trimesh"):
    pytest.importorskip(_name, reason=f"the library {_name} is not installed (the extra `objects`)")

TINY = {
    "width": 160,
    "height": 120,
    "n_actions": 1,
    "frames_per_clip": 5,
    "fps": 3.0,
    "supersample": False,
    "n_candidates": 6,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return five_objects(tmp_path_factory.mktemp("objects") / "mine")


def test_sizes_and_upward_axes_of_all_formats(folder):
    objects = {one.name: one for one in open_objects(folder).objects}
    assert sorted(objects) == ["block", "can", "carton", "cup", "tin"]
    expected = {"tin": (0.04, 0.03, 0.07), "cup": (0.04, 0.04, 0.045), "can": (0.035, 0.035, 0.05),
                "carton": (0.03, 0.05, 0.08), "block": (0.03, 0.03, 0.06)}  # fmt: skip
    for name, half in expected.items():
        np.testing.assert_allclose(objects[name].half, half, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(
        {one.name: one for one in open_objects(folder, 0.5, "y").objects}["tin"].half, (0.02, 0.035, 0.015), atol=1e-6
    )


def test_colours_of_vertices_and_textures_reach_the_surface(folder):
    objects = {one.name: one for one in open_objects(folder).objects}
    tin, carton = objects["tin"].surface(), objects["carton"].surface()
    assert (tin.colours == (200, 60, 40)).all()
    red, blue = ((carton.colours == colour).all(axis=1).mean() for colour in ((250, 20, 20), (20, 20, 250)))
    assert red == pytest.approx(0.5, abs=0.1) and blue == pytest.approx(0.5, abs=0.1)
    assert objects["cup"].surface().colours is None


def test_a_recording_of_five_own_objects(folder, tmp_path):
    family = replace(scene_family("s1"), objects=str(folder), n_twins=0, **TINY)
    recording = simulate_recording(family, 0, tmp_path / "one")
    names = [entry["name"] for entry in recording.manifest["objects"]]
    assert sorted(names) == ["block", "can", "carton", "cup", "tin"]
    described = recording.manifest["family"]
    assert described["objects"] == "mine" and described["objects_key"] == open_objects(folder).key
    truth = recording.truth(0)
    assert set(np.unique(truth)) == {0, 1, 2, 3, 4, 5}
    for t, pause in enumerate(recording.pauses):
        # What is seen of an object lies in its voxels or beside them.
        instance, frame = recording.instance(pause), recording.frames[pause]
        points = frame.camera.unproject(frame.depth)
        near = recording.truth(t)
        for axis in range(3):
            near = np.maximum(near, np.maximum(np.roll(near, 1, axis), np.roll(near, -1, axis)))
        seen = (instance > 0) & (instance < 255) & np.isfinite(frame.depth)
        index = recording.grid.index_of(points[seen])
        assert (near[tuple(index.T)] > 0).mean() > 0.97
    again = simulate_recording(family, 0, tmp_path / "two")
    for name in ("rgb/000002.png", "depth/000002.png", "voxels.npz", "poses.json"):
        assert (recording.path / name).read_bytes() == (again.path / name).read_bytes()


def test_three_commands_make_a_recording_a_run_and_a_report(folder, tmp_path, monkeypatch):
    from mstfilter.app.cli import main

    monkeypatch.chdir(tmp_path)
    small = [f"{name}={str(value).lower()}" for name, value in TINY.items()]
    commands = (
        ["simulate", "s1", "recordings/mine", "n_twins=0", *small, "--objects", str(folder)],
        ["run", "recordings/mine", "--out", "runs/mine", "--no-report", "--preset", "floor_components"],
        ["report", "runs/mine"],
    )
    for command in commands:
        try:
            main(command)
        except SystemExit as end:
            assert not end.code, command
    assert "<html" in (tmp_path / "runs/mine/report.html").read_text(encoding="utf-8")


def test_a_study_names_a_folder_of_objects(folder, tmp_path):
    from mstfilter.runs.study import load_study, make_plan

    study = tmp_path / "study.toml"
    scenes = '[[scenes]]\nfamily = "s1"\nseeds = 0\nobjects = "mine"\n'
    study.write_text(scenes + "[[arms]]\npreset = 'floor_components'\n", encoding="utf-8")
    (tmp_path / "mine").symlink_to(folder)
    (scene,) = make_plan(load_study(study)).scenes
    assert scene.source["set"]["objects"] == str(folder)
    assert scene.key == recipe_key(replace(scene_family("s1"), objects=str(folder)), 0)
    study.write_text('[[scenes]]\nrecordings = "x"\nobjects = "mine"\n', encoding="utf-8")
    with pytest.raises(InputError, match="neither seeds, set nor objects"):
        load_study(study)


def test_the_key_of_a_recording_depends_on_the_content_of_the_folder_and_not_on_its_place(folder, tmp_path):
    copies = [tmp_path / name / "mine" for name in ("a", "b")]
    for copy in copies:
        copy.mkdir(parents=True)
        write_obj(copy / "cup.obj", *cup_mesh())
    keys = [recipe_key(replace(scene_family("s1"), objects=str(copy)), 0) for copy in copies]
    assert keys[0] == keys[1] != recipe_key(scene_family("s1"), 0)
    write_obj(copies[1] / "cup.obj", *cup_mesh(wall=0.004))
    assert recipe_key(replace(scene_family("s1"), objects=str(copies[1])), 0) != keys[0]


def _large(folder):
    write_obj(folder / "mug.obj", np.array(cup_mesh()[0]) * 1000, cup_mesh()[1])


def _open(folder):
    vertices, faces = box_mesh((0.03, 0.04, 0.05))
    write_obj(folder / "open.obj", vertices, faces[:-2])


def _sheet(folder):
    vertices, faces = box_mesh((0.03, 0.04, 0.0001))
    write_obj(folder / "sheet.obj", vertices, faces)


def _points(folder):
    write_ply(folder / "points.ply", box_mesh((0.03, 0.04, 0.05))[0], [])


def _damaged(folder):
    (folder / "broken.glb").write_bytes(b"glTF but not really")


WRONG = {
    "no meshes": (lambda folder: (folder / "notes.txt").write_text("x"), "has no meshes", "one file an object"),
    "millimetres": (_large, "mug.obj: its longest side is 90 m", "object_scale=0.001"),
    "open": (_open, "open.obj: the surface is open", "close the holes"),
    "sheet": (_sheet, "sheet.obj: its shortest side is 0.2 mm", "thickness"),
    "points": (_points, "points.ply: the mesh has no faces", "surface"),
    "damaged": (_damaged, "broken.glb: the mesh cannot be read", "mesh editor"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_folders_are_one_error_with_the_file_and_what_to_do(name, tmp_path):
    make, message, hint = WRONG[name]
    folder = tmp_path / "objects"
    folder.mkdir()
    make(folder)
    family = replace(scene_family("s1"), objects=str(folder), **TINY)
    with pytest.raises(InputError) as caught:
        simulate_recording(family, 0, tmp_path / "out")
    assert message in caught.value.message and str(folder) in caught.value.message
    assert hint in " ".join(caught.value.hints)
    assert not (tmp_path / "out").exists()


def test_a_missing_folder_and_families_that_need_one(monkeypatch):
    monkeypatch.delenv("MSTFILTER_OBJECTS", raising=False)
    with pytest.raises(InputError, match="no such folder"):
        open_objects("nowhere")
    with pytest.raises(InputError, match="needs a folder of meshes") as caught:
        SimulatedScene(scene_family("m1"), 0)
    assert "--objects" in caught.value.hints[0]


@pytest.mark.nightly
def test_more_objects_than_fit(folder):
    family = replace(scene_family("s1"), objects=str(folder), n_objects_min=40, n_objects_max=40)
    import mstfilter.lab.simulation.arrangement as arrangement

    kept, arrangement._ATTEMPTS = arrangement._ATTEMPTS, 2
    try:
        with pytest.raises(InputError, match="40 objects could not be arranged"):
            SimulatedScene(family, 0)
    finally:
        arrangement._ATTEMPTS = kept


def test_pools_split_stems_by_halves_and_quarters():
    pools = [pool_of("source", f"stem {k}") for k in range(4000)]
    shares = {name: pools.count(name) / 4000 for name in ("training", "tuning", "reported")}
    # Six standard deviations of a share.
    assert shares["training"] == pytest.approx(0.5, abs=0.048)
    assert shares["tuning"] == pytest.approx(0.25, abs=0.042) and shares["reported"] == pytest.approx(0.25, abs=0.042)
    assert pool_of("source", "cup") == pool_of("source", "cup")
    family = scene_family("m2")
    assert {family.object_pool(seed) for seed in (0, 999)} == {"tuning"}
    assert family.object_pool(1000) == "reported"
    assert replace(family, mesh_pool="training").object_pool(1000) == "training"


def test_a_pool_without_objects(folder):
    names = {pool_of("", name) for name in ("block", "can", "carton", "cup", "tin")}
    for pool in {"training", "tuning", "reported"} - names:
        with pytest.raises(InputError, match="none of 5 objects is in the pool"):
            open_objects(folder).of_pool(pool)
    assert len(open_objects(folder).of_pool("all")) == 5


def test_an_index_with_archives(tmp_path):
    boxes = [box_mesh((0.03, 0.04, 0.05)), box_mesh((0.02, 0.02, 0.06))]
    v, f = ([b[k] for b in boxes] for k in (0, 1))
    arrays = {
        "id": np.array(["a_1", "b_1"]),
        "v": np.concatenate(v).astype(np.float32),
        "f": np.concatenate(f).astype(np.int32),
        "v_start": np.array([0, 8, 16]),
        "f_start": np.array([0, 12, 24]),
    }
    np.savez(tmp_path / "set.npz", **arrays)
    with open(tmp_path / "index.csv", "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, ["id", "source", "stem", "class", "ray_agreement"])
        writer.writeheader()
        writer.writerow({"id": "a_1", "source": "set", "stem": "a", "class": "box", "ray_agreement": "1.00"})
        writer.writerow({"id": "b_1", "source": "set", "stem": "b", "class": "can", "ray_agreement": "0.90"})
    (one,) = open_objects(tmp_path).objects  # rays disagree about the inside of the other
    assert (one.name, one.source, one.stem, one.kind) == ("a_1", "set", "a", "box")
    np.testing.assert_allclose(one.half, (0.03, 0.04, 0.05), atol=1e-6)


def test_pools_of_the_household_meshes(shared_data):
    objects = open_objects(shared_data("meshes")).objects
    assert len(objects) > 300
    pools = {}
    for one in objects:
        assert pools.setdefault((one.source, one.stem), one.pool) == one.pool
    assert {one.pool for one in objects if one.source == "urdf_models"} == {"training", "tuning", "reported"}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))])
def test_own_objects_rest_and_neither_sink_nor_fly(folder, seed):
    family = replace(scene_family("s1"), objects=str(folder), n_twins=0, n_dropped=1, furniture=1.0, **TINY)
    scene = SimulatedScene(family, seed)
    _at_rest(scene)
    push = scene.choose_push(0)
    before = scene.world.positions()
    effect = play_push(scene.world, push, family)
    assert effect.settled and effect.kept
    assert np.linalg.norm(scene.world.positions() - before, axis=1).max() < 0.5


def test_objects_apart_stand_alone_and_in_view(folder):
    """With `apart`, objects touch nothing, and all of each object is in the image."""
    family = replace(scene_family("s1"), objects=str(folder), n_twins=0, n_stacked=0, apart=1.0, **TINY)
    scene = SimulatedScene(family, 0)
    _at_rest(scene)
    assert scene.world.contacts() == []
    for shape, pose in zip(scene.world.shapes, scene.world.poses(), strict=True):
        corners = shape.corners @ pose[:3, :3].T + pose[:3, 3]
        uv, _ = scene.camera.project(corners)
        assert ((uv > -1) & (uv < (family.width, family.height))).all()
    beside = SimulatedScene(replace(family, apart=0.0), 0).world.positions()[:, :2]
    spread = [np.linalg.norm(p - p.mean(axis=0), axis=1).mean() for p in (scene.world.positions()[:, :2], beside)]
    assert spread[0] > 1.3 * spread[1]


def test_shared_shadow_rays_change_no_border_of_a_shadow(folder):
    """Blocks of pixels share rays where no shadow ends. The reference has a ray for each point."""
    family = replace(scene_family("s1"), objects=str(folder), n_twins=0, n_dropped=1, **TINY)
    scene = SimulatedScene(family, 1)
    shared = scene._renderer.render().colour
    scene._renderer._block = np.arange(scene._renderer._block.size)
    own = scene._renderer.render().colour
    body = scene._renderer.render().instance > 0
    differs = np.abs(shared - own).max(axis=-1)[body] > 0.02
    assert body.any() and differs.mean() < 0.002  # blocks alone: .009


@pytest.mark.nightly
def test_a_scene_of_household_meshes_rests(shared_data, monkeypatch):
    monkeypatch.setenv("MSTFILTER_OBJECTS", str(shared_data("meshes")))
    scene = SimulatedScene(replace(scene_family("m1"), **TINY), 0)
    _at_rest(scene)
    assert len(np.unique(scene.truth())) == scene.world.n_objects + 1


def _at_rest(scene):
    world = scene.world
    assert world.deepest_overlap() < 0.0015
    for shape, pose in zip(world.shapes, world.poses(), strict=True):
        lowest = (shape.corners @ pose[2, :3]).min() + pose[2, 3]
        assert lowest > -0.002
    before = world.positions()
    world.step(250)
    assert np.linalg.norm(world.positions() - before, axis=1).max() < 0.003
    world.forward()
