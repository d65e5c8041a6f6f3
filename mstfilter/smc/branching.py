"""A transition that moves every particle several times: more candidates than places.

>>> filter = replace(
...     bootstrap(model, n=50),
...     transition=Branching(Dynamics(model), branches=4),
...     resampler=FearnheadClifford(),
...     trigger=Never(),           # 200 candidates are more than 50 places: these are always selected from
...     resample="after",
... )

Schemes without duplicates (Fearnhead-Clifford, k-DPP, coalescing) need something to choose from: asked for n of n
particles they keep all, and the filter degenerates. With discrete states and all successors as branches this is the
filter for which optimal resampling was made (Fearnhead and Clifford 2003).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.smc.fields import part, whole
from mstfilter.smc.interfaces import Transition
from mstfilter.smc.population import Population

__all__ = ["Branching"]


@dataclass(frozen=True)
class Branching(Transition):
    """Moves `branches` copies of every particle, independently; the mean weight and with it the evidence stay.

    Parameters
    ----------
    inner : Transition
        Moves.
    branches : int
        Candidates of each particle, side by side in the result.
    """

    inner: Transition
    branches: int = 4

    def __post_init__(self) -> None:
        part("inner", self.inner, Transition)
        whole("branches", self.branches)

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """As the transition inside."""
        return self.inner.properly_weighted

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """(n * branches) candidates, parents as those of the copies."""
        index = np.repeat(np.arange(len(population)), self.branches)
        copies = population.realised().take(index)
        moved = self.inner.predict(rng, copies.labelled({**copies.parents, "previous": index}), observation)
        if "previous" in moved.parents or len(moved) != len(index):
            return moved
        return moved.labelled({**moved.parents, "previous": index}, moved.notes)
