"""Linear-Gaussian models, and the Rao-Blackwellised filter, which integrates part of the state by Kalman filters.

>>> filter = bootstrap(linear_gaussian(F, Q, H, R, m0, P0), n=1000)
>>> filter = rao_blackwellised(model, n=100)
>>> state, infos = filter.run(observations, seed=0)
>>> state.population.particles["mean"].shape           # (n, d)

In a Rao-Blackwellised filter part of the state, u_t (a regime, a contact, an association), is drawn. Given u_0 .. u_t
the rest is linear and Gaussian:

    z_t = F(u_t) z_{t-1} + b(u_t) + N(0, Q(u_t)),    y_t = H(u_t) z_t + N(0, R(u_t))

A particle holds u with the mean and covariance of z given u_0 .. u_t and y_0 .. y_t. The population is a mapping of
arrays, moved by a Transition (draw u, predict z) and an Update (weight by p(y_t | u_0 .. u_t, y_0 .. y_{t-1}),
correct z). Reference: Doucet, de Freitas, Murphy, Russell (2000).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.interfaces import Proposal, Transition, Update
from mstfilter.smc.population import Population, union
from mstfilter.smc.state_space import StateSpaceModel


def linear_gaussian(F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = F x_{t-1} + N(0, Q), y_t = H x_t + N(0, R); particles are (n, d)."""
    F, Q, H, R, m0, P0 = (np.asarray(a, dtype=np.float64) for a in (F, Q, H, R, m0, P0))
    if m0.ndim != 1:
        raise InputError(f"m0 has shape {m0.shape}, expected one number per entry of the state: (d,)")
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
            return constant - 0.5 * np.einsum("...j,...j->...", z, z)

        return of

    def initial(rng: np.random.Generator, n: int | tuple[int, int]) -> np.ndarray:
        shape = (n,) if isinstance(n, int) else n
        return m0 + rng.standard_normal((*shape, len(m0))) @ root_P.T

    def transition(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
        return x @ F.T + rng.standard_normal(x.shape) @ root_Q.T

    of_R, of_P, of_Q = log_normal(R), log_normal(P0), log_normal(Q)
    return StateSpaceModel(
        initial,
        transition,
        lambda x, y: of_R(np.atleast_1d(y) - x @ H.T),
        lambda x: of_P(x - m0),
        lambda old, new: of_Q(new - old @ F.T),
        batched=True,
    )


class Linear(NamedTuple):
    """Matrices of the linear part for each particle, or without the particle axis if shared by all.

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
    """A model that is linear and Gaussian given the part u, which is drawn.

    Parameters
    ----------
    sample_initial : callable
        ``(rng, n) -> u`` (n, ...) draws u_0.
    sample_transition : callable
        ``(rng, u) -> u`` draws u_t given u_{t-1}.
    linear : callable
        ``(u) -> Linear``.
    mean, cov : (d,) and (d, d) array_like
        Of z_0, for any u_0.
    """

    sample_initial: Callable[[np.random.Generator, int], np.ndarray]
    sample_transition: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    linear: Callable[[np.ndarray], Linear]
    mean: Any
    cov: Any


@dataclass(frozen=True)
class _Initial(Proposal):
    model: ConditionallyLinear

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        mean, cov = np.asarray(self.model.mean, np.float64), np.asarray(self.model.cov, np.float64)
        return Population(
            {"u": self.model.sample_initial(rng, n), "mean": np.tile(mean, (n, 1)), "cov": np.tile(cov, (n, 1, 1))}
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
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        """Weight by the predictive density N(y; H m, S), then correct mean and covariance (Joseph form)."""
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


def rao_blackwellised(model: ConditionallyLinear, n: int, **components: Any) -> ParticleFilter:
    """The Rao-Blackwellised filter of a model.

    Parameters
    ----------
    model : ConditionallyLinear
    n : int
        Particles.
    **components
        Further fields of `ParticleFilter`, such as ``resampler``.
    """
    return ParticleFilter(
        initial=_Initial(model), transition=_Predict(model), update=_Correct(model), n=n, **components
    )
