"""The observation of a step: the frames from one pause of the robot to the next.

``clip.before`` shows the scene at the previous pause, ``clip.after`` at this one; the frames between show the
action. The first clip of a recording has one frame. ``clip.previous`` is the clip before, for components that
remember what was seen: a component holds no state, so the past comes with the observation, and a run that is resumed
sees the same past.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from mstfilter.errors import InputError
from mstfilter.scene.arrays import content_key
from mstfilter.scene.frame import Frame
from mstfilter.scene.voxels import VoxelGrid

__all__ = ["Clip"]


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames from one pause to the next, and the workspace in which they are understood.

    Parameters
    ----------
    frames : sequence of Frame
        In time order, first and last at rest. A lazy sequence is kept as it is.
    grid : VoxelGrid
        The workspace.
    index : int
        Number of the pause that the clip ends at; 0 is the first.
    times : tuple of float, optional
        Seconds, one a frame.
    previous : Clip, optional
        The clip that ended at the previous pause; None at the first, or where the past is not known.
    """

    frames: Sequence[Frame]
    grid: VoxelGrid
    index: int = 0
    times: tuple[float, ...] = ()
    previous: Clip | None = None

    def __post_init__(self) -> None:
        if len(self.frames) == 0:
            raise InputError(f"clip {self.index} has no frames")
        if self.times and len(self.times) != len(self.frames):
            raise InputError(f"clip {self.index} has {len(self.frames)} frames and {len(self.times)} times")
        if self.previous is not None and self.previous.grid != self.grid:
            raise InputError(f"clip {self.index} and the one before it have different grids")

    @cached_property
    def frames_key(self) -> bytes:
        """Name by content of all frames and the grid. Looks at every image once."""
        return content_key("frames", self.grid.key, *(frame.key for frame in self.frames))

    @cached_property
    def key(self) -> bytes:
        """Name by content of this clip and everything before. Looks at every image once."""
        chain: list[Clip] = []
        clip: Clip | None = self
        while clip is not None and "key" not in clip.__dict__:
            chain.append(clip)
            clip = clip.previous
        key = b"" if clip is None else clip.key
        for clip in reversed(chain):  # not by recursion: a recording may have a thousand pauses
            key = content_key("clip", key, clip.frames_key)
            clip.__dict__["key"] = key
        return key

    @property
    def before(self) -> Frame:
        """The frame at the previous pause."""
        return self.frames[0]

    @property
    def after(self) -> Frame:
        """The frame at this pause."""
        return self.frames[-1]

    def __len__(self) -> int:
        return len(self.frames)
