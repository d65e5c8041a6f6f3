"""A projection onto free space: which voxels of a prediction the last image rules out.

mstfilter check ./free_space.py:MyFreeSpace
mstfilter run demo/recording update.free_space=./free_space.py:MyFreeSpace --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

from mstfilter.scene import Frame, Hypothesis, Projection, frame_geometry


@dataclass(frozen=True)
class MyFreeSpace(Projection):
    """Clears voxels in front of the measured surface. Fields need an annotation and a default.

    Parameters
    ----------
    margin : float
        A voxel is free if its centre is this far in front of the surface, in metres.
    """

    margin: float = 0.01

    def project(self, hypothesis: Hypothesis, frame: Frame) -> tuple[Hypothesis, float]:
        """The hypothesis without the cleared voxels, and the share of voxels that it keeps, in [0, 1]."""
        free = frame_geometry(frame, hypothesis.grid).known_free(self.margin)  # (X, Y, Z) bool
        labels = hypothesis.labels.copy()  # arrays of a hypothesis are read-only
        labels[free] = 0
        n_before = (hypothesis.labels > 0).sum()
        kept = float((labels > 0).sum() / n_before) if n_before else 1.0
        return hypothesis.with_labels(labels), kept
