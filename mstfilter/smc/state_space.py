"""State-space models written as samplers and densities, and the components made from them.

>>> model = StateSpaceModel.of(
...     initial=Normal(0.0, 1.0),
...     transition=lambda x: Normal(0.9 * x, 0.5),
...     observation=lambda x: Normal(x, 1.0),
... )
>>> state, infos = bootstrap(model, n=1000).run(observations, seed=0)

The first observation updates the initial state before any prediction. A guided proposal q(x_t | x_{t-1}, y_t) is a
function of x_{t-1} and y_t that returns a distribution; `GuidedTransition` makes a transition of it, which draws from
q and adds log f - log q to the log weights:

>>> filter = guided(model, lambda x, y: Normal(0.5 * (0.9 * x + y), 0.4), n=100)

`guided` and the other filters (`auxiliary`, `resample_move`) are in `mstfilter.smc.filters`, all the same driver with
other parts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.adapters import as_distribution
from mstfilter.smc.interfaces import DensityTransition, Proposal, Resampler, Trigger
from mstfilter.smc.particle_filter import ParticleFilter
from mstfilter.smc.population import Population
from mstfilter.smc.resampling import EssBelow, Systematic
from mstfilter.smc.updates import Reweight, n_of

__all__ = [
    "Dynamics",
    "GuidedInitial",
    "GuidedTransition",
    "Prior",
    "StateSpaceModel",
    "bootstrap",
    "linear_gaussian",
]


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
    log_initial : callable, optional
        ``(particles) -> (n,)`` log p(x_0). Guided filters and moves need it.
    log_transition : callable, optional
        ``(previous, new) -> (n,)`` log f(x_t | x_{t-1}) of paired rows. Guided filters and moves need it.
    """

    sample_initial: Callable[[np.random.Generator, int], Any]
    sample_transition: Callable[[np.random.Generator, Any], Any]
    log_likelihood: Callable[[Any, Any], np.ndarray]
    log_initial: Callable[[Any], np.ndarray] | None = None
    log_transition: Callable[[Any, Any], np.ndarray] | None = None

    @classmethod
    def of(cls, initial: Any, transition: Callable[[Any], Any], observation: Callable[[Any], Any]) -> StateSpaceModel:
        """A model from distributions: ours, frozen ones of scipy.stats, or those of torch.

        Parameters
        ----------
        initial : distribution
            Of x_0.
        transition : callable
            ``(particles) -> distribution`` of x_t, one row a particle.
        observation : callable
            ``(particles) -> distribution`` of y_t.
        """
        first = as_distribution(initial)
        for name, function in (("transition", transition), ("observation", observation)):
            if not callable(function):
                raise InputError(
                    f"{name} is {function!r}, expected a function of the particles that returns a distribution"
                )
        return cls(
            first.sample,
            lambda rng, x: as_distribution(transition(x)).sample(rng, n_of(x)),
            lambda x, y: as_distribution(observation(x)).log_prob(y),
            first.log_prob,
            lambda previous, new: as_distribution(transition(previous)).log_prob(new),
        )

    def density(self, which: str) -> Callable[..., np.ndarray]:
        """``log_initial`` or ``log_transition``.

        Raises
        ------
        InputError
            Where the model was made without it.
        """
        found = self.log_initial if which == "log_initial" else self.log_transition
        if found is None:
            raise InputError(f"the model has no {which}", "give StateSpaceModel its log densities, or use .of()")
        return found


@dataclass(frozen=True)
class Prior(Proposal):
    """Draws of the initial state of a model."""

    model: StateSpaceModel

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Draw `n`."""
        return Population(self.model.sample_initial(rng, n))


@dataclass(frozen=True)
class Dynamics(DensityTransition):
    """Moves by the model's own transition."""

    model: StateSpaceModel

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Move all particles; weights stay."""
        return population.moved(self.model.sample_transition(rng, population.particles))

    def log_prob(self, previous: Any, new: Any, observation: Any) -> np.ndarray:
        """Log density of the model's transition."""
        return self.model.density("log_transition")(previous, new)


