"""Models with Gaussian noise, filters guided by the unscented Kalman filter, and Rao-Blackwellised filters.

>>> filter = guided(nonlinear_gaussian(f, Q, h, R, m0, P0), ukf_proposal(f, Q, h, R), n=100)

The update of the unscented Kalman filter is a good proposal for a nonlinear model with Gaussian noise.

>>> filter = rao_blackwellised(model, n=100)
>>> state, infos = filter.run(observations, seed=0)
>>> state.population.particles["mean"].shape           # (n, d)

A Rao-Blackwellised filter draws a part u_t of the state (a regime, a contact, an association). Given u_0 .. u_t, the
other part z_t is linear and Gaussian:

    z_t = F(u_t) z_{t-1} + b(u_t) + N(0, Q(u_t)),    y_t = H(u_t) z_t + N(0, R(u_t))

A particle holds u_t, and the mean and covariance of z_t given u_0 .. u_t and y_0 .. y_t. The particles are a mapping
of arrays. The update weights by p(y_t | u_0 .. u_t, y_0 .. y_{t-1}). Reference: Doucet, de Freitas, Murphy, Russell
(2000).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inputs import AtStep, step_parameters, with_step
from mstfilter.smc.interfaces import Proposal, Transition, Update
from mstfilter.smc.models.distributions import MultivariateNormal
from mstfilter.smc.models.state_space import StateSpaceModel
from mstfilter.smc.population import Population, union


def nonlinear_gaussian(
    f: Callable[..., Any], Q: Any, h: Callable[..., Any], R: Any, m0: Any, P0: Any
) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = f(x_{t-1}) + N(0, Q), y_t = h(x_t) + N(0, R).

    `f` maps particles (n, d) to next states (n, d), and `h` maps particles to observations (n, k), row by row,
    without noise. The functions may also have the parameters ``t`` and ``u``. `Q` and `R` may have a first axis of
    length T, one entry per step.

    `Q` and `P0` may be singular, for example if noise acts only on the velocity. With a singular `Q`, the model has
    no `log_transition`. With a singular `P0`, the model has no `log_initial`. Functions that need the missing density
    raise InputError. Without `log_transition`, `conditional_path` omits ancestor sampling.
    """
    m0 = np.asarray(m0, np.float64)
    p, q, r = _Noise("P0", P0, len(m0), True), _Noises("Q", Q, len(m0), True), _Noises("R", R)
    moved, seen = _OfStep("f", f, len(m0)), _OfStep("h", h, r.size)
    moves, sees = _merged(moved, q), _merged(seen, r)

    def transition(rng: np.random.Generator, x: np.ndarray, **step: Any) -> np.ndarray:
        return moved(x, step) + q.at(**step).draw(rng, len(x))

    def log_likelihood(x: np.ndarray, y: Any, **step: Any) -> np.ndarray:
        noise = r.at(**step)
        return noise.log_prob(vector_of("the observation", y, noise.size) - seen(x, step))

    def log_transition(old: np.ndarray, new: np.ndarray, **step: Any) -> np.ndarray:
        return q.at(**step).log_prob(new - moved(old, step))

    def sample_observation(rng: np.random.Generator, x: np.ndarray, **step: Any) -> np.ndarray:
        return seen(x, step) + r.at(**step).draw(rng, len(x))

    return StateSpaceModel(
        lambda rng, n: m0 + p.draw(rng, n),
        with_step(transition, moves),
        with_step(log_likelihood, sees),
        None if p.singular else lambda x: p.log_prob(x - m0),
        None if any(noise.singular for noise in q.entries) else with_step(log_transition, moves),
        sample_observation=with_step(sample_observation, sees),
    )


