"""Free space as an update of its own: a manifold-style filter over voxel grids.

>>> filter = ParticleFilter(proposal=None, initial=..., transition=..., update=ProjectionUpdate(), ...)

Where an observation rules out all but a thin set of states, hardly any draw of the dynamics lies in it; a projection
moves every particle there (Koval, Pollard, Srinivasa 2015; for vectors `mstfilter.smc.vectors.ProjectOnto`). Here the
set is that of all scenes with nothing where the sensor looked through, and what the projection costs weighs the
particle. No samples, no crossover: it works for any particle with labels on a grid, and without a proposal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mstfilter.fusion.free_space import SMALLEST_QUALITY, FreeSpace, Projection
from mstfilter.scene import Clip
from mstfilter.smc import Population, Update, number, part, union

__all__ = ["ProjectionUpdate"]


@dataclass(frozen=True)
class ProjectionUpdate(Update):
    """Projects every particle, and adds lambda log Q to its log weight.

    Particles are hypotheses, or any frozen dataclass with fields `labels` and `grid`
    (`mstfilter.fusion.free_space.Voxels`). Proposed particles join the predicted ones.

    Parameters
    ----------
    free_space : Projection
        Onto what.
    quality_exponent : float
        lambda: power of Q, the share of voxels that is kept, in the weight.
    """

    free_space: Projection = FreeSpace()  # noqa: RUF009 (frozen)
    quality_exponent: float = 3.0

    properly_weighted: ClassVar[bool] = False
    draws: ClassVar[bool] = False

    def __post_init__(self) -> None:
        part("free_space", self.free_space, Projection)
        number("quality_exponent", self.quality_exponent, at_least=0)

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """All particles, projected and weighed."""
        population = union(predicted, proposed)
        refined, quality = self.free_space.refine(population.particles, observation)
        log_weights = population.log_weights + self.quality_exponent * np.log(np.maximum(quality, SMALLEST_QUALITY))
        return Population(refined, log_weights, population.parents, {"quality": quality.tolist()})
