"""The authors' own real particles (experiment R1 of the paper), in the folder MSTFILTER_SHARED or ``../shared``.

The particles are Copyright (c) 2020 The Autonomous Robotic Manipulation Lab, MIT licence (results/LICENSE-R1). They
are not part of this package.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mstfilter.scene import Hypothesis, VoxelGrid

REPOSITORY = Path(__file__).resolve().parents[2]


def folder() -> Path | None:
    """Folder of the data; None if they are missing."""
    named = os.environ.get("MSTFILTER_SHARED")
    path = (Path(named) if named else REPOSITORY.parent / "shared") / "r1"
    return path if (path / "measurement.npz").exists() else None


@dataclass(frozen=True)
class Particles:
    """R1 at t = 1: samples and predictions of the authors' program.

    Parameters
    ----------
    path : Path
        The folder of the data.
    """

    path: Path

    def _load(self, name: str, key: str) -> np.ndarray:
        with np.load(self.path / f"{name}.npz", allow_pickle=False) as data:
            return data[key]

    @cached_property
    def grid(self) -> VoxelGrid:
        """The grid, with voxels of 1 cm."""
        return VoxelGrid(self._load("measurement", "region_min"), 0.01, (61, 61, 41))

    def _hypotheses(self, labels: np.ndarray, birth: int) -> tuple[Hypothesis, ...]:
        return tuple(Hypothesis.from_labels(one, self.grid, birth) for one in labels)

    @cached_property
    def samples(self) -> tuple[Hypothesis, ...]:
        """The five samples at t = 1 (of ten) that the authors fused."""
        return self._hypotheses(self._load("measurement", "labels")[1, :5], 1)

    @cached_property
    def predictions(self) -> tuple[Hypothesis, ...]:
        """Five hypotheses at t = 0, moved to t = 1 and without voxels in free space."""
        return self._hypotheses(self._load("freespace_refined", "labels")[0], 0)


NOTICE = "Particles: Copyright (c) 2020 The Autonomous Robotic Manipulation Lab, MIT licence."
