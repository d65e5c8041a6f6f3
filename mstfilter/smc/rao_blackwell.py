"""The Rao-Blackwellised filter: part of the state is drawn, the rest is integrated exactly by a Kalman filter.

>>> filter = rao_blackwellised(model, n=100)
>>> state, infos = filter.run(observations, seed=0)
>>> state.population.particles["mean"].shape           # (n, d)

Given the drawn part u_0 .. u_t (a regime, a contact, an association) the state is linear and Gaussian:

    z_t = F(u_t) z_{t-1} + b(u_t) + N(0, Q(u_t)),    y_t = H(u_t) z_t + N(0, R(u_t))

A particle is u with the mean and covariance of z given u_0 .. u_t and y_0 .. y_t: a population that is a mapping of
arrays, moved by a Transition (draw u, predict) and an Update (weigh by p(y_t | u_0 .. u_t, y_0 .. y_{t-1}), correct).
Reference: Doucet, de Freitas, Murphy, Russell (2000).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mstfilter.smc.interfaces import Proposal, Transition, Update
from mstfilter.smc.particle_filter import ParticleFilter
from mstfilter.smc.population import Population
from mstfilter.smc.updates import union

__all__ = ["ConditionallyLinear", "Linear", "rao_blackwellised"]


class Linear(NamedTuple):
    """Matrices of the linear part for each particle; any may leave the particle axis out.

    Parameters
    ----------
    F : (n, d, d) array
    Q : (n, d, d) array
    H : (n, k, d) array
    R : (n, k, k) array
    b : (n, d) array
    """

    F: Any
    Q: Any
    H: Any
    R: Any
    b: Any = 0.0


@dataclass(frozen=True)
class ConditionallyLinear:
    """A model that is linear and Gaussian given a drawn part.

    Parameters
    ----------
    sample_initial : callable
        ``(rng, n) -> u`` (n, ...) draws u_0.
    sample_transition : callable
        ``(rng, u) -> u`` draws u_t given u_{t-1}.
    linear : callable
        ``(u) -> Linear``.
    mean, cov : (d,) and (d, d) array_like
        Of z_0, whatever u_0 is.
    """

    sample_initial: Callable[[np.random.Generator, int], np.ndarray]
    sample_transition: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    linear: Callable[[np.ndarray], Linear]
    mean: Any
    cov: Any


@dataclass(frozen=True)
class _First(Proposal):
    model: ConditionallyLinear

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        """u_0 with the first mean and covariance."""
        mean, cov = np.asarray(self.model.mean, np.float64), np.asarray(self.model.cov, np.float64)
        return Population(
            {
                "u": self.model.sample_initial(rng, n),
                "mean": np.tile(mean, (n, 1)),
                "cov": np.tile(cov, (n, 1, 1)),
            }
        )


@dataclass(frozen=True)
class _Predict(Transition):
    model: ConditionallyLinear

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Draw u_t, then predict mean and covariance."""
        u = self.model.sample_transition(rng, population.particles["u"])
        m = self.model.linear(u)
        F, n = np.asarray(m.F, np.float64), len(population)
        mean = (F @ population.particles["mean"][..., None])[..., 0] + m.b
        cov = F @ population.particles["cov"] @ np.swapaxes(F, -1, -2) + m.Q
        particles = {"u": u, "mean": mean, "cov": np.broadcast_to(cov, (n, *cov.shape[-2:]))}
        return Population(particles, population.log_weights, population.parents)


@dataclass(frozen=True)
class _Correct(Update):
    model: ConditionallyLinear
    draws: ClassVar[bool] = False

    def update(
        self,
        rng: np.random.Generator,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
    ) -> Population:
        """Weigh by the predictive density, then correct mean and covariance (Joseph form)."""
        population = union(predicted, proposed)
        p, y = population.particles, np.atleast_1d(np.asarray(observation, dtype=np.float64))
        m = self.model.linear(p["u"])
        H, R = np.asarray(m.H, np.float64), np.asarray(m.R, np.float64)
        Ht = np.swapaxes(H, -1, -2)
        S = H @ p["cov"] @ Ht + R
        residual = y - (H @ p["mean"][..., None])[..., 0]
        root = np.linalg.cholesky(S)
        z = np.linalg.solve(root, residual[..., None])[..., 0]
        log_det = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        gain = np.swapaxes(np.linalg.solve(S, H @ p["cov"]), -1, -2)
        keep = np.eye(p["mean"].shape[1]) - gain @ H
        cov = keep @ p["cov"] @ np.swapaxes(keep, -1, -2) + gain @ R @ np.swapaxes(gain, -1, -2)
        mean = p["mean"] + (gain @ residual[..., None])[..., 0]
        log_p = -0.5 * (z * z).sum(axis=-1) - log_det - 0.5 * len(y) * np.log(2 * np.pi)
        particles = {"u": p["u"], "mean": mean, "cov": cov}
        return Population(particles, population.log_weights + log_p, population.parents)


def rao_blackwellised(model: ConditionallyLinear, n: int, **parts: Any) -> ParticleFilter:
    """The filter of a model that is linear and Gaussian given a drawn part.

    Parameters
    ----------
    model : ConditionallyLinear
        The model.
    n : int
        Particles.
    **parts
        Further fields of `ParticleFilter`, such as ``resampler``.
    """
    return ParticleFilter(initial=_First(model), transition=_Predict(model), update=_Correct(model), n=n, **parts)
