"""A simulated scene that chosen pushes change, for filters that decide the next action of the robot.

>>> from mstfilter import Belief, preset
>>> from mstfilter.simulation import PushLoop, scene_family
>>> loop, mst = PushLoop(scene_family("s1"), seed=0), preset("mst")  # doctest: +SKIP
>>> state, _ = mst.step(mst.start(0), loop.clip)  # doctest: +SKIP
>>> while loop.n_pushes < 6:  # doctest: +SKIP
...     belief, pushes = Belief(state.population), loop.candidates(16)
...     push = belief.most_informative(pushes, lambda p: belief.push_information(p.swept(loop.grid), tolerance=50))
...     state, _ = mst.step(state, loop.play(push or pushes[0]))

A policy chooses one of the candidates. The policy gets clips and beliefs. Only scores use the truth. The scene and
its candidates depend on the family, the seed and the pushes so far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError, check_component, check_integer
from mstfilter.scene import Clip, Frame, Recording, VoxelGrid
from mstfilter.simulation.families import SceneFamily
from mstfilter.simulation.recorder import SimulatedScene, stream
from mstfilter.simulation.world import FingerPush, PushEffect, draw_push, is_clear, play_push

_LISTS = ("_frames", "_instances", "_truths", "_pauses", "_times", "effects")


@dataclass(frozen=True, eq=False)
class LoopState:
    """A state of a `PushLoop`."""

    world: np.ndarray
    stage: Any
    lists: tuple[tuple[Any, ...], ...]
    clip: Clip


class PushLoop:
    """A simulated scene at a pause, and its video so far.

    Parameters
    ----------
    family : SceneFamily
        `n_actions` is ignored, since any number of pushes can be played.
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
        self._frames: list[Frame] = []
        self._instances: list[np.ndarray] = []
        self._truths: list[np.ndarray] = []
        self._pauses: list[int] = []
        self._times: list[float] = []
        self._start = self._scene.world.time
        self.effects: list[PushEffect] = []
        self._add_frame(pause=True)
        self.clip = Clip((self._frames[0],), self.grid, 0, (0.0,))

    @property
    def grid(self) -> VoxelGrid:
        """The workspace."""
        return self._scene.grid

    @property
    def family(self) -> SceneFamily:
        return self._scene.family

    @property
    def lost(self) -> set[int]:
        """True labels of the objects of the first pause that have left the workspace."""
        first, now = (set(np.unique(labels).tolist()) for labels in (self._truths[0], self._truths[-1]))
        return first - now

    @property
    def n_pushes(self) -> int:
        """Number of pushes played."""
        return len(self.effects)

    def candidates(self, n: int) -> tuple[FingerPush, ...]:
        """n pushes towards objects, with a free place for the finger to come down. The scene does not change.

        Pushes are drawn towards true objects, so most of them move something. Some move nothing or drop an object.
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

    def play(self, push: FingerPush) -> Clip:
        """Simulate a push and record it. Returns the clip from the last pause to the new pause."""
        check_component("push", push, FingerPush)
        first = len(self._frames) - 1
        self.effects.append(self._scene.play(push, self._add_frame))
        self._add_frame(pause=True)
        times = tuple(self._times[first:])
        self.clip = Clip(tuple(self._frames[first:]), self.grid, self.n_pushes, times)
        return self.clip

    def effect(self, push: FingerPush) -> PushEffect:
        """The effect of a push, for oracles, since a policy cannot know it. The scene does not change."""
        saved = self._scene.world.save()
        try:
            return play_push(self._scene.world, push, self.family)
        finally:
            self._scene.world.restore(saved)

    def save(self) -> LoopState:
        """The present state for `restore`, for example to try several pushes from it."""
        kept = tuple(tuple(getattr(self, name)) for name in _LISTS)
        return LoopState(self._scene.world.save(), self._scene.stage.save(), kept, self.clip)

    def restore(self, state: LoopState) -> None:
        """Return to a saved state of this loop. The same pushes then give the same images."""
        self._scene.world.restore(state.world)
        self._scene.stage.restore(state.stage)
        for name, values in zip(_LISTS, state.lists, strict=True):
            setattr(self, name, list(values))
        self.clip = state.clip

    def recording(self) -> Recording:
        """Everything so far as a recording with ground truth."""
        truths, instances = tuple(self._truths), tuple(self._instances)
        return Recording(
            tuple(self._frames),
            self.grid,
            tuple(self._pauses),
            tuple(self._times),
            f"{self.family.name}-{self._scene.seed}",
            truth=lambda t: truths[t],
            instance=lambda index: instances[index],
        )

    def _add_frame(self, time: float | None = None, pause: bool = False) -> None:
        scene, index = self._scene, len(self._frames)
        images = scene.frame_images(index)
        scale = Recording.depth_scale  # depth in whole units, as recordings store it
        depth = np.rint(np.nan_to_num(images["depth"].astype(np.float64) / scale)) * np.float32(scale)
        self._frames.append(Frame(images["rgb"], depth, scene.camera, images["robot_mask"]))
        self._instances.append(images["instance"])
        self._times.append(round((scene.world.time if time is None else time) - self._start, 6))
        if pause:
            self._pauses.append(index)
            self._truths.append(scene.truth())