class _Noise:
    """Normal noise with mean 0 and covariance (k, k)."""

    def __init__(self, name: str, cov: np.ndarray, k: int | None, semidefinite: bool) -> None:
        root, self.singular = _covariance(name, cov, k, semidefinite)
        self.size, self.root, self.covariance = len(root), root.T, np.asarray(cov, np.float64)
        if not self.singular:
            self.whiten = np.linalg.inv(root).T
            self.constant = np.log(np.diag(self.whiten)).sum() - 0.5 * self.size * np.log(2 * np.pi)

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n, k) draws."""
        return rng.standard_normal((n, self.size)) @ self.root

    def log_prob(self, residual: np.ndarray) -> np.ndarray:
        """(n,) log densities of residuals (n, k)."""
        z = residual @ self.whiten
        return self.constant - 0.5 * np.einsum("...j,...j->...", z, z)


class _Noises:
    """Noise with one covariance (k, k) for all steps, or a covariance for each step, (T, k, k)."""

    def __init__(self, name: str, given: Any, k: int | None = None, semidefinite: bool = False) -> None:
        cov = np.asarray(given, np.float64)
        self.name, self.parameters = name, {"t": True} if cov.ndim == 3 else {}
        self.entries = [_Noise(name, m, k, semidefinite) for m in (cov if self.parameters else cov[None])]
        self.size = cov.shape[-1]

    def at(self, t: int = 0, u: Any = None) -> _Noise:
        return entry(self.name, self.entries, t) if self.parameters else self.entries[0]


class _OfStep:
    """A function of particles, (n, size), that may also have the parameters `t` (step) and `u` (input)."""

    def __init__(self, name: str, function: Callable[..., Any], size: int) -> None:
        self.name, self.function, self.size = name, function, size
        self.parameters = step_parameters(function, 1)

    def __call__(self, x: np.ndarray, step: dict[str, Any]) -> Any:
        found = self.function(x, **{name: value for name, value in step.items() if name in self.parameters})
        if np.shape(found) != (len(x), self.size):  # numpy might broadcast it
            raise InputError(f"{self.name} returned shape {np.shape(found)}, expected ({len(x)}, {self.size})")
        return found


def _merged(*parts: _Noises | _OfStep) -> dict[str, bool]:
    """The parameters ``t`` and ``u`` of several parts. A parameter is required if a part requires it."""
    names = {name for part in parts for name in part.parameters}
    return {name: any(part.parameters.get(name, False) for part in parts) for name in sorted(names)}


def entry(name: str, given: Any, t: int) -> Any:
    """Entry `t` of a list with one entry per step; InputError if the list is too short."""
    if t >= len(given):
        raise InputError(f"{name} has {len(given)} entries, and none for step {t}")
    return given[t]


def vector_of(what: str, given: Any, size: int) -> np.ndarray:
    """An observation or input as a vector (size,). A number becomes (1,)."""
    vector = np.atleast_1d(np.asarray(given, np.float64))
    if vector.shape != (size,):
        raise InputError(f"{what} has shape {np.shape(given)}, expected ({size},)")
    return vector


def _covariance(name: str, given: Any, d: int | None = None, semidefinite: bool = False) -> tuple[np.ndarray, bool]:
    """A square root of a covariance (Cholesky, or from eigenvalues if singular), and whether it is singular."""
    cov = np.asarray(given, dtype=np.float64)
    if cov.ndim != 2 or cov.shape != (d or len(cov), d or len(cov)):
        expected = "(k, k)" if d is None else f"({d}, {d}) as m0 has {d} entries"
        raise InputError(f"{name} has shape {cov.shape}, expected {expected}")
    if np.allclose(cov, cov.T):
        size = np.sqrt(np.where(np.diag(cov) > 0, np.diag(cov), 1.0))
        values = np.linalg.eigvalsh(cov / np.outer(size, size))  # entries may have very different scales
        if (values > 1e-14 * values.max()).all():
            return np.linalg.cholesky(cov), False
        values, axes = np.linalg.eigh(cov)
        rounding = 1e-14 * max(values.max(), 0.0)
        if semidefinite and (values >= -rounding).all():
            return axes * np.sqrt(np.maximum(values, 0.0)), True
    kind = "semidefinite" if semidefinite else "definite"
    raise InputError(f"{name} is {cov.tolist()}, expected a covariance: symmetric and positive {kind}")


class Linear(NamedTuple):
    """Matrices of the linear part, one per particle. A matrix that all particles share has no particle axis."""

    F: Any  #: (n, d, d)
    Q: Any
    H: Any  #: (n, k, d)
    R: Any  #: (n, k, k)
    b: Any = 0.0  #: (n, d)


@dataclass(frozen=True)
class ConditionallyLinear(AtStep):
    """A model that is linear and Gaussian given u_t. The filter draws u_t.

    ``sample_initial(rng, n)`` draws u_0 (n, ...), ``sample_transition(rng, u)`` draws u_t given u_{t-1}, and
    ``linear(u)`` returns the matrices. `mean` (d,) and `cov` (d, d) are the mean and covariance of z_0 for any u_0.
    The functions may also have a parameter ``t``, the index of the step. A further parameter ``u`` gets its input.
    """

    sample_initial: Callable[[np.random.Generator, int], np.ndarray]
    sample_transition: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    linear: Callable[[np.ndarray], Linear]
    mean: Any
    cov: Any

    step_functions: ClassVar = {"sample_initial": 2, "sample_transition": 2, "linear": 1}


@dataclass(frozen=True)
class _Initial(Proposal):
    model: ConditionallyLinear
    step_functions: ClassVar = {"model": None}

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        mean, cov = np.asarray(self.model.mean, np.float64), np.asarray(self.model.cov, np.float64)
        return Population(
            {"u": self.model.sample_initial(rng, n), "mean": np.tile(mean, (n, 1)), "cov": np.tile(cov, (n, 1, 1))}
        )


@dataclass(frozen=True)
class _Predict(Transition):
    model: ConditionallyLinear
    step_functions: ClassVar = {"model": None}

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        """Draw u_t, then predict the mean and covariance of z_t."""
        u = self.model.sample_transition(rng, population.particles["u"])
        m, n = _checked(self.model.linear(u), population.particles["mean"]), len(population)
        mean = (m.F @ population.particles["mean"][..., None])[..., 0] + m.b
        cov = m.F @ population.particles["cov"] @ np.swapaxes(m.F, -1, -2) + m.Q
        particles = {"u": u, "mean": mean, "cov": np.broadcast_to(cov, (n, *cov.shape[-2:]))}
        return Population(particles, population.log_weights, population.parents)


@dataclass(frozen=True)
class _Correct(Update):
    model: ConditionallyLinear
    draws: ClassVar[bool] = False
    step_functions: ClassVar = {"model": None}

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        """Weight by the predictive density N(y; H m, S), then correct mean and covariance of z_t (Joseph form)."""
        population = union(predicted, proposed)
        p: Any = population.particles
        _, _, H, R, _ = _checked(self.model.linear(p["u"]), p["mean"])
        y = vector_of("the observation", observation, R.shape[-1])
        expected = (H @ p["mean"][..., None])[..., 0]
        S = H @ p["cov"] @ np.swapaxes(H, -1, -2) + R
        root = np.linalg.cholesky(S)
        z = np.linalg.solve(root, (y - expected)[..., None])[..., 0]
        log_det = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
        log_p = -0.5 * (z * z).sum(axis=-1) - log_det - 0.5 * len(y) * np.log(2 * np.pi)
        gain = np.swapaxes(np.linalg.solve(S, H @ p["cov"]), -1, -2)
        keep = np.eye(p["mean"].shape[1]) - gain @ H
        cov = keep @ p["cov"] @ np.swapaxes(keep, -1, -2) + gain @ R @ np.swapaxes(gain, -1, -2)
        mean = p["mean"] + (gain @ (y - expected)[..., None])[..., 0]
        particles = {"u": p["u"], "mean": mean, "cov": cov}
        return Population(particles, population.log_weights + log_p, population.parents)


def _checked(given: Linear, means: np.ndarray) -> Linear:
    """The matrices as float64 arrays. Raises InputError if a shape does not fit `means` (n, d)."""
    (n, d), b = means.shape, np.asarray(given.b, np.float64)
    m = Linear(**{name: np.atleast_2d(np.asarray(getattr(given, name), np.float64)) for name in "FQHR"}, b=b)
    k = m.H.shape[-2]
    for name, shape in {"F": (d, d), "Q": (d, d), "H": (k, d), "R": (k, k), "b": (d,) * (b.ndim > 0)}.items():
        array = getattr(m, name)  # numpy might broadcast it
        if array.shape not in (shape, (1, *shape), (n, *shape)):
            raise InputError(f"linear returned {name} of shape {array.shape}, expected {shape} or {(n, *shape)}")
    return m


def rao_blackwellised(model: ConditionallyLinear, n: int, **components: Any) -> ParticleFilter:
    """The Rao-Blackwellised filter of a model with `n` particles.

    `components` are other fields of `ParticleFilter`, such as ``resampler``.
    """
    return ParticleFilter(
        initial=_Initial(model), transition=_Predict(model), update=_Correct(model), n=n, **components
    )


def ukf_proposal(
    f: Callable[..., Any],
    Q: Any,
    h: Callable[..., Any],
    R: Any,
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
) -> Callable[..., MultivariateNormal]:
    """A proposal for `guided`: for each particle, the posterior of x_t by an unscented Kalman filter.

    Given x_{t-1}, the predicted x_t is N(f(x_{t-1}), Q). The proposal needs no derivatives (van der Merwe, Doucet,
    de Freitas, Wan 2000). `alpha` (spread of the sigma points), `beta` (weight of the central point) and `kappa`
    (secondary spread) are the parameters of filterpy's MerweScaledSigmaPoints. The other arguments are as in
    `nonlinear_gaussian`, except that `Q` must not be singular.
    """
    from filterpy.kalman import MerweScaledSigmaPoints

    q, r = _Noises("Q", Q), _Noises("R", R)
    moved, seen = _OfStep("f", f, q.size), _OfStep("h", h, r.size)
    points = MerweScaledSigmaPoints(q.size, alpha, beta, kappa)
    offsets_of = {noise: points.sigma_points(np.zeros(q.size), noise.covariance) for noise in q.entries}

    def proposal(x: np.ndarray, y: Any, **step: Any) -> MultivariateNormal:
        noise, R = q.at(**step), r.at(**step).covariance
        offsets, Q, mean = offsets_of[noise], noise.covariance, moved(x, step)
        sigma = mean[:, None] + offsets
        z = np.reshape(seen(sigma.reshape(-1, q.size), step), (*sigma.shape[:2], r.size))
        centre = np.einsum("s,nsk->nk", points.Wm, z)
        z = z - centre[:, None]
        S = np.einsum("s,nsi,nsj->nij", points.Wc, z, z) + R
        cross = np.einsum("s,si,nsj->nij", points.Wc, offsets, z)
        gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(cross, -1, -2)), -1, -2)
        change = (gain @ (vector_of("the observation", y, r.size) - centre)[..., None])[..., 0]
        return MultivariateNormal(mean + change, Q - gain @ S @ np.swapaxes(gain, -1, -2))

    return with_step(proposal, _merged(moved, q, seen, r))
