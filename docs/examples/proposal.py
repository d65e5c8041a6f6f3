"""A proposal: new particles from an observation alone.

mstfilter check ./proposal.py:MyProposal
mstfilter run RECORDING proposal=./proposal.py:MyProposal
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.smc import Population, Proposal


@dataclass(frozen=True)
class MyProposal(Proposal):
    """Particles around the observation. Fields need an annotation and a default.

    Parameters
    ----------
    spread : float
        Standard deviation around the observation, in its units.
    """

    spread: float = 1.0

    # Set to False if the weights are not those of draws from the model (for example heuristic scores).
    properly_weighted = False

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Draw exactly n particles; repeat some if there are fewer different ones."""
        # Random numbers come from rng only.
        centre = np.asarray(observation, dtype=np.float64)
        particles = centre + self.spread * rng.standard_normal((n, *centre.shape))
        # Log weights: 0 for draws from the prior; log prior - log density of the draw if that is known.
        return Population(particles, np.zeros(n))


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Input for the contract: a population (not used here) and an observation."""
    return Population(rng.standard_normal((n, 2))), np.array([0.3, -0.1])
