"""Models with Gaussian noise, filters guided by the unscented Kalman filter, and Rao-Blackwellised filters.

If f and h are nonlinear, x_t = f(x_{t-1}) + N(0, Q) and y_t = h(x_t) + N(0, R) have no exact filter. The posterior of
x_t that an unscented Kalman filter computes for each particle is a good proposal, because it has seen y_t, and the
weights correct its error (van der Merwe, Doucet, de Freitas, Wan 2000):

>>> import numpy as np
>>> from mstfilter.smc import ConditionallyLinear, Linear, guided, nonlinear_gaussian, rao_blackwellised, ukf_proposal
>>> f, h, Q, R = (lambda x: 0.5 * x + np.cos(x)), (lambda x: x + 0.1 * x**2), [[0.5]], [[0.05]]
>>> model = nonlinear_gaussian(f, Q, h, R, m0=[0.0], P0=[[1.0]])
>>> states, observations = model.simulate(30, seed=1)
>>> state, infos = guided(model, ukf_proposal(f, Q, h, R), n=100).run(observations, seed=0)
>>> bool(np.mean([info.ess for info in infos]) > 60)                   # of 100; half as many without the proposal
True

Often only a part u_t of the state is hard (a regime, a contact, an association). Given u_0 .. u_t, the other part z_t
is linear and Gaussian:

    z_t = F(u_t) z_{t-1} + b(u_t) + N(0, Q(u_t)),    y_t = H(u_t) z_t + N(0, R(u_t))

Then particles are needed for u_t only. Each carries the Kalman mean and covariance of z_t, which are exact, so the
weights p(y_t | u_0 .. u_t, y_0 .. y_{t-1}) vary less than those of particles of both parts (Doucet, de Freitas,
Murphy, Russell 2000):

>>> def linear(regime):
...     '''Noise of the motion for each particle: calm or wild.'''
...     Q = np.where(regime == 0, 0.05, 2.0)[:, None, None]
...     return Linear(F=np.array([[0.95]]), Q=Q, H=np.array([[1.0]]), R=np.array([[0.2]]))
>>> def next_regime(rng, regime):
...     return np.where(rng.random(len(regime)) < 0.1, 1 - regime, regime)
>>> model = ConditionallyLinear(lambda rng, n: np.zeros(n, int), next_regime, linear, mean=[0.0], cov=[[1.0]])
>>> states, observations = model.simulate(30, seed=1)
>>> state, infos = rao_blackwellised(model, n=50).run(observations, seed=0)
>>> state.population.particles["mean"].shape           # (n, d)
(50, 1)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inputs import AtStep
from mstfilter.smc.interfaces import Proposal, Transition, Update
from mstfilter.smc.models.distributions import MultivariateNormal
from mstfilter.smc.models.simulation import simulate_steps
from mstfilter.smc.models.state_space import StateSpaceModel
from mstfilter.smc.population import Particles, Population, union


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
    prior, noise, error = _Noise("P0", P0, len(m0), True), _noise("Q", Q, len(m0), True), _noise("R", R)
    model = _Nonlinear(f, h, noise, error)
    return StateSpaceModel(
        lambda rng, n: m0 + prior.draw(rng, n),
        model.sample_transition,
        model.log_likelihood,
        None if prior.singular else lambda x: prior.log_prob(x - m0),
        None if noise.singular else model.log_transition,
        model.sample_observation,
    )


@dataclass(frozen=True, eq=False)
class _Nonlinear(AtStep):
    """The functions of a nonlinear model with normal noise."""

    f: Callable[..., Any]
    h: Callable[..., Any]
    q: _Noise | _NoiseOfStep
    r: _Noise | _NoiseOfStep
    step_functions: ClassVar = {"f": 1, "h": 1, "q": None, "r": None}

    def moved(self, x: np.ndarray) -> np.ndarray:
        """(n, d) next states without noise."""
        return _of_size("f", self.f(x), len(x), self.q.size)

    def seen(self, x: np.ndarray) -> np.ndarray:
        """(n, k) observations without noise."""
        return _of_size("h", self.h(x), len(x), self.r.size)

    def sample_transition(self, rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
        return self.moved(x) + self.q.draw(rng, len(x))

    def log_transition(self, old: np.ndarray, new: np.ndarray) -> np.ndarray:
        return self.q.log_prob(new - self.moved(old))

    def log_likelihood(self, x: np.ndarray, y: Any) -> np.ndarray:
        return self.r.log_prob(vector_of("the observation", y, self.r.size) - self.seen(x))

    def sample_observation(self, rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
        return self.seen(x) + self.r.draw(rng, len(x))


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


@dataclass(frozen=True, eq=False)
class _NoiseOfStep(AtStep):
    """Noise with a covariance for each step."""

    name: str
    entries: list[_Noise]
    t: int = 0

    def at_step(self, t: int, u: Any = None) -> _NoiseOfStep:
        return _NoiseOfStep(self.name, self.entries, t)

    @property
    def singular(self) -> bool:
        return any(noise.singular for noise in self.entries)

    @property
    def size(self) -> int:
        return self.entries[0].size

    @property
    def covariance(self) -> np.ndarray:
        return entry(self.name, self.entries, self.t).covariance

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return entry(self.name, self.entries, self.t).draw(rng, n)

    def log_prob(self, residual: np.ndarray) -> np.ndarray:
        return entry(self.name, self.entries, self.t).log_prob(residual)


def _noise(name: str, given: Any, k: int | None = None, semidefinite: bool = False) -> _Noise | _NoiseOfStep:
    """Noise with one covariance (k, k) for all steps, or a covariance for each step, (T, k, k)."""
    cov = np.asarray(given, np.float64)
    if cov.ndim == 3:
        return _NoiseOfStep(name, [_Noise(name, one, k, semidefinite) for one in cov])
    return _Noise(name, cov, k, semidefinite)


def _of_size(name: str, found: Any, n: int, size: int) -> np.ndarray:
    """What a function of the user returned, (n, size)."""
    if np.shape(found) != (n, size):  # numpy might broadcast it
        raise InputError(f"{name} returned shape {np.shape(found)}, expected ({n}, {size})")
    return found


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

    def simulate(self, n_steps: int, seed: int = 0, inputs: Iterable[Any] | None = None) -> tuple[Particles, Any]:
        """Draw u_t (T, ...) and z_t (T, d), as a mapping, and y_t (T, k), as `StateSpaceModel.simulate` does."""

        def step(rng: np.random.Generator, t: int, u: Any, x: Any) -> tuple[Any, Any]:
            at, mean = self.at_step(t, u), np.asarray(self.mean, np.float64)
            regimes = at.sample_initial(rng, 2) if x is None else at.sample_transition(rng, x["u"])
            given = _checked(at.linear(regimes), np.tile(mean, (2, 1)))
            F, Q, H, R = (a if a.ndim == 2 else a[0] for a in given[:4])
            if x is None:
                z = rng.multivariate_normal(mean, self.cov)
            else:
                z = rng.multivariate_normal(F @ x["z"][0] + np.broadcast_to(given.b, (2, len(mean)))[0], Q)
            return {"u": regimes, "z": np.stack([z, z])}, rng.multivariate_normal(H @ z, R)

        return simulate_steps(step, n_steps, seed, inputs)


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

    q, r = _noise("Q", Q), _noise("R", R)
    points = MerweScaledSigmaPoints(q.size, alpha, beta, kappa)
    return _Unscented(_Nonlinear(f, h, q, r), points)


@dataclass(frozen=True, eq=False)
class _Unscented(AtStep):
    """The proposal of `ukf_proposal`."""

    model: _Nonlinear
    points: Any
    step_functions: ClassVar = {"model": None}

    def __call__(self, x: np.ndarray, y: Any) -> MultivariateNormal:
        model, points = self.model, self.points
        d, k, Q, R = model.q.size, model.r.size, model.q.covariance, model.r.covariance
        mean, offsets = model.moved(x), points.sigma_points(np.zeros(d), Q)
        sigma = mean[:, None] + offsets
        z = np.reshape(model.seen(sigma.reshape(-1, d)), (*sigma.shape[:2], k))
        centre = np.einsum("s,nsk->nk", points.Wm, z)
        z = z - centre[:, None]
        S = np.einsum("s,nsi,nsj->nij", points.Wc, z, z) + R
        cross = np.einsum("s,si,nsj->nij", points.Wc, offsets, z)
        gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(cross, -1, -2)), -1, -2)
        change = (gain @ (vector_of("the observation", y, k) - centre)[..., None])[..., 0]
        return MultivariateNormal(mean + change, Q - gain @ S @ np.swapaxes(gain, -1, -2))
