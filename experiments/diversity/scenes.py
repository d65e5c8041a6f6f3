"""Scenes with an ambiguity: two similar boxes side by side, which may be one object or two.

>>> recording, pair = recorded(0)         # never moved in actions 0 and 1, pulled apart in action 2

Other objects are pushed in the first two actions while the twins stay in place; in the third, one twin is
pushed along their common face. A scene is used only if our own proposal is ambiguous at the first three
pauses: the fraction of sampled segmentations that have the twins as one object is within `AMBIGUOUS`. There is no
other selection.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import mstfilter
from mstfilter.errors import InputError
from mstfilter.formats import open_recording
from mstfilter.scene import Clip, Frame, Recording
from mstfilter.simulation import (
    GENERATOR_VERSION,
    FingerPush,
    PushEffect,
    SceneFamily,
    SimulatedScene,
    cache_folder,
    choose_push,
    play_push,
    record_scene,
    scene_family,
)

AMBIGUOUS = (0.2, 0.8)
N_CUTS = 60
N_PLACES = 12

TWINS = replace(
    scene_family("s1"),
    name="twins",
    n_objects_min=5,
    n_objects_max=5,
    n_twins=1,
    n_stacked=0,
    contact=0.0,
    shapes="brick,carton",
    n_actions=3,
    min_moved=1,
)


class TwinScene(SimulatedScene):
    """A scene whose twins stand side by side.

    Parameters
    ----------
    family : SceneFamily
    seed : int
    shift : float
        Offset of one twin along the common face, metres.
    turn : float
        Its rotation about the vertical, radians.

    Raises
    ------
    InputError
        There is no room for one twin next to the other, or they do not come to rest.
    """

    def __init__(self, family: SceneFamily, seed: int, shift: float = 0.0, turn: float = 0.0) -> None:
        super().__init__(family, seed)
        self.twin = next(k for k, t in enumerate(self.objects.twin_of) if t >= 0)
        self.other = self.objects.twin_of[self.twin]
        if not self._put_beside(shift, turn):
            raise InputError("no room for the twins")
        if not (self.world.settle() and family.contains_points(self.world.positions()).all()):
            raise InputError("the twins do not rest")

    def _put_beside(self, shift: float, turn_by: float) -> bool:
        """Move the twin against a side of the other one, in the direction of the normal of the face."""
        rng = np.random.default_rng([self.seed, 1])
        world, half = self.world, self.objects.shapes[self.other].half
        at, turn = world.positions()[self.other], world.rotations()[self.other]
        level = [axis for axis in range(3) if abs(turn[2, axis]) < 0.1]
        for axis in rng.permutation(level):
            for side in rng.permutation([-1.0, 1.0]):
                normal = side * turn[:, axis]
                along = np.cross([0.0, 0.0, 1.0], normal)
                turned = Rotation.from_euler("z", turn_by).as_matrix() @ turn
                for distance in 2 * half[axis] + np.arange(0.0003, 0.03, 0.0005):
                    world.place(self.twin, at + distance * normal + shift * along, turned)
                    world.forward()
                    if not world.overlaps(self.twin):
                        break
                if not world.overlaps(self.twin):
                    self.normal = normal[:2] / np.linalg.norm(normal[:2])
                    return True
        return False

    def choose_push(self, action: int) -> FingerPush:
        """Push other objects first, then one twin along the common face."""
        rng = np.random.default_rng([self.seed, 2, action])
        pair = [self.twin, self.other]
        if action < self.family.n_actions - 1:
            for _ in range(20):
                push = choose_push(rng, self.world, self.family)
                if self._tried(push).displacement[pair].max() < 0.001:
                    return push
            raise InputError("no push leaves the twins alone")
        along = np.array([-self.normal[1], self.normal[0]])
        length = self.family.push_speed * 0.6 * self.family.action_seconds
        for moved, stays in (pair, pair[::-1]):
            for direction in (along, -along):
                at = self.world.positions()[moved, :2]
                away = at - self.world.positions()[stays, :2]
                aim = at + 0.01 * away / np.linalg.norm(away)
                start = aim - direction * (self.objects.shapes[moved].radius + 0.02)
                end = start + length * direction
                push = FingerPush(
                    (float(start[0]), float(start[1])), (float(end[0]), float(end[1])), self.family.action_seconds
                )
                result = self._tried(push)
                far, near = result.displacement[moved], result.displacement[stays]
                if far > 0.06 and near < 0.03 and result.kept and result.settled:
                    return push
        raise InputError("the twins cannot be parted")

    def _tried(self, push: FingerPush) -> PushEffect:
        """The result of a push; the world does not change."""
        saved = self.world.save()
        result = play_push(self.world, push, self.family)
        self.world.restore(saved)
        return result


def as_one(labels: np.ndarray, truth: np.ndarray, pair: tuple[int, int]) -> bool | None:
    """Whether a segmentation has both twins as one object; None where one of them is missing.

    The label of a twin is the most frequent one among its true voxels that are occupied.
    """
    own = []
    for k in pair:
        counts = np.bincount(labels[truth == k])
        if len(counts) < 2 or counts[1:].sum() == 0:
            return None
        own.append(int(counts[1:].argmax()) + 1)
    return own[0] == own[1]


def share_as_one(clip: Clip, truth: np.ndarray, pair: tuple[int, int]) -> float:
    """Fraction of sampled segmentations of the last image of a clip that have the twins as one object."""
    samples = mstfilter.preset("mst").proposal.sample(np.random.default_rng(0), clip, N_CUTS)
    found = [as_one(h.labels, truth, pair) for h in samples.particles]
    return float(np.mean([one for one in found if one is not None] or [np.nan]))


def recorded(
    seed: int, ambiguous: tuple[float, float] = AMBIGUOUS, **overrides: int | float
) -> tuple[Recording, tuple[int, int]] | None:
    """A recording and the labels of its twins; None if this seed gives no ambiguous pair that can be moved apart.

    Both results are cached.
    """
    family = replace(TWINS, **overrides)
    recipe = json.dumps([GENERATOR_VERSION, asdict(family), ambiguous, N_CUTS])
    target = cache_folder() / "recordings" / f"twins-{seed}-{hashlib.sha256(recipe.encode()).hexdigest()[:12]}"
    if not (target / "twins.json").is_file():
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as work:
            made = Path(work) / "recording"
            pair = _record(seed, family, ambiguous, made)
            if pair is None:
                shutil.rmtree(made, ignore_errors=True)
                made.mkdir()
            (made / "twins.json").write_text(json.dumps(pair))
            shutil.rmtree(target, ignore_errors=True)
            made.rename(target)
    pair = json.loads((target / "twins.json").read_text())
    return None if pair is None else (open_recording(target), tuple(pair))


def _record(seed: int, family: SceneFamily, ambiguous: tuple[float, float], path: Path) -> tuple[int, int] | None:
    """Try positions of the twin until the samples of the first image are ambiguous; then act and record."""
    rng = np.random.default_rng([seed, 0])
    for _ in range(N_PLACES):
        try:
            scene = TwinScene(family, seed, *(rng.uniform((-0.03, -0.3), (0.03, 0.3))))
            pair = (scene.twin + 1, scene.other + 1)
            seen = scene.frame_images(0)
            clip = Clip((Frame(seen["rgb"], seen["depth"], scene.camera, seen["robot_mask"]),), scene.grid)
            if ambiguous[0] <= share_as_one(clip, scene.truth(), pair) <= ambiguous[1]:
                recording = record_scene(scene, path)
                shares = [
                    share_as_one(c, recording.truth(c.index), pair)
                    for c in recording.clips()
                    if c.index < family.n_actions
                ]
                if ambiguous[0] <= min(shares) and max(shares) <= ambiguous[1]:
                    return pair
                shutil.rmtree(path)
        except InputError:  # no room, or no push that leaves or parts them
            shutil.rmtree(path, ignore_errors=True)
    return None
