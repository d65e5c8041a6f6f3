"""Diverse selection without chance: the set that looks best to a greedy eye.

>>> import numpy as np
>>> from mstfilter.smc.population import Population
>>> from mstfilter.smc.similarity import Gaussian
>>> twins = Population(np.array([0.0, 0.01, 5.0]), np.log([4.0, 3.0, 1.0]))
>>> chosen = GreedyDiverse(Gaussian(1.0)).resample(np.random.default_rng(0), twins, 2)
>>> chosen.particles, chosen.weights.round(3)
(array([0., 5.]), array([0.875, 0.125]))

Not properly weighted: what is never chosen is lost, and its weight moves to a neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import part
from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.population import Population
from mstfilter.smc.resampling import checked_weights
from mstfilter.smc.resampling_dpp import checked_similarity
from mstfilter.smc.similarity import Gaussian, Similarity

__all__ = ["GreedyDiverse"]


@dataclass(frozen=True)
class GreedyDiverse(Resampler):
    """Adds, one after the other, the particle that raises det L of the chosen set most (as a k-DPP would like it).

    The first is the heaviest; each next one maximises w_i times what is left of it after projection on the chosen
    ones. The weight of a particle that is not chosen goes to the chosen one most similar to it, so the total
    stays. Where nothing different is left, the heaviest of the rest follow. (Chen, Zhang, Zhou 2018, "Fast greedy
    MAP inference for determinantal point process".)

    Parameters
    ----------
    similarity : Similarity
        How alike particles are.
    """

    similarity: Similarity = Gaussian()  # noqa: RUF009 (frozen)

    properly_weighted: ClassVar[bool] = False
    exact_size: ClassVar[bool] = False

    def __post_init__(self) -> None:
        part("similarity", self.similarity, Similarity)

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Not possible without the particles."""
        raise InputError("a diverse selection looks at the particles, and select sees only weights", "call resample")

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Select; draws nothing."""
        weights = checked_weights(population.log_weights, n)
        population = population.realised()
        S = checked_similarity(self.similarity, population)
        n = min(n, int((weights > 0).sum()))
        gain = weights * np.diag(S)
        rows, items = np.zeros((len(weights), n)), np.empty(n, np.int64)
        for step in range(n):
            i = int(np.argmax(gain))
            if gain[i] <= 1e-12 * weights.max():  # all that is left resembles the chosen ones
                rest = weights.copy()
                rest[items[:step]] = 0.0
                items[step:] = np.argsort(-rest, kind="stable")[: n - step]
                break
            items[step] = i
            root = np.sqrt(weights[i] * weights)
            rows[:, step] = (root * S[i] - rows[:, :step] @ rows[i, :step]) / np.sqrt(gain[i])
            gain = np.maximum(gain - rows[:, step] ** 2, 0.0)
            gain[items[: step + 1]] = 0.0
        items = np.sort(items)
        nearest = np.argmax(S[:, items], axis=1)
        nearest[items] = np.arange(n)
        mass = np.bincount(nearest, weights, minlength=n)
        log_weights = np.log(mass) + population.log_weights.max() + np.log(n / len(weights))
        chosen = population.take(items, log_weights)
        return replace(chosen, parents={**chosen.parents, "ancestor": items})
