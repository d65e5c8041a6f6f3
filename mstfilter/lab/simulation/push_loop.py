"""A simulated scene for filters that choose the next push of the robot.

>>> from mstfilter import Belief, preset
>>> from mstfilter.lab.simulation import PushLoop, scene_family
>>> loop, mst = PushLoop(scene_family("s1"), seed=0), preset("mst")  # doctest: +SKIP
>>> state, _ = mst.step(mst.start(0), loop.clip)  # doctest: +SKIP
>>> while loop.n_pushes < 6:  # doctest: +SKIP
...     belief, pushes = Belief(state.population), loop.candidates(16)
...     push = belief.most_informative(pushes, lambda p: belief.push_information(p.swept(loop.grid), tolerance=50))
...     state, _ = mst.step(state, loop.play(push or pushes[0]))

A policy chooses one of the candidate pushes, using only clips and beliefs. The ground truth is for scores only. The
scene and the candidate pushes depend on the family, the seed and the earlier pushes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError, check_component, check_integer
from mstfilter.lab.simulation.families import SceneFamily
from mstfilter.lab.simulation.groups import parts_in
from mstfilter.lab.simulation.recorder import SimulatedScene, stream
from mstfilter.lab.simulation.world import FingerPush, PushEffect, draw_push, is_clear
from mstfilter.mst.belief.pushes import PushCandidate
from mstfilter.scene import Clip, Frame, Recording, VoxelGrid


class _Recorded(NamedTuple):
    """A recorded frame of a `PushLoop`."""

    frame: Frame
    instance: np.ndarray
    time: float
    truth: np.ndarray | None  # at a pause


@dataclass(frozen=True, eq=False)
class LoopState:
    """A state of a `PushLoop`."""

    world: np.ndarray
    stage: Any
    recorded: tuple[_Recorded, ...]
    effects: tuple[PushEffect, ...]
    clip: Clip


class PushLoop:
    """A simulated scene at a pause, and its video so far.

    Parameters
    ----------
    family : SceneFamily
        The field `n_actions` is ignored, because any number of pushes can be played.
    seed : int

    Attributes
    ----------
    clip : Clip
        The clip from the last pause to the present pause, which is the observation of a filter step.
    effects : list of PushEffect
        The effect of every push.
    """

    def __init__(self, family: SceneFamily, seed: int) -> None:
        self._scene = SimulatedScene(family, seed)
        self._recorded: list[_Recorded] = []
        self._start = self._scene.world.time
        self.effects: list[PushEffect] = []
        self._add_frame(pause=True)
        self.clip = Clip((self._recorded[0].frame,), self.grid, 0, (0.0,))

    @property
    def grid(self) -> VoxelGrid:
        """The workspace."""
        return self._scene.grid

    @property
    def family(self) -> SceneFamily:
        return self._scene.family

    @property
    def lost(self) -> set[int]:
        """Ground-truth labels of the objects that were present at the first pause and have left the workspace."""
        truths = [one.truth for one in self._recorded if one.truth is not None]
        return set(np.unique(truths[0]).tolist()) - set(np.unique(truths[-1]).tolist())

    @property
    def n_pushes(self) -> int:
        """Number of pushes played."""
        return len(self.effects)

    @property
    def groups(self) -> list[dict[str, Any]]:
        """The groups of the scene, as in the manifest of a recording."""
        return [group.describe() for group in self._scene.objects.groups]

    def part_image(self) -> np.ndarray:
        """Which part of a group each pixel of the present pause shows; see `groups.part_image`."""
        last = self._recorded[-1]
        poses = dict(enumerate(self._scene.world.poses(), start=1))
        return parts_in(last.frame, last.instance, poses, self.groups)

    def candidates(self, n: int) -> tuple[FingerPush, ...]:
        """`n` random pushes towards objects. Each push starts at a free position. The scene does not change.

        Pushes are drawn towards true objects, so most pushes move an object. Some pushes miss all objects or drop an
        object.
        """
        check_integer("number of candidates", n)
        rng = stream(self._scene.seed, "candidates", self.n_pushes)
        found: list[FingerPush] = []
        for _ in range(50 * n):
            push = draw_push(rng, self._scene.world, self.family)
            if is_clear(self._scene.world, push.start):
                found.append(push)
                if len(found) == n:
                    return tuple(found)
        raise InputError(
            f"there is no room for {n} pushes between the objects, only for {len(found)}", "ask for fewer"
        )

    def play(self, push: FingerPush | PushCandidate) -> Clip:
        """Simulate and record a push, for example the first of `push_candidates`.

        Returns the clip from the last pause to the new pause.
        """
        if isinstance(push, PushCandidate):
            push = FingerPush.with_tip(push.start, push.end, self.family.action_seconds)
        check_component("push", push, FingerPush)
        first = len(self._recorded) - 1
        self.effects.append(self._scene.play(push, self._add_frame))
        self._add_frame(pause=True)
        frames, _, times, _ = zip(*self._recorded[first:], strict=True)
        self.clip = Clip(frames, self.grid, self.n_pushes, times)
        return self.clip

    def save(self) -> LoopState:
        """A copy of the state of the scene. With `restore`, a policy can try several pushes from the same state."""
        world, stage = self._scene.world.save(), self._scene.stage.save()
        return LoopState(world, stage, tuple(self._recorded), tuple(self.effects), self.clip)

    def restore(self, state: LoopState) -> None:
        """Return to a saved state of the same `PushLoop`. After `restore`, the same pushes give the same images."""
        self._scene.world.restore(state.world)
        self._scene.stage.restore(state.stage)
        self._recorded, self.effects, self.clip = list(state.recorded), list(state.effects), state.clip

    def recording(self) -> Recording:
        """A recording of all frames so far, with ground truth."""
        frames, instances, times, truths = zip(*self._recorded, strict=True)
        pauses = tuple(k for k, truth in enumerate(truths) if truth is not None)
        return Recording(
            frames,
            self.grid,
            pauses,
            times,
            f"{self.family.name}-{self._scene.seed}",
            truth=lambda t: truths[pauses[t]],
            instance=lambda index: instances[index],
        )

    def _add_frame(self, time: float | None = None, pause: bool = False) -> None:
        scene = self._scene
        images = scene.frame_images(len(self._recorded))
        scale = Recording.depth_scale  # depth in whole units, as recordings store it
        depth = np.rint(np.nan_to_num(images["depth"].astype(np.float64) / scale)) * np.float32(scale)
        frame = Frame(images["rgb"], depth, scene.camera, images["robot_mask"])
        seconds = round((scene.world.time if time is None else time) - self._start, 6)
        self._recorded.append(_Recorded(frame, images["instance"], seconds, scene.truth() if pause else None))
