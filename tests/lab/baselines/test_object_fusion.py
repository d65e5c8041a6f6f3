"""MID-Fusion-style baseline: its volumes against exact distances, matching, new and lost objects."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.base.resources import models_folder
from mstfilter.base.user_files import load_file
from mstfilter.mst.testing import scene_example
from mstfilter.runs.presets import preset
from mstfilter.scene import Clip, Frame, Hypothesis, render
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import Population
from mstfilter.smc.testing import UpdateContract
from tests.lab.baselines.scenes import slide
from tests.scene.scenes import CAMERA, GRID, table_scene

module = load_file(models_folder() / "published" / "object_fusion.py")
ObjectFusion, ObjectVolume = module.ObjectFusion, module.ObjectVolume
RNG = np.random.default_rng(0)


def seen(labels):
    """A frame of a label grid on a table, without noise."""
    view = render(labels, GRID, CAMERA)
    directions = CAMERA.rays() @ CAMERA.pose.as_matrix()[:3, :3].T
    depth = np.where(view.labels > 0, view.depth, -CAMERA.position[2] / np.minimum(directions[..., 2], -1e-6))
    rgb = np.full((*depth.shape, 3), 120, np.uint8)
    return Frame(rgb, depth.astype(np.float32), CAMERA), view.labels


def box(label=1, shift=0, height=10, width=10):
    labels = np.zeros(GRID.shape, np.uint16)
    labels[20 + shift : 20 + shift + width, 20:30, :height] = label
    return labels


def test_a_volume_begins_as_it_was_given():
    mask = box() == 1
    volume = ObjectVolume.of(mask, GRID, 0.02, 2.0)
    np.testing.assert_array_equal(volume.occupied, mask[volume.box])
    assert mask[volume.box].sum() == mask.sum()
    top = volume.distance[tuple(np.array([25, 25, 9]) - volume.offset)]
    assert top == pytest.approx(-0.005)  # half a voxel below the surface
    assert volume.distance.min() == -0.02 and volume.distance.max() == 0.02


def test_free_space_carves_and_surfaces_grow():
    """The map has a box of height 14 where one of height 10 stands, and lacks its right half."""
    frame, labels = seen(box())
    wrong = box(height=14)
    wrong[25:] = 0
    volume = ObjectVolume.of(wrong == 1, GRID, 0.02, 1.0)
    for _ in range(12):
        volume = volume.integrate(frame, GRID, np.eye(4), labels == 1, labels == 2)
    out = np.zeros(GRID.shape, bool)
    out[volume.box] = volume.occupied
    assert not out[20:25, 20:30, 11:].any()  # 10 to 14 were seen through
    assert out[20:25, 20:29, :9].all()
    assert out[25:27, 20, 2:9].all()  # the visible surface of what was missing, within the margin
    out[19:31, 19:31, :11] = False
    assert not out.any()  # nothing beyond one voxel around what stands there


def test_hidden_voxels_stay():
    frame, labels = seen(box())
    volume = ObjectVolume.of(box() == 1, GRID, 0.02, 1.0)
    after = volume.integrate(frame, GRID, np.eye(4), labels == 1, labels == 2)
    low = np.array([25, 29, 2]) - volume.offset  # at the back, near the table
    assert after.weight[tuple(low)] == 1.0
    assert after.occupied[tuple(low)]


def test_a_moved_object_is_integrated_where_it_was():
    frame, labels = seen(box(shift=4))
    T = np.eye(4)
    T[0, 3] = 4 * GRID.voxel_size
    volume = ObjectVolume.of(box() == 1, GRID, 0.02, 1.0)
    good = volume.integrate(frame, GRID, T, labels == 1, labels == 2)
    bad = volume.integrate(frame, GRID, np.eye(4), labels == 1, labels == 2)
    kept = volume.occupied.sum()
    assert (good.occupied & volume.occupied).sum() > 0.97 * kept
    assert (bad.occupied & volume.occupied).sum() < 0.85 * kept


def test_anothers_mask_takes_the_surface_away():
    frame, labels = seen(box())
    volume = ObjectVolume.of(box() == 1, GRID, 0.02, 1.0)
    no_robot = np.zeros(labels.shape, bool)
    for _ in range(2):
        volume = volume.integrate(frame, GRID, np.eye(4), no_robot, labels == 1)
    assert not volume.occupied[tuple(np.array([25, 20, 9]) - volume.offset)]


def clip_of(frame, index=1):
    return Clip((frame, frame), GRID, index)


def fuse(old, new, frame, **fields):
    predicted = Population((old,), parents={"previous": np.arange(1)})
    proposed = Population((new,), parents={"proposed": np.arange(1)})
    return ObjectFusion(**fields).update(RNG, predicted, proposed, clip_of(frame))


def test_matched_objects_keep_their_names_and_new_masks_become_objects():
    true = box(1)
    true[40:48, 20:30, :6] = 2
    frame, _ = seen(true)
    old = Hypothesis.from_labels(np.where(true == 1, 4, 0).astype(np.uint16), GRID)
    new = Hypothesis.from_labels(true, GRID, birth=1)
    fused = fuse(old, new, frame)
    assert fused.notes["maps"] == [{"matched": 1, "new": 1, "images": 0, "forgotten": 0}]
    hypothesis = fused.particles[0]
    assert hypothesis.objects[0].id == old.record(4).id
    assert [o.birth for o in hypothesis.objects] == [0, 1]
    assert weighted_coverage(hypothesis.labels, true) > 0.9


def test_a_mask_over_known_objects_makes_no_new_one():
    """Under-segmentation now does not undo what the map knows."""
    true = box(1, width=10)
    true[30:40, 20:30, :10] = 2
    frame, _ = seen(true)
    old = Hypothesis.from_labels(true, GRID)
    blob = Hypothesis.from_labels((true > 0).astype(np.uint16), GRID, birth=1)
    fused = fuse(old, blob, frame)
    assert fused.particles[0].n_objects == 2
    assert fused.notes["maps"][0]["new"] == 0


def test_what_is_seen_through_is_forgotten():
    frame, _ = seen(box(1))
    old = box(1)
    old[42:48, 20:24, 8:14] = 2  # floats where the image shows the table
    fused = fuse(Hypothesis.from_labels(old, GRID), Hypothesis.from_labels(box(1), GRID, 1), frame)
    assert fused.particles[0].n_objects == 1
    assert fused.notes["maps"][0]["forgotten"] == 1


def test_the_preset_follows_a_slide_and_ties_with_the_single_frame_at_first(tmp_path):
    recording = slide(tmp_path / "r", (0, 1, 2, 3, 4, 5, 6))
    states = {
        name: [state.population for state, _ in preset(name).iterate(recording.clips()[:pauses], 0)]
        for name, pauses in (("object_fusion", 4), ("single_frame", 1))
    }
    assert states["object_fusion"][0].particles[0].key == states["single_frame"][0].particles[0].key
    assert all(len(p) == 1 for p in states["object_fusion"])
    last = states["object_fusion"][-1].particles[0]
    assert weighted_coverage(last.labels, recording.truth(3)) > 0.75
    assert {o.birth for o in last.objects} == {0}


def test_images_between_the_pauses_are_taken_in():
    """Three equal frames: those between add weight, so a wrong map is mended further."""
    frame, _ = seen(table_scene()[2])
    true = table_scene()[2]
    old = true.copy()
    old[15:25, 25:35, 12:14] = 1  # too high
    predicted = Population((Hypothesis.from_labels(old, GRID),))
    clip = Clip((frame,) * 4, GRID, 1)
    fused = ObjectFusion().update(RNG, predicted, None, clip)
    assert fused.notes["maps"][0]["images"] == 4  # two objects, two frames


class TestObjectFusion(UpdateContract):
    def make(self):
        return ObjectFusion()

    def example(self, rng, n):
        return scene_example(rng, n)
