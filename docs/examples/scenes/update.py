"""An update of scenes: how the last image of a clip changes hypotheses and their weights.

mstfilter check ./update.py:MyUpdate
mstfilter run demo/recording update=./update.py:MyUpdate --out runs/mine --replace
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.mst.segmentation import ObjectRule
from mstfilter.mst.testing import scene_example
from mstfilter.scene import Clip, project
from mstfilter.smc import Population, Update, union


@dataclass(frozen=True)
class MyUpdate(Update):
    """Weights tracked and new hypotheses by how well they cover the object pixels of the last image.

    Fields need an annotation and a default.

    Parameters
    ----------
    strength : float
        Log weight, in nats, of a hypothesis that covers all object pixels and no other pixel.
    """

    strength: float = 20.0

    # The weights are a score, not a likelihood.
    properly_weighted = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Clip,
    ) -> Population:
        """The result may have any number of particles; `predicted` or `proposed` may be None, but not both."""
        population = union(predicted, proposed)
        frame = observation.after
        seen = ObjectRule().foreground(frame, observation.grid).pixels  # (H, W) bool
        scores = []
        for hypothesis in population.particles:
            covered = project(hypothesis, frame.camera) > 0
            scores.append((covered & seen).sum() / max(1, (covered | seen).sum()))
        return population.reweighted(self.strength * np.array(scores))


#: Input for the contract: hypotheses of a scene, and a clip.
example = scene_example
