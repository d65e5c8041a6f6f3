"""The world as it is shown: poses that follow physics but not its trembling.

Bodies at rest creep and tremble by micrometres between frames, as soft contacts do. What is shown keeps a pose
until some point of the body is more than a tolerance away from it. Pictures, poses and volumes are all taken
from what is shown, so they agree exactly; and a body that is shown in the same place need not be drawn again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.simulation.bounds import Bounds
from mstfilter.simulation.world import FINGER_ID, World, cast

__all__ = ["Stage"]


class Stage:
    """What a camera sees of a world.

    Parameters
    ----------
    world : World
        Followed; never changed.
    tolerance : float
        Metres by which what is shown may lag behind. 0: it never does.
    """

    def __init__(self, world: World, tolerance: float = 0.0) -> None:
        self.world, self.tolerance = world, tolerance
        self._mj, self._data = world.another_data()
        self._radius = np.array([shape.radius for shape in world.shapes])
        # Every object lies in a capsule along its longest edge.
        half = np.array([shape.half for shape in world.shapes])
        longest = half.argmax(axis=1)
        long = half.max(axis=1)
        across = np.sqrt((half**2).sum(axis=1) - long**2)
        inward = np.minimum(0.35 * across, long)
        self._axis = np.eye(3)[longest] * (long - inward)[:, None]
        self._thick = np.hypot(across, inward)
        self._poses = world.poses()
        self._finger = world.finger_position()
        self._show(world.data.qpos)

    def _show(self, qpos: np.ndarray) -> None:
        self._data.qpos[:] = qpos
        self._mj.mj_kinematics(self.world.model, self._data)

    def follow(self) -> None:
        """Catch up with the world. Following a second time changes nothing."""
        world = self.world
        now, finger = world.poses(), world.finger_position()
        shift = np.linalg.norm(now[:, :3, 3] - self._poses[:, :3, 3], axis=1)
        turn = np.linalg.norm(now[:, :3, :3] - self._poses[:, :3, :3], axis=(1, 2))
        gone = shift + turn * self._radius > self.tolerance
        if not gone.any() and (finger == self._finger).all():
            return
        self._poses = np.where(gone[:, None, None], now, self._poses)
        self._finger = finger
        qpos = self._data.qpos.copy()
        qpos[:3] = finger
        for k in np.flatnonzero(gone):
            at = world.qpos_of(int(k))
            qpos[at] = world.data.qpos[at]
        self._show(qpos)

    @property
    def poses(self) -> np.ndarray:
        """(n, 4, 4) T_world_object as shown."""
        return self._poses.copy()

    def key(self) -> np.ndarray:
        """(n + 1, 12): place and orientation of every object, then of the finger; equal rows are the same pose."""
        rows = self._poses[:, :3].reshape(len(self._poses), 12)
        return np.concatenate([rows, np.resize(self._finger, (1, 12))])

    def bounds(self) -> tuple[Bounds, np.ndarray]:
        """Capsules around all that is cast shadows by, and the row of `key` that each belongs to."""
        model, data = self.world.model, self._data
        at, axis = self._poses[:, :3, 3], np.einsum("nij,nj->ni", self._poses[:, :3, :3], self._axis)
        limbs = np.flatnonzero(self.world.geom_object == FINGER_ID)
        # Capsules and cylinders alike: both lie in the capsule of their radius and axis.
        limb_axis = data.geom_xmat[limbs].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[limbs, 1:2]
        at, axis = np.concatenate([at, data.geom_xpos[limbs]]), np.concatenate([axis, limb_axis])
        radius = np.concatenate([self._thick, model.geom_size[limbs, 0]]) + 0.002
        rows = np.minimum(np.arange(len(at)), len(self._poses))
        return Bounds(at - axis, at + axis, radius), rows

    def cast(
        self, origin: ArrayLike, directions: np.ndarray, groups: Sequence[int] = (0, 1, 2)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays through what is shown; see `World.cast`."""
        return cast(self.world.model, self._data, origin, directions, groups)
