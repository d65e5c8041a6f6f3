"""Moves that spread duplicates out without changing the law: resample-move.

>>> filter = resample_move(model, RandomWalkMove(model, scale=0.5), n=100)

After a resampling several particles share a parent. At the end of the step each is moved by a Markov kernel that
leaves p(x_t | x_{t-1}, y_t) invariant; weights stay (Gilks and Berzuini 2001). The kernel must know the observation,
which is why the driver calls it at the end of the step and not beside the resampler.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import part, whole
from mstfilter.smc.interfaces import Rejuvenation
from mstfilter.smc.population import Particles, Population
from mstfilter.smc.state_space import StateSpaceModel

__all__ = ["RandomWalkMove", "accept"]


def accept(rng: np.random.Generator, log_ratio: np.ndarray) -> np.ndarray:
    """(n,) bool: Metropolis-Hastings decisions; a ratio that is NaN (impossible to impossible) is refused."""
    return np.log1p(-rng.random(len(log_ratio))) < log_ratio


def choose(accepted: np.ndarray, new: Particles, old: Particles) -> Particles:
    """Row by row `new` where accepted, else `old`."""
    if isinstance(old, np.ndarray):
        return np.where(accepted.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
    return {name: choose(accepted, new[name], a) for name, a in old.items()}


@dataclass(frozen=True)
class RandomWalkMove(Rejuvenation):
    """Metropolis steps with Gaussian increments on an array of particles.

    Parameters
    ----------
    model : StateSpaceModel
        With its log densities. Particles are floating-point arrays (n,) or (n, d), or mappings of such.
    scale : float or array_like
        Standard deviation of a step, in the units of the state. Fixed, so that the evidence stays unbiased.
    steps : int
        Metropolis steps a move.
    """

    model: StateSpaceModel
    scale: Any = 1.0
    steps: int = 1

    def __post_init__(self) -> None:
        part("model", self.model, StateSpaceModel)
        whole("steps", self.steps)
        scale = np.asarray(self.scale, dtype=np.float64)
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise InputError(f"scale is {self.scale!r}, expected positive finite numbers")

    def move(
        self,
        rng: np.random.Generator,
        population: Population,
        previous: Population | None,
        observation: Any,
    ) -> Population:
        """Move; `notes` hold the share of accepted steps."""

        def log_target(x: Any) -> np.ndarray:
            if previous is None:
                prior = self.model.density("log_initial")(x)
            else:
                prior = self.model.density("log_transition")(previous.particles, x)
            return prior if observation is None else prior + self.model.log_likelihood(x, observation)

        x, taken = population.particles, 0
        current = log_target(x)
        for _ in range(self.steps):
            new = self._step(rng, x)
            proposed = log_target(new)
            with np.errstate(invalid="ignore"):
                yes = accept(rng, proposed - current)
            x, current = choose(yes, new, x), np.where(yes, proposed, current)
            taken += int(yes.sum())
        share = taken / (self.steps * len(population))
        return Population(x, population.log_weights, population.parents, {"accepted": share})

    def _step(self, rng: np.random.Generator, x: Particles) -> Particles:
        if isinstance(x, np.ndarray):
            return x + self.scale * rng.standard_normal(x.shape)
        return {name: self._step(rng, a) for name, a in x.items()}
