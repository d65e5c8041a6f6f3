"""Floors, and the proposal that proposes once."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.lab.baselines import FirstPause, ImageComponents, OccupiedComponents, OneBlob
from mstfilter.mst.completion import ClipCompleter, Extrude
from mstfilter.mst.segmentation import TreeCutProposal
from mstfilter.scene import Camera, Frame
from tests.lab.baselines.scenes import slide


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return slide(tmp_path_factory.mktemp("floors") / "slide")


def test_first_pause_draws_as_the_proposal_itself_and_then_nothing(recording):
    inner = TreeCutProposal()
    first, later = recording.clips()[0], recording.clips()[1]
    once = FirstPause(inner).sample(np.random.default_rng(3), first, 3)
    plain = inner.sample(np.random.default_rng(3), first, 3)
    assert [h.key for h in once.particles] == [h.key for h in plain.particles]
    empty = FirstPause(inner).sample(np.random.default_rng(3), later, 2)
    assert [h.n_objects for h in empty.particles] == [0, 0]


@pytest.mark.parametrize("floor, n", [(OneBlob(), 1), (OccupiedComponents(), 2), (ImageComponents(), 2)])
def test_floors_on_two_boxes_that_stand_apart(recording, floor, n):
    clip = recording.clips()[2]
    population = floor.sample(np.random.default_rng(0), clip, 3)
    assert len(population) == 3
    # In so small an image a fleck of a few pixels is an object of the image's components.
    assert [sum(v > 50 for v in h.volumes().values()) for h in population.particles] == [n] * 3
    hypothesis = population.particles[0]
    true = recording.truth(2) > 0
    found = hypothesis.labels > 0
    assert (found & true).sum() / (found | true).sum() > 0.6
    assert all(o.birth == 2 for o in hypothesis.objects)
    again = floor.sample(np.random.default_rng(9), clip, 1)
    assert again.particles[0].key == hypothesis.key  # nothing is drawn


def test_components_of_the_image_end_at_steps_of_depth():
    camera = Camera.from_intrinsics(100, 100, 31.5, 23.5, 64, 48)
    depth = np.full((48, 64), 0.8, np.float32)
    depth[:, 30:] = 0.7  # 10 cm nearer
    depth[40:, :] = np.nan
    frame = Frame(np.zeros((48, 64, 3), np.uint8), depth, camera)
    own = np.isfinite(depth)
    own[:, 50:52] = False
    labels = ImageComponents().label_image(frame, own)
    assert sorted(np.unique(labels)) == [0, 1, 2, 3]
    assert len({labels[5, 5], labels[5, 40], labels[5, 60]}) == 3
    own[:] = False
    own[3, 3] = True  # one pixel of noise, of at least 60 in 640 x 480
    frame_large = Frame(
        np.zeros((480, 640, 3), np.uint8), np.full((480, 640), 0.8, np.float32),
        Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480),
    )  # fmt: skip
    few = np.zeros((480, 640), bool)
    few[:5, :5] = True
    few[20:40, 20:40] = True
    assert ImageComponents().label_image(frame_large, few).max() == 1


def test_nothing_on_the_table_is_nothing(tmp_path):
    from mstfilter.scene import Clip
    from tests.scene.scenes import CAMERA, GRID, table_scene

    rgb, depth, _ = table_scene(empty=True)
    clip = Clip((Frame(rgb, depth, CAMERA),), GRID)
    for floor in (OneBlob(), OccupiedComponents(), ImageComponents()):
        assert floor.sample(np.random.default_rng(0), clip, 1).particles[0].n_objects == 0


class OfClip(ClipCompleter):
    """Completes only if it is bound to a clip."""

    def at(self, clip):
        return Extrude()

    def fill(self, rng, seen):
        raise AssertionError("not bound to a clip")


def test_completers_of_a_clip_are_bound_by_every_floor(recording):
    clip = recording.clips()[2]
    for kind in (OneBlob, OccupiedComponents, ImageComponents):
        found, expected = (
            kind(completer=completer).sample(np.random.default_rng(0), clip, 1) for completer in (OfClip(), Extrude())
        )
        assert found.particles[0].key == expected.particles[0].key