@dataclass(frozen=True)
class GuidedInitial(Proposal):
    """First particles from q(x_0 | y_0), weighted by p(x_0) / q.

    Parameters
    ----------
    model : StateSpaceModel
        With `log_initial`.
    proposal : callable
        ``(y) -> distribution`` of x_0.
    """

    model: StateSpaceModel
    proposal: Callable[[Any], Any]

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """Draw `n`; from the prior where the observation is missing."""
        if observation is None:
            return Population(self.model.sample_initial(rng, n))
        q = as_distribution(self.proposal(observation))
        x = q.sample(rng, n)
        return Population(x, self.model.density("log_initial")(x) - q.log_prob(x))


@dataclass(frozen=True)
class GuidedTransition(DensityTransition):
    """Moves by q(x_t | x_{t-1}, y_t) and adds log f - log q to the log weights.

    Parameters
    ----------
    model : StateSpaceModel
        With `log_transition`.
    proposal : callable
        ``(particles, y) -> distribution`` of x_t, one row a particle. Its tails must not be lighter than those of
        f(x_t | x_{t-1}) p(y_t | x_t).
    """

    model: StateSpaceModel
    proposal: Callable[[Any, Any], Any]

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Move all particles; by the model's own transition where the observation is missing."""
        old = population.particles
        if observation is None:
            return population.moved(self.model.sample_transition(rng, old))
        q = as_distribution(self.proposal(old, observation))
        new = q.sample(rng, len(population))
        gain = self.model.density("log_transition")(old, new) - q.log_prob(new)
        return Population(new, population.log_weights + gain, population.parents)

    def log_prob(self, previous: Any, new: Any, observation: Any) -> np.ndarray:
        """Log density of the move that is made: q, or f where the observation is missing."""
        if observation is None:
            return self.model.density("log_transition")(previous, new)
        return as_distribution(self.proposal(previous, observation)).log_prob(new)


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
    if m0.ndim != 1:
        raise InputError(f"m0 has shape {m0.shape}, expected one number an entry of the state: (d,)")
    d, k = m0.shape, H.shape[:1]
    shapes = {"F": (F, d * 2), "Q": (Q, d * 2), "H": (H, k + d), "R": (R, k * 2), "m0": (m0, d), "P0": (P0, d * 2)}
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise InputError(f"{name} has shape {array.shape}, expected {shape} as m0 has {d[0]} entries")
    for name, cov in (("Q", Q), ("R", R), ("P0", P0)):
        if not np.allclose(cov, cov.T) or not (np.linalg.eigvalsh(cov) > 0).all():
            raise InputError(f"{name} is {cov.tolist()}, expected a covariance: symmetric and positive definite")
    root_Q, root_P = np.linalg.cholesky(Q), np.linalg.cholesky(P0)

    def log_normal(cov: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        whiten = np.linalg.inv(np.linalg.cholesky(cov))
        constant = np.log(np.diag(whiten)).sum() - 0.5 * len(cov) * np.log(2 * np.pi)

        def of(residual: np.ndarray) -> np.ndarray:
            z = residual @ whiten.T
            return constant - 0.5 * np.einsum("ij,ij->i", z, z)

        return of

    def initial(rng: np.random.Generator, n: int) -> np.ndarray:
        return m0 + rng.standard_normal((n, len(m0))) @ root_P.T

    def transition(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
        return x @ F.T + rng.standard_normal(x.shape) @ root_Q.T

    of_R, of_P, of_Q = log_normal(R), log_normal(P0), log_normal(Q)
    return StateSpaceModel(
        initial,
        transition,
        lambda x, y: of_R(np.atleast_1d(y) - x @ H.T),
        lambda x: of_P(x - m0),
        lambda old, new: of_Q(new - old @ F.T),
    )
