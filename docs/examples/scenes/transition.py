"""A transition of scenes: how hypotheses move from one pause to the next.

mstfilter check ./transition.py:MyTransition
mstfilter run demo/recording transition=./transition.py:MyTransition --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mstfilter.mst.testing import scene_example
from mstfilter.mst.tracking import TrackingTransition
from mstfilter.smc import Population, Transition, child


@dataclass(frozen=True)
class MyTransition(Transition):
    """Tracks all objects, then shifts each one at random. Fields need an annotation and a default.

    Parameters
    ----------
    spread : int
        Largest shift along x and along y, in voxels.
    tracking : Transition
        The transition that the shifts are added to.
    """

    spread: int = 1
    tracking: Transition = field(default_factory=TrackingTransition)

    # True only if the weights of the result are those of an exact filter.
    properly_weighted = False

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Move all hypotheses; `observation` is the clip that ends at the new pause, or None if it is missing."""
        moved = population if observation is None else self.tracking.predict(rng, population, observation)
        hypotheses = []
        for k, hypothesis in enumerate(moved.particles):
            # A stream for each particle: its numbers do not depend on the other particles.
            stream = child(rng, "shift", k)
            labels = np.zeros_like(hypothesis.labels)
            for record in hypothesis.objects:
                shift = stream.integers(-self.spread, self.spread + 1, size=2)
                voxels = np.argwhere(hypothesis.mask(record.label)) + [*shift, 0]
                voxels = voxels[hypothesis.grid.contains(voxels)]
                labels[tuple(voxels.T)] = record.label
            hypotheses.append(hypothesis.with_labels(labels))  # keeps the identity of the objects
        return Population(tuple(hypotheses), moved.log_weights, moved.parents)


#: Input for the contract: hypotheses of a scene, and a clip.
example = scene_example
