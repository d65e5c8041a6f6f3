"""Pushes: a finger comes down, moves in a straight line, goes up and away.

Which push is made is decided by trying: candidate lines through the objects are simulated from the saved
state and the first is kept that moves enough of them without dropping any off the table. Physics is so
cheap beside rendering that dozens may be tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import InputError
from mstfilter.simulation.families import SceneFamily
from mstfilter.simulation.world import FINGER_HALF, FINGER_RADIUS, PARKED, TIME_STEP, World

__all__ = ["Effect", "Push", "choose_push", "play"]

LOW = FINGER_HALF + FINGER_RADIUS + 0.012
"""Height of the finger's middle while it pushes: its tip is 12 mm above the table."""

HIGH = LOW + 0.26

# Shares of an action's time: coming down, pushing, going up; the rest belongs to settling.
DOWN, PUSH, UP = 0.17, 0.60, 0.15


@dataclass(frozen=True)
class Push:
    """A straight push along the table.

    Parameters
    ----------
    start, end : (x, y) metres
        Path of the finger while it is down.
    seconds : float
        From one pause to the next, settling apart.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    seconds: float

    def target(self, t: float) -> np.ndarray:
        """(3,) where the finger is driven t seconds after the pause."""
        a, b = np.array(self.start), np.array(self.end)
        share = t / self.seconds
        if share < DOWN:
            return np.array([*a, HIGH + (LOW - HIGH) * share / DOWN])
        if share < DOWN + PUSH:
            return np.array([*(a + (b - a) * (share - DOWN) / PUSH), LOW])
        if share < DOWN + PUSH + UP:
            return np.array([*b, LOW + (HIGH - LOW) * (share - DOWN - PUSH) / UP])
        return PARKED


@dataclass(frozen=True)
class Effect:
    """What a push did.

    Parameters
    ----------
    displacement : (n,) metres
        How far each object's origin moved.
    turned : (n,) radians
        How far each object turned.
    settled : bool
        Whether all came to rest.
    kept : bool
        Whether all are still on the table, in the workspace and in view.
    """

    displacement: np.ndarray
    turned: np.ndarray
    settled: bool
    kept: bool

    def moved(self, threshold: float) -> int:
        """Number of objects that moved farther than `threshold` metres."""
        return int((self.displacement > threshold).sum())


def advance(world: World, push: Push, start: float, stop: float) -> None:
    """Carry the push on from `start` to `stop`, seconds after its pause."""
    first, last = round(start / TIME_STEP), round(stop / TIME_STEP)
    parked = round((DOWN + PUSH + UP) * push.seconds / TIME_STEP)
    for k in range(first, last):
        if k == 0:
            world.move_finger(push.target(0.0))
        elif k == parked:
            world.move_finger(PARKED)
        if k < parked:
            world.steer_finger(push.target(k * TIME_STEP))
        world.step()
    world.forward()


def finish(world: World) -> bool:
    """After the last step of a push: wait until all is at rest; False if that took too long."""
    world.move_finger(PARKED)
    return world.settle()


def play(world: World, push: Push, family: SceneFamily) -> Effect:
    """Carry out a whole push and wait until all is at rest."""
    before, turn = world.positions(), world.rotations()
    advance(world, push, 0.0, push.seconds)
    settled = finish(world)
    return effect(world, before, turn, settled, family)


def effect(world: World, before: np.ndarray, turn: np.ndarray, settled: bool, family: SceneFamily) -> Effect:
    """The effect of a push, from positions (n, 3) and rotations (n, 3, 3) before it."""
    after = world.positions()
    trace = np.einsum("nij,nij->n", turn, world.rotations())
    kept = bool(family.holds(after).all())
    moved = np.linalg.norm(after - before, axis=1)
    return Effect(moved, np.arccos(np.clip((trace - 1) / 2, -1, 1)), settled, kept)


def _clear(world: World, at: tuple[float, float]) -> bool:
    """Whether the finger can come down at a place without meeting an object."""
    saved = world.save()
    good = True
    for height in np.linspace(HIGH, LOW, 5):
        world.move_finger((*at, height))
        world.forward()
        if world.overlaps():
            good = False
            break
    world.restore(saved)
    return good


def _candidate(rng: np.random.Generator, world: World, family: SceneFamily) -> Push:
    """A line towards one object, preferably one with others behind it."""
    at = world.positions()[:, :2]
    goal = at[int(rng.integers(len(at)))]
    others = at[np.linalg.norm(at - goal, axis=1) > 1e-6]
    if len(others) and rng.uniform() < 0.7:
        near = others[np.argsort(np.linalg.norm(others - goal, axis=1))[: min(3, len(others))]]
        towards = near[int(rng.integers(len(near)))] - goal
        angle = float(np.arctan2(towards[1], towards[0]) + rng.normal(0, 0.25))
    else:
        angle = float(rng.uniform(0, 2 * np.pi))
    direction = np.array([np.cos(angle), np.sin(angle)])
    length = family.push_speed * PUSH * family.action_seconds
    aim = goal + rng.uniform(-0.02, 0.02, 2)
    start = aim - direction * float(rng.uniform(0.07, 0.13))
    end = start + direction * length
    return Push((float(start[0]), float(start[1])), (float(end[0]), float(end[1])), family.action_seconds)


def choose_push(rng: np.random.Generator, world: World, family: SceneFamily) -> Push:
    """A push that moves something, chosen by simulating candidates; the world is left as it was.

    The first candidate wins that moves `family.min_moved` objects; else the one that moves most. None may
    drop an object, leave one in motion or knock one over where another choice exists.

    Raises
    ------
    InputError
        If no candidate moves any object.
    """
    saved = world.save()
    best: tuple[float, Push] | None = None
    for _ in range(4 * family.n_candidates):
        push = _candidate(rng, world, family)
        if not _clear(world, push.start):
            continue
        result = play(world, push, family)
        world.restore(saved)
        if not (result.kept and result.settled):
            continue
        count = result.moved(family.move_threshold)
        toppled = int((result.turned > np.deg2rad(75)).sum())
        if count == 0:
            continue
        if count >= family.min_moved and toppled == 0:
            return push
        score = min(count, family.min_moved) - 0.7 * toppled
        if best is None or score > best[0]:
            best = (score, push)
    if best is None:
        raise InputError(
            f"scene family {family.name!r}: no push of {4 * family.n_candidates} tried moves an object "
            f"by more than {family.move_threshold} m without dropping one",
            "lower move_threshold, or raise push_speed, the length of an action or n_candidates",
        )
    return best[1]
