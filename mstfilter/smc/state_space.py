"""State-space models written as densities and samplers, and the components made from them.

>>> model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
>>> filter = bootstrap(model, n=1000)
>>> state, infos = filter.run(observations, seed=0)

The first observation updates the initial state before any prediction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.smc.interfaces import Proposal, Resampler, Transition, Trigger
from mstfilter.smc.particle_filter import ParticleFilter
from mstfilter.smc.population import Population
from mstfilter.smc.resampling import EssBelow, Systematic
from mstfilter.smc.updates import Reweight

__all__ = ["Dynamics", "Prior", "StateSpaceModel", "bootstrap", "linear_gaussian"]


@dataclass(frozen=True)
class StateSpaceModel:
    """A hidden Markov model on any state space.

    Parameters
    ----------
    sample_initial : callable
        ``(rng, n) -> particles`` draws x_0.
    sample_transition : callable
        ``(rng, particles) -> particles`` draws x_t given x_{t-1}.
    log_likelihood : callable
        ``(particles, y) -> (n,)`` log p(y_t | x_t).
    """

    sample_initial: Callable[[np.random.Generator, int], Any]
    sample_transition: Callable[[np.random.Generator, Any], Any]
    log_likelihood: Callable[[Any, Any], np.ndarray]


@dataclass(frozen=True)
class Prior(Proposal):
    """Draws of the initial state of a model."""

    model: StateSpaceModel

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Draw `n`."""
        return Population(self.model.sample_initial(rng, n))


@dataclass(frozen=True)
class Dynamics(Transition):
    """Moves by the model's own transition."""

    model: StateSpaceModel

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Move all particles; weights stay."""
        return Population(
            self.model.sample_transition(rng, population.particles),
            population.log_weights,
            population.parents,
        )


def bootstrap(
    model: StateSpaceModel,
    n: int,
    resampler: Resampler | None = None,
    trigger: Trigger | None = None,
) -> ParticleFilter:
    """The bootstrap filter of a model (Gordon, Salmond, Smith 1993) with `n` particles."""
    return ParticleFilter(
        initial=Prior(model),
        transition=Dynamics(model),
        update=Reweight(model.log_likelihood),
        resampler=resampler if resampler is not None else Systematic(),
        trigger=trigger if trigger is not None else EssBelow(0.5),
        n=n,
        resample="before",
    )


def linear_gaussian(F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = F x_{t-1} + N(0, Q), y_t = H x_t + N(0, R); particles are (n, d)."""
    F, Q, H, R, m0, P0 = (np.asarray(a, dtype=np.float64) for a in (F, Q, H, R, m0, P0))
    root_Q, root_P = np.linalg.cholesky(Q), np.linalg.cholesky(P0)
    whiten = np.linalg.inv(np.linalg.cholesky(R))
    constant = np.log(np.diag(whiten)).sum() - 0.5 * len(R) * np.log(2 * np.pi)

    def initial(rng: np.random.Generator, n: int) -> np.ndarray:
        return m0 + rng.standard_normal((n, len(m0))) @ root_P.T

    def transition(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
        return x @ F.T + rng.standard_normal(x.shape) @ root_Q.T

    def log_likelihood(x: np.ndarray, y: Any) -> np.ndarray:
        residual = (np.atleast_1d(y) - x @ H.T) @ whiten.T
        return constant - 0.5 * np.einsum("ij,ij->i", residual, residual)

    return StateSpaceModel(initial, transition, log_likelihood)
