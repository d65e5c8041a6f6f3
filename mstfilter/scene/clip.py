"""The observation of a step: the frames from one pause of the robot to the next.

``clip.before`` shows the scene at the previous pause, ``clip.after`` at this one; the frames between show the
action. The first clip of a recording has one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mstfilter.errors import InputError
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
    """

    frames: Sequence[Frame]
    grid: VoxelGrid
    index: int = 0
    times: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.frames) == 0:
            raise InputError(f"clip {self.index} has no frames")
        if self.times and len(self.times) != len(self.frames):
            raise InputError(f"clip {self.index} has {len(self.frames)} frames and {len(self.times)} times")

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
