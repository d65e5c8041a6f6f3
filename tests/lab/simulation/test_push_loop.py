"""Scenes that are changed by chosen pushes: equal to recordings, restored bit by bit, and filtered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mstfilter import Belief, preset
from mstfilter.base.errors import InputError
from mstfilter.lab.simulation import FingerPush, PushLoop, SimulatedScene, scene_family, simulate_recording
from mstfilter.mst.belief.pushes import PushCandidate
from mstfilter.scoring import ask, object_status

FAMILY = replace(
    scene_family("demo"), width=96, height=72, frames_per_clip=6, n_actions=2, supersample=1, n_candidates=6
)


@pytest.fixture(scope="module")
def played():
    """A loop that plays the pushes of the recorder."""
    loop, scene = PushLoop(FAMILY, 3), SimulatedScene(FAMILY, 3)
    for action in range(2):
        scene.world.restore(loop.save().world)
        loop.play(scene.choose_push(action))
    return loop


def test_the_pushes_of_the_recorder_give_its_recording(played, tmp_path):
    recorded, looped = simulate_recording(FAMILY, 3, tmp_path / "recording"), played.recording()
    assert (looped.pauses, len(looped.frames)) == (recorded.pauses, len(recorded.frames))
    np.testing.assert_allclose(looped.times, recorded.times)
    for k in range(len(looped.frames)):
        a, b = looped.frames[k], recorded.frames[k]
        for name in ("rgb", "depth", "robot_mask"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=f"{name} of frame {k}")
        np.testing.assert_array_equal(looped.instance(k), recorded.instance(k))
    for t in range(3):
        np.testing.assert_array_equal(looped.truth(t), recorded.truth(t))
    assert played.clip.key == recorded.clips()[2].key
    assert len(ask(looped, 2, 100)) == 100 and object_status(looped, 2)


def test_a_restored_loop_gives_the_same_images():
    loop = PushLoop(FAMILY, 4)
    pushes = loop.candidates(3)
    assert loop.candidates(3) == pushes  # drawing changes nothing
    state = loop.save()
    first = loop.play(pushes[0])
    loop.restore(state)
    assert loop.n_pushes == 0 and len(loop.clip) == 1
    other = loop.play(pushes[1])
    loop.restore(state)
    again = loop.play(pushes[0])
    assert again.key == first.key != other.key
    assert loop.recording().pauses == (0, 5)


def test_lost_objects_are_counted():
    loop = PushLoop(FAMILY, 3)
    assert loop.lost == set()
    loop._scene.world.place(0, (5.0, 5.0, 0.0), np.eye(3))
    loop.play(loop.candidates(1)[0])
    assert 1 in loop.lost


def test_the_voxels_that_a_finger_sweeps():
    grid = FAMILY.grid()
    push = FingerPush((-0.05, 0.0), (0.05, 0.02), 3.0)
    swept = push.swept(grid)
    centres = grid.centres()[swept]
    assert swept.any() and (np.abs(centres[:, 0]) < 0.05 + 0.012).all()
    assert centres[:, 2].min() < 0.02 and centres[:, 2].max() > 0.15
    line = 0.2 * centres[:, 0] + 0.01  # y of the line at the same x
    assert (np.abs(centres[:, 1] - line) < 0.012 * np.hypot(1, 0.2) + 0.005).all()


def test_a_filter_decides():
    loop, mst = PushLoop(FAMILY, 5), preset("mst", "n=2")
    state, _ = mst.step(mst.start(0), loop.clip)
    belief, pushes = Belief(state.population), loop.candidates(4)
    push = belief.most_informative(pushes, lambda p: belief.push_information(p.swept(loop.grid), tolerance=20))
    state, _ = mst.step(state, loop.play(push or pushes[0]))
    assert state.t == 2 and state.population.particles[0].grid == loop.grid


def test_a_candidate_pushes_at_its_height_and_parts_are_shown():
    loop = PushLoop(replace(scene_family("stack"), width=160, height=120, frames_per_clip=6, arm=False), 0)
    parts, truth = loop.part_image(), loop.recording().instance(0)
    numbers = [part["object"] for group in loop.groups for part in group["parts"]]
    for k, owner in enumerate(numbers, start=1):
        assert (truth[parts == k] == owner).all()
    assert np.isin(truth[parts > 0], numbers).all() and (parts > 0).sum() > 100
    above = np.array([0.1, 0.0, 0.15])
    push = FingerPush.with_tip(above, above + (0.05, 0, 0), 1.0)
    assert push.target(0.5)[2] == pytest.approx(0.25) and FingerPush.with_tip(0 * above, above, 1.0).height < 0.13
    candidate = PushCandidate(above, np.array([1.0, 0, 0]), 0.05, 0.1, None, 0.02, 1)
    loop.play(candidate)
    assert loop.n_pushes == 1


@pytest.mark.parametrize("n", [0, 1.5])
def test_wrong_numbers_of_candidates(n):
    with pytest.raises(InputError, match="number of candidates"):
        PushLoop(FAMILY, 3).candidates(n)
