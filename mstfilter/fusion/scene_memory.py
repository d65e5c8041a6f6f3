"""What was seen to be free at earlier pauses, and where nothing has moved since.

>>> FreeSpace(memory=SceneMemory(keep=1.0))          # never forget
>>> FreeSpace(memory=SceneMemory(keep=0.8))          # for three pauses
>>> FreeSpace()                                      # no memory: the last image alone

Free space belongs to places, not to objects, so it stays known only while nothing has moved there. A voxel is
remembered while it is hidden (behind a surface, in a hole of the depth image, behind the robot); what is seen now
always outweighs memory, whether free or occupied. Memory is lost within reach of every surface that any image since
the last pause has shown to move: where a thing was and is not, or is and was not.

A component holds no state, so memory is made anew from the clips that came before (`Clip.previous`), each of which
is looked at once and kept by content: a run that is resumed remembers the same. What this cannot know: a thing that
moved out of sight all the time, further than the reach from all that was seen to move. `keep` bounds for how long
such an error lasts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import floor, log

import numpy as np
from scipy import ndimage

from mstfilter.errors import InputError
from mstfilter.scene import Clip, Frame, VoxelGrid, memo, read_only

__all__ = ["SceneMemory", "Seen"]

_NEVER = 255  # of ages: not known to be free
_BLOCK = 100  # pauses
_SMALLEST = 4  # voxels that a moving surface has at least: fewer are flicker at an edge


@dataclass(frozen=True, eq=False)
class Seen:
    """What all cameras of one instant say about every voxel.

    Parameters
    ----------
    free : (X, Y, Z) bool
        Looked through by at least one, and measured by none.
    hit : (X, Y, Z) bool
        A measured point lies inside (above the table).
    hidden : (X, Y, Z) bool
        Every camera has a surface well before it, or no reading.
    """

    free: np.ndarray
    hit: np.ndarray
    hidden: np.ndarray


Look = Callable[[Frame, VoxelGrid], Seen]


@dataclass(frozen=True)
class SceneMemory:
    """For how long, and where, a voxel that was seen to be free still counts as free.

    Parameters
    ----------
    keep : float
        Share of the belief that is left after each pause at which the voxel is hidden. It counts as free while at
        least half is left. 0 remembers nothing, 1 never forgets.
    reach : float
        Metres around every moved surface in which memory is lost: how much of a moving thing may be out of sight.
    """

    keep: float = 0.0
    reach: float = 0.1

    def __post_init__(self) -> None:
        if not (0 <= self.keep <= 1 and np.isfinite(self.reach) and self.reach >= 0):
            raise InputError(
                f"scene memory has keep {self.keep} and reach {self.reach}, expected a share from 0 to 1 and "
                "metres >= 0"
            )

    @property
    def pauses(self) -> int:
        """At how many pauses in a row a voxel may be hidden and still counts as free."""
        if self.keep in (0.0, 1.0):
            return 0 if self.keep == 0 else _NEVER - 1
        return min(floor(log(0.5) / log(self.keep) + 1e-9), _NEVER - 1)

    def free(self, look: Look, key: bytes, clip: Clip) -> np.ndarray:
        """(X, Y, Z) bool on the clip's grid: free at the end of a clip, as seen or as remembered.

        Parameters
        ----------
        look : callable
            What a frame says of every voxel.
        key : bytes
            Names what `look` does.
        clip : Clip
            With those before it.
        """
        seen = look(clip.after, clip.grid)
        if self.pauses == 0:
            return seen.free
        past: list[Clip] = []
        earlier: Clip | None = clip
        while earlier is not None:
            past.append(earlier)
            earlier = earlier.previous
        for earlier in past[::-1][::_BLOCK]:  # oldest first: then no recursion is deep
            self._ages(look, key, earlier)
        return seen.free | (seen.hidden & (self._ages(look, key, clip) <= self.pauses))

    def _ages(self, look: Look, key: bytes, clip: Clip) -> np.ndarray:
        """(X, Y, Z) uint8: how many pauses ago a voxel was last seen to be free; `_NEVER` where that says nothing."""
        name = (clip.key, key, self.reach)
        return memo("scene memory", name, lambda: read_only(self._aged(look, key, clip)))

    def _aged(self, look: Look, key: bytes, clip: Clip) -> np.ndarray:
        if clip.previous is None:
            old = np.where(look(clip.before, clip.grid).free, 0, _NEVER)
        else:
            old = self._ages(look, key, clip.previous)
        seen = look(clip.after, clip.grid)
        stays = seen.hidden & (old < _NEVER)
        if stays.any():
            stays &= ~self._disturbed(look, clip, old < _NEVER)
        ages = np.full(clip.grid.shape, _NEVER, np.uint8)
        ages[stays] = np.minimum(old[stays] + 1, _NEVER - 1)
        ages[seen.free] = 0
        return ages

    def _disturbed(self, look: Look, clip: Clip, known: np.ndarray) -> np.ndarray:
        """(X, Y, Z) bool: voxels within reach of what moved since the previous pause, when `known` ones were free."""
        past = clip.before if clip.previous is None else clip.previous.after
        hit = look(past, clip.grid).hit
        moved = np.zeros(clip.grid.shape, bool)
        for frame in clip.frames:
            now = look(frame, clip.grid)
            moved |= _surfaces((now.hit & known) | (hit & now.free))
        if not moved.any():
            return moved
        distance = ndimage.distance_transform_edt(~moved, sampling=clip.grid.voxel_size)
        return np.asarray(distance <= self.reach)


def _surfaces(voxels: np.ndarray) -> np.ndarray:
    """Voxels (X, Y, Z) without groups that are too small to be a thing."""
    groups, n = ndimage.label(voxels, np.ones((3, 3, 3)))
    if n == 0:
        return voxels
    large = np.bincount(groups.ravel()) >= _SMALLEST
    large[0] = False
    return np.asarray(large[groups])
