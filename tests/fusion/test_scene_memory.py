"""Memory of free space: an oracle voxel by voxel, and what must and must not be remembered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from mstfilter.errors import InputError
from mstfilter.fusion.free_space import FreeSpace
from mstfilter.fusion.projection import ProjectionUpdate
from mstfilter.fusion.scene_memory import SceneMemory
from mstfilter.presets import preset
from mstfilter.scene import Clip, Frame, Hypothesis, Recording, VoxelGrid, cache as memo
from mstfilter.smc import ParticleFilter, Population, Proposal
from mstfilter.tracking import IdentityTransition
from tests.fusion.looks import CAMERAS, SMALL, frame_of, look, views
from tests.scene.scenes import CAMERA, GRID, table_scene

ALWAYS = FreeSpace(memory=SceneMemory(keep=1.0, reach=0.1))
RGB, DEPTH, LABELS = table_scene()
OPEN = Frame(RGB, DEPTH, CAMERA)
ROBOT = np.zeros(DEPTH.shape, bool)
ROBOT[:, :80] = True
BLOCKED = Frame(RGB, DEPTH, CAMERA, ROBOT)


def chain(*clips, grid=GRID):
    """Clips of these frames, each knowing the one before."""
    last = None
    for t, frames in enumerate(clips):
        last = Clip(frames, grid, t, previous=last)
    return last


def test_with_nothing_moved_what_the_first_frame_saw_stays_known_behind_the_robot():
    clip = chain((OPEN,), (OPEN, BLOCKED), (BLOCKED, BLOCKED, BLOCKED))
    first = FreeSpace().known_free(OPEN, GRID)
    np.testing.assert_array_equal(ALWAYS.known_free_after(clip), first)
    assert (first & ~FreeSpace().known_free_after(clip)).sum() > 1000, "without memory it is unknown"
    invented = LABELS.copy()
    invented[20:26, 8:14, :8] = 3
    wrong = Hypothesis.from_labels(invented, GRID)
    (forgetful,), _ = FreeSpace().refine((wrong,), clip)
    (mindful,), (quality,) = ALWAYS.refine((wrong,), clip)
    assert (mindful.labels == 3).sum() < 0.3 * (forgetful.labels == 3).sum()
    np.testing.assert_array_equal(mindful.labels[LABELS > 0], LABELS[LABELS > 0])
    assert quality == pytest.approx((mindful.labels > 0).sum() / (invented > 0).sum())


@pytest.mark.parametrize(
    ("keep", "pauses"), [(0.0, 0), (0.49, 0), (0.5, 1), (0.8, 3), (0.5**0.1, 10), (0.999999, 254), (1.0, 254)]
)
def test_a_belief_lasts_while_half_of_it_is_left(keep, pauses):
    memory = SceneMemory(keep=keep)
    assert memory.pauses == pauses
    if 0 < pauses < 20:
        blocked = [(OPEN,)] + [(BLOCKED,)] * (pauses + 1)
        before = replace(FreeSpace(), memory=memory).known_free_after(chain(*blocked[:-1]))
        after = replace(FreeSpace(), memory=memory).known_free_after(chain(*blocked))
        np.testing.assert_array_equal(before, FreeSpace().known_free(OPEN, GRID))
        np.testing.assert_array_equal(after, FreeSpace().known_free(BLOCKED, GRID))


@pytest.mark.parametrize("noise", [None, 3])
def test_no_memory_where_a_pushed_object_may_be(noise):
    """A box is pushed to where there was nothing, and the robot stands before it."""
    rng = None if noise is None else np.random.default_rng(noise)
    frames = [Frame(RGB, table_scene(0, rng)[1], CAMERA)]
    for shift in (2, 4, 6):
        rgb, depth, moved = table_scene(shift, rng)
        frames.append(Frame(rgb, depth, CAMERA))
    robot = np.zeros(DEPTH.shape, bool)
    robot[:, 60:100] = True
    frames.append(Frame(rgb, depth, CAMERA, robot))
    assert (frames[-1].valid & (frames[-2].depth < 0.7)).any()
    clip = chain(frames[:1], frames)
    known, now = ALWAYS.known_free_after(clip), FreeSpace().known_free(frames[-1], GRID)
    truth = moved > 0
    first = FreeSpace().known_free(frames[0], GRID)
    assert (first & truth).sum() > 100, "it stands where it was seen to be free"
    assert not (known & ~now & truth).any()
    assert (known & ~now).sum() > 200, "further away it is remembered"
    # Without the images of the push, but with its end in sight, it is known as well.
    short = chain(frames[:1], [frames[0], frames[3]], [frames[4]])
    assert not (ALWAYS.known_free_after(short) & ~now & truth).any()


def test_what_is_seen_now_outweighs_memory():
    shut = Frame(RGB, np.full_like(DEPTH, 0.4), CAMERA)  # a lid before everything: all behind it is hidden
    clip = chain((OPEN,), (OPEN, shut))
    assert not ALWAYS.known_free_after(clip)[FreeSpace()._look(shut, GRID).hit].any()
    opened = chain((OPEN,), (OPEN, shut), (shut, OPEN))
    np.testing.assert_array_equal(ALWAYS.known_free_after(opened), FreeSpace().known_free(OPEN, GRID))


# -- against an oracle -----------------------------------------------------------------------------------------------


def remembered(clips, grid, margin, reach, keep):
    """Free voxels after clips (lists of frames), by the definition; None where the oracle is not sure."""
    centres = grid.centres().reshape(-1, 3)
    says = [[look(frame, grid, *margin, 0.0) for frame in frames] for frames in clips]
    if any(one.unsure.any() for frames in says for one in frames):
        return None
    belief = np.where(says[0][0].free, 1.0, 0.0)
    for t, frames in enumerate(says):
        past = frames[0] if t == 0 else says[t - 1][-1]
        moved = np.zeros(grid.shape, bool)
        for now in frames:
            moved |= _groups_of_four((now.hit & (belief > 0)) | (past.hit & now.free))
        at = centres[moved.ravel()]
        for n, index in enumerate(np.ndindex(*grid.shape)):
            near = len(at) and np.sqrt(((centres[n] - at) ** 2).sum(axis=1)).min() <= reach + 1e-9
            if frames[-1].free[index]:
                belief[index] = 1.0
            elif not frames[-1].hidden[index] or near:
                belief[index] = 0.0
            else:
                belief[index] *= keep
    return says[-1][-1].free | (belief >= 0.5 - 1e-12)


def _groups_of_four(voxels):
    """Flood fill over 26 neighbours; groups of less than four voxels are left out."""
    left, out = {tuple(v) for v in np.argwhere(voxels).tolist()}, np.zeros_like(voxels)
    while left:
        group, front = set(), [left.pop()]
        while front:
            v = front.pop()
            group.add(v)
            near = [w for w in left if max(abs(a - b) for a, b in zip(v, w, strict=True)) <= 1]
            left -= set(near)
            front += near
        if len(group) >= 4:
            for v in group:
                out[v] = True
    return out


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.integers(1, 2).flatmap(views), min_size=1, max_size=3), min_size=2, max_size=4),
    st.sampled_from([0.0, 0.05, 0.1]),
    st.sampled_from([0.5, 1.0]),
)
def test_memory_is_what_the_definition_says(clips, reach, keep):
    expected = remembered(clips, SMALL, (0.5, 3.0), reach, keep)
    assume(expected is not None)
    found = FreeSpace(memory=SceneMemory(keep, reach)).known_free_after(chain(*clips, grid=SMALL))
    np.testing.assert_array_equal(found, expected)


# -- no state --------------------------------------------------------------------------------------------------------


def test_the_last_clip_alone_says_the_same_as_step_by_step():
    rng = np.random.default_rng(0)
    past, known = None, []
    for t in range(4):
        depth = table_scene(t, rng)[1]
        mask = np.zeros(DEPTH.shape, bool)
        mask[:, 40 * t : 40 * t + 60] = True
        past = Clip((Frame(RGB, depth, CAMERA, mask),), GRID, t, previous=past)
        known.append(ALWAYS.known_free_after(past).copy())
    memo.clear()
    np.testing.assert_array_equal(ALWAYS.known_free_after(past), known[-1])
    assert not np.array_equal(known[-1], FreeSpace().known_free_after(past))


def test_a_thousand_pauses_are_no_recursion():
    grid = VoxelGrid((-0.1, -0.1, 0.0), 0.1, (2, 2, 1))
    frames = [frame_of(np.full((9, 12), 0.5 + 0.0001 * k, np.float32), CAMERAS[0]) for k in range(1000)]
    clip = chain(*((frame,) for frame in frames), grid=grid)
    assert ALWAYS.known_free_after(clip).shape == grid.shape
    assert len(clip.key) == 16


def test_clips_of_a_recording_know_the_one_before():
    images = np.stack([RGB] * 5), np.stack([DEPTH] * 5)
    recording = Recording.from_arrays(
        *images, CAMERA.K, pauses=(0, 2, 4), T_world_camera=CAMERA.T_world_camera, grid=GRID
    )
    clips = recording.clips()
    assert [clip.previous for clip in clips] == [None, *clips[:-1]]
    assert len({clip.key for clip in clips}) == 3
    assert [clip.key for clip in recording.clips()] == [clip.key for clip in clips]
    assert replace(clips[2], previous=None).key != clips[2].key
    with pytest.raises(InputError, match="different grids"):
        Clip((OPEN,), SMALL, 1, previous=clips[0])


def test_a_resumed_filter_gives_the_same():
    """State is population and key: memory comes from the observations."""

    class Start(Proposal):
        def sample(self, rng, observation, n):
            labels = [np.where(rng.random(GRID.shape) < 0.02, 5, LABELS) for _ in range(n)]
            return Population(tuple(Hypothesis.from_labels(a, GRID) for a in labels))

    filter = ParticleFilter(
        initial=Start(), transition=IdentityTransition(), update=ProjectionUpdate(ALWAYS), n=3, resample="after"
    )
    clips = [(OPEN,), (OPEN, BLOCKED), (BLOCKED,)]
    states = []
    for t in range(3):
        state, _ = filter.step(states[-1] if states else filter.start(0), chain(*clips[: t + 1]))
        states.append(state)
    memo.clear()
    again, _ = filter.step(states[1], chain(*clips))
    assert [h.key for h in again.population.particles] == [h.key for h in states[-1].population.particles]
    np.testing.assert_array_equal(again.population.log_weights, states[-1].population.log_weights)


def test_fields():
    assert preset("mst").update.free_space.memory.pauses == 0
    assert preset("mst", "update.free_space.memory.keep=0.8").update.free_space.memory == SceneMemory(keep=0.8)
    for wrong in ({"keep": -0.1}, {"keep": 1.1}, {"keep": float("nan")}, {"reach": -1.0}, {"reach": float("inf")}):
        with pytest.raises(InputError, match="scene memory"):
            SceneMemory(**wrong)
    elsewhere = Hypothesis.from_labels(np.ones(SMALL.shape, np.uint16), SMALL)
    with pytest.raises(InputError, match="different grids"):
        ALWAYS.refine((elsewhere,), chain((OPEN,)))
