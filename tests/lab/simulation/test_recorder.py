"""Recordings: determinism, agreement of images and true volumes, and the cache."""

import hashlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mstfilter.base.errors import InputError
from mstfilter.formats import open_recording
from mstfilter.lab.simulation import recorder
from mstfilter.lab.simulation.families import scene_family
from mstfilter.lab.simulation.recorder import (
    SimulatedScene,
    cached_recording,
    recipe_key,
    simulate_recording,
)
from mstfilter.lab.simulation.shapes import SHAPE_FAMILIES, draw_shape, label_voxels
from mstfilter.lab.simulation.world import FINGER_ID
from mstfilter.scene import VoxelGrid, render

SMALL = replace(scene_family("demo"), width=160, height=120, frames_per_clip=6, fps=3.0, n_candidates=6)


def digest(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return simulate_recording(SMALL, 3, tmp_path_factory.mktemp("sim") / "three")


def test_same_seed_same_bytes_in_another_process_and_another_seed_differs(tmp_path):
    small = {"width": 80, "height": 60, "n_actions": 1, "frames_per_clip": 4, "fps": 2.0}
    family = replace(scene_family("demo"), **small)
    recording, other = (simulate_recording(family, seed, tmp_path / str(seed)) for seed in (3, 4))
    program = (
        "from dataclasses import replace\n"
        "from mstfilter.lab.simulation.families import scene_family\n"
        "from mstfilter.lab.simulation.recorder import simulate_recording\n"
        f"f = replace(scene_family('demo'), **{small})\n"
        f"simulate_recording(f, 3, {str(tmp_path / 'again')!r})\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=600)
    assert digest(tmp_path / "again") == digest(recording.path)
    assert digest(other.path)["rgb/000000.png"] != digest(recording.path)["rgb/000000.png"]
    assert (other.truth(0) != recording.truth(0)).any()


def test_layout_of_the_recording(recording):
    assert len(recording) == SMALL.n_frames == 11
    assert recording.pauses == (0, 5, 10)
    assert [len(clip.frames) for clip in recording.clips()] == [1, 6, 6]
    assert recording.grid == SMALL.grid()
    manifest = recording.manifest
    assert manifest["seed"] == 3 and manifest["family"]["name"] == "demo" and len(manifest["objects"]) == 5
    for pause in recording.pauses[1:]:
        push = manifest["frames"][pause]["push"]
        assert max(push["displacement_m"]) > SMALL.move_threshold and push["all_kept"] and push["settled"]
    assert all(manifest["frames"][pause]["left_workspace"] == [] for pause in recording.pauses)
    recording.check()


def test_the_finger_is_visible_in_actions_and_not_at_pauses(recording):
    seen = [(recording.instance(i) == FINGER_ID).sum() for i in range(len(recording))]
    assert all(seen[p] == 0 for p in recording.pauses)
    assert sum(n > 0 for n in seen) >= 4
    for i in range(len(recording)):
        np.testing.assert_array_equal(recording.frames[i].robot_mask, recording.instance(i) == FINGER_ID)


def test_instance_images_agree_with_the_projected_voxels(recording):
    for t, pause in enumerate(recording.pauses):
        labels = recording.truth(t)
        drawn = render(labels, recording.grid, recording.frames[pause].camera).labels
        instance = recording.instance(pause)
        # Voxels of 1 cm are 6 pixels wide here: a pixel or two of border may differ.
        both = (drawn > 0) & (instance > 0)
        assert (drawn[both] == instance[both]).mean() > 0.9
        for k in np.unique(instance[instance > 0]):
            seen = instance == k
            if seen.sum() > 150:
                assert (drawn[seen] == k).mean() > 0.6, (t, k)
        union = (drawn > 0) | (instance > 0)
        assert both.sum() / union.sum() > 0.7


@pytest.mark.parametrize(
    "family", [pytest.param(name, marks=[pytest.mark.nightly] * (name == "bowl")) for name in SHAPE_FAMILIES]
)
def test_voxel_truth_has_the_analytic_volume(family):
    shape = draw_shape(np.random.default_rng(1), family)
    rng = np.random.default_rng(2)
    grid = VoxelGrid((-0.15, -0.15, -0.15), 0.002, (150, 150, 150))
    pose = np.eye(4)
    # Turned, so that no face is parallel to the raster.
    pose[:3, :3] = Rotation.from_euler("xyz", (0.4, 0.7, 0.3)).as_matrix()
    voxels = (label_voxels([shape], pose[None], grid) == 1).sum() * 0.002**3
    points = rng.uniform(-shape.half, shape.half, (60_000, 3))
    share = shape.inside(points).mean()
    whole = 8 * np.prod(shape.half)
    # Five deviations of the Monte Carlo share, and 1 % for the raster.
    slack = 5 * whole * np.sqrt(share * (1 - share) / len(points)) + 0.01 * share * whole
    assert voxels == pytest.approx(share * whole, abs=slack)
    if len(shape.pieces) == 1:
        assert voxels == pytest.approx(shape.pieces[0].volume, rel=0.02)


def test_progress_is_called_once_a_frame_and_failures_leave_nothing(tmp_path):
    calls = []

    def progress(done, total, what):
        calls.append((done, total))
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_recording(SMALL, 5, tmp_path / "cut", progress)
    assert calls == [(1, 11), (2, 11), (3, 11)]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("seed", [-1, 1.5, "seven", True])
def test_bad_seed(seed, tmp_path):
    with pytest.raises(InputError, match="seed"):
        SimulatedScene(SMALL, seed)


def test_an_existing_folder_is_not_overwritten(recording):
    before = digest(recording.path)
    with pytest.raises(InputError):
        simulate_recording(SMALL, 3, recording.path)
    assert digest(recording.path) == before


def test_camera_of_families():
    table = scene_family("table").camera()
    np.testing.assert_allclose(table.K, [[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])
    demo = scene_family("demo").camera()
    np.testing.assert_allclose(demo.K[0], [262.5, 0, 159.5], atol=0.3)
    uv, _ = table.project(np.array([0.02, 0.05, 0.04]))
    np.testing.assert_allclose(uv, [319.5, 239.5], atol=1e-6)


def test_objects_that_left_the_workspace_are_named_and_the_truth_keeps_its_extent(tmp_path):
    from mstfilter.lab.simulation import recorder

    scene = SimulatedScene(replace(SMALL, n_actions=0), 3)
    scene.world.place(1, (0.0, 5.0, 0.1), np.eye(3))
    scene.world.forward()
    with recorder.RecordingWriter(tmp_path / "away", scene.camera, scene.grid, **scene.describe()) as writer:
        recorder._record_pause(scene, writer, 0, 0.0)
    away = open_recording(tmp_path / "away")
    assert away.manifest["frames"][0]["left_workspace"] == [2]
    assert away.truth(0).shape == SMALL.grid().shape
    assert set(np.unique(away.truth(0))) == {0, 1, 3, 4, 5}


def test_images_poses_and_volumes_agree(recording):
    import json

    poses = json.loads((recording.path / "poses.json").read_text())
    scene = SimulatedScene(SMALL, 3)
    for t, pause in enumerate(recording.pauses):
        shown = np.array([poses[pause]["T_world_object"][str(k + 1)] for k in range(5)])
        np.testing.assert_array_equal(label_voxels(scene.objects.shapes, shown, recording.grid), recording.truth(t))


TINY = {
    "width": 80,
    "height": 60,
    "n_actions": 1,
    "frames_per_clip": 3,
    "fps": 1.0,
    "supersample": False,
    "n_candidates": 4,
}


def test_a_cached_recording_is_simulated_once(tmp_path, monkeypatch):
    first = cached_recording("s1", 3, tmp_path, **TINY)
    assert first.parent == tmp_path and len(open_recording(first)) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == [".gitignore", first.name]
    monkeypatch.setattr(recorder, "_simulate_into_cache", lambda *_: pytest.fail("made again"))
    assert cached_recording("s1", 3, tmp_path, **TINY) == first
    assert cached_recording(replace(scene_family("s1"), **TINY), 3, tmp_path) == first


def test_the_key_depends_on_all_fields_seed_and_version(monkeypatch):
    s1 = scene_family("s1")
    keys = {
        recipe_key(s1, 3),
        recipe_key(s1, 4),
        recipe_key(replace(s1, fps=6.0), 3),
        recipe_key(scene_family("s2"), 3),
    }
    assert len(keys) == 4 and recipe_key(s1, 3) in keys
    monkeypatch.setattr(recorder, "GENERATOR_VERSION", -1)
    assert recipe_key(s1, 3) not in keys


def test_a_recording_that_another_process_wrote_meanwhile_is_kept(tmp_path, monkeypatch):
    simulate_recording = recorder.simulate_recording
    expected = cached_recording("s1", 3, tmp_path / "other", **TINY).name

    def slow(family, seed, path, progress=None):
        rival = tmp_path / "here" / expected
        rival.mkdir()
        (rival / "manifest.json").write_text("{}")
        return simulate_recording(family, seed, path, progress)

    monkeypatch.setattr(recorder, "simulate_recording", slow)
    assert cached_recording("s1", 3, tmp_path / "here", **TINY).name == expected
    assert sorted(p.name for p in (tmp_path / "here").iterdir()) == [".gitignore", expected]
    assert (tmp_path / "here" / expected / "manifest.json").read_text() == "{}"


def test_invalid_arguments_of_the_cache(tmp_path):
    with pytest.raises(InputError, match="no field 'colour'"):
        cached_recording("s1", 3, tmp_path, colour=3)
    with pytest.raises(InputError, match="scene family"):
        cached_recording("s9", 3, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot keep recordings"):
        cached_recording("s1", 3, tmp_path / "file", **TINY)
