"""Gaussian and finite models, their exact answers, and filters that use them: Rao-Blackwellised, EKF- and UKF-guided.

>>> filter = bootstrap(linear_gaussian(F, Q, H, R, m0, P0), n=1000)
>>> exact = kalman_filter(F, Q, H, R, m0, P0, observations)
>>> exact.means, exact.covariances, exact.log_evidence             # (T, d), (T, d, d), (T,)

>>> filter = bootstrap(hidden_markov(initial, transition, log_likelihood), n=1000)
>>> exact = forward_backward(initial, transition, log_likelihood, observations)
>>> exact.filtered, exact.smoothed, exact.log_evidence             # (T, K), (T, K), (T,)

The first observation updates the initial state before any prediction, as in all filters of this package. An
observation that is missing is None.

>>> filter = guided(nonlinear_gaussian(f, Q, h, R, m0, P0), ukf_proposal(f, Q, h, R), n=100)

A model with Gaussian noise and nonlinear functions has no exact answers, but good proposals: the updates of the
extended and the unscented Kalman filter.

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

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distributions import MultivariateNormal
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.interfaces import Proposal, Transition, Update
from mstfilter.smc.population import Population, check_observations, union
from mstfilter.smc.state_space import StateSpaceModel

_Map = Callable[[np.ndarray], np.ndarray]  #: of particles (n, d) or (R, n, d)


def linear_gaussian(F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = F x_{t-1} + N(0, Q), y_t = H x_t + N(0, R); particles are (n, d).

    `kalman_filter` has the exact answers.
    """
    F, Q, H, R, m0, P0 = (np.asarray(a, dtype=np.float64) for a in (F, Q, H, R, m0, P0))
    if m0.ndim != 1:
        raise InputError(f"m0 has shape {m0.shape}, expected one number per entry of the state: (d,)")
    d, k = m0.shape, H.shape[:1]
    for name, array, shape in (("F", F, d * 2), ("H", H, k + d), ("R", R, k * 2)):
        if array.shape != shape:
            raise InputError(f"{name} has shape {array.shape}, expected {shape} as m0 has {d[0]} entries")
    return nonlinear_gaussian(lambda x: x @ F.T, Q, lambda x: x @ H.T, R, m0, P0)


def nonlinear_gaussian(f: _Map, Q: Any, h: _Map, R: Any, m0: Any, P0: Any) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = f(x_{t-1}) + N(0, Q), y_t = h(x_t) + N(0, R).

    `f` and `h` give the next states (n, d), and the observations (n, k) without noise, of particles (n, d). If they
    also take particles (R, n, d), the model can be run in a batch.
    """
    m0 = np.asarray(m0, np.float64)
    Q, R, P0 = _covariance("Q", Q, len(m0)), _covariance("R", R), _covariance("P0", P0, len(m0))
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
        return f(x) + rng.standard_normal(x.shape) @ root_Q.T

    of_R, of_P, of_Q = log_normal(R), log_normal(P0), log_normal(Q)
    return StateSpaceModel(
        initial,
        transition,
        lambda x, y: of_R(np.atleast_1d(y) - h(x)),
        lambda x: of_P(x - m0),
        lambda old, new: of_Q(new - f(old)),
        batched=True,
    )


def _covariance(name: str, given: Any, d: int | None = None) -> np.ndarray:
    cov = np.asarray(given, dtype=np.float64)
    if cov.ndim != 2 or cov.shape != (d or len(cov), d or len(cov)):
        expected = "(k, k)" if d is None else f"({d}, {d}) as m0 has {d} entries"
        raise InputError(f"{name} has shape {cov.shape}, expected {expected}")
    if not np.allclose(cov, cov.T) or not (np.linalg.eigvalsh(cov) > 0).all():
        raise InputError(f"{name} is {cov.tolist()}, expected a covariance: symmetric and positive definite")
    return cov


class Kalman(NamedTuple):
    """Exact answers of a linear-Gaussian model."""

    means: np.ndarray  #: (T, d) E[x_t | y_0 .. y_t]
    covariances: np.ndarray  #: (T, d, d) Cov[x_t | y_0 .. y_t]
    smoothed_means: np.ndarray  #: (T, d) E[x_t | y_0 .. y_{T-1}]
    smoothed_covariances: np.ndarray  #: (T, d, d) Cov[x_t | y_0 .. y_{T-1}]
    log_evidence: np.ndarray  #: (T,) log p(y_0 .. y_t)


def kalman_filter(F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any, observations: Iterable[Any]) -> Kalman:
    """The Kalman filter and the Rauch-Tung-Striebel smoother of filterpy, of (k,) observations; None if missing.

    The arguments are as in `linear_gaussian`. The matrices may have a first axis of T entries: entry t of `F` and `Q`
    moves x_{t-1} to x_t, entry 0 is not used; entry t of `H` and `R` belongs to y_t. Raises InputError if a shape
    does not fit.
    """
    from filterpy.kalman import KalmanFilter

    ys = [
        None if y is None else np.atleast_1d(np.asarray(y, dtype=np.float64))
        for y in check_observations(observations)
    ]
    m0, P0 = np.asarray(m0, dtype=np.float64), np.asarray(P0, dtype=np.float64)
    T, d, k = len(ys), len(m0), np.shape(H)[-2]
    matrices = {}
    for name, given, shape in (("F", F, (d, d)), ("Q", Q, (d, d)), ("H", H, (k, d)), ("R", R, (k, k))):
        array = np.asarray(given, dtype=np.float64)
        if array.shape not in (shape, (T, *shape)):
            raise InputError(f"{name} has shape {array.shape}, expected {shape} or {(T, *shape)}")
        matrices[name] = np.broadcast_to(array, (T, *shape))
    if P0.shape != (d, d):
        raise InputError(f"P0 has shape {P0.shape}, expected {(d, d)} as m0 has {d} entries")
    kf = KalmanFilter(dim_x=d, dim_z=k)
    kf.x, kf.P = m0.copy(), P0.copy()
    means, covariances, total = np.empty((T, d)), np.empty((T, d, d)), np.zeros(T)
    for t, y in enumerate(ys):
        total[t] = total[t - 1] if t else 0.0
        kf.F, kf.Q, kf.H, kf.R = (matrices[name][t] for name in "FQHR")
        if t:
            kf.predict()
        if y is not None:
            if y.shape != (k,):
                raise InputError(f"observation {t} has shape {y.shape}, expected ({k},)")
            kf.update(y)
            total[t] += kf.log_likelihood
        means[t], covariances[t] = kf.x, kf.P
    smoothed = means, covariances
    if T > 1:
        smoothed = kf.rts_smoother(means, covariances, list(matrices["F"]), list(matrices["Q"]))[:2]
    return Kalman(means, covariances, *smoothed, total)


def hidden_markov(initial: Any, transition: Any, log_likelihood: Callable[[Any], Any]) -> StateSpaceModel:
    """A model with K states 0 .. K-1; particles are (n,) int. `forward_backward` has the exact answers.

    `initial` (K,) has the probabilities of x_0, row i of `transition` (K, K) those of x_t given x_{t-1} = i.
    ``log_likelihood(y)`` (K,) is log p(y_t | x_t = 0 .. K-1); -inf if impossible.
    """
    start, moves = _chain(initial, transition)
    # The last positive entry is 1 exactly, so that u < 1 never selects a state of probability 0.
    below_start, below = (np.cumsum(p, axis=-1) / p.sum(axis=-1, keepdims=True) for p in (start, moves))
    for cumulative in (below_start, below):
        cumulative[cumulative >= cumulative[..., -1:]] = 1.0
    with np.errstate(divide="ignore"):
        log_start, log_moves = np.log(start), np.log(moves)

    def initial_states(rng: np.random.Generator, n: int | tuple[int, int]) -> np.ndarray:
        return (below_start <= rng.random(n)[..., None]).sum(axis=-1)

    return StateSpaceModel(
        initial_states,
        lambda rng, x: (below[x] <= rng.random(x.shape)[..., None]).sum(axis=-1),
        lambda x, y: np.asarray(log_likelihood(y), dtype=np.float64)[x],
        lambda x: log_start[x],
        lambda old, new: log_moves[old, new],
    )


def _chain(initial: Any, transition: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checked probabilities (K,) of the first state and (K, K) of the moves."""
    start, moves = _probabilities("initial", initial, 1), _probabilities("transition", transition, 2)
    if moves.shape != (len(start),) * 2:
        raise InputError(f"transition has shape {moves.shape}, expected {(len(start),) * 2} as initial")
    return start, moves


def _probabilities(name: str, given: Any, ndim: int) -> np.ndarray:
    """Rows of probabilities that sum to one."""
    p = np.asarray(given, dtype=np.float64)
    if p.ndim != ndim or not p.size:
        raise InputError(f"{name} has shape {p.shape}, expected {'(K,)' if ndim == 1 else '(K, K)'}")
    if not ((p >= 0).all() and np.allclose(p.sum(axis=-1), 1.0)):
        raise InputError(f"{name} is {p.tolist()}, expected probabilities that sum to 1 in each row")
    return p


class Marginals(NamedTuple):
    """Exact answers of a model with K states."""

    filtered: np.ndarray  #: (T, K) p(x_t | y_0 .. y_t)
    smoothed: np.ndarray  #: (T, K) p(x_t | y_0 .. y_{T-1})
    log_evidence: np.ndarray  #: (T,) log p(y_0 .. y_t)


def forward_backward(
    initial: Any, transition: Any, log_likelihood: Callable[[Any], Any], observations: Iterable[Any]
) -> Marginals:
    """The forward-backward algorithm of a model with K states (Rabiner 1989); arguments as in `hidden_markov`.

    Raises InputError if a shape does not fit, or no state explains an observation.
    """
    start, moves = _chain(initial, transition)
    ys = list(check_observations(observations))
    T, K = len(ys), len(start)
    filtered, likelihood, total = np.empty((T, K)), np.ones((T, K)), np.zeros(T)
    for t, y in enumerate(ys):
        predicted = filtered[t - 1] @ moves if t else start
        total[t] = total[t - 1] if t else 0.0
        filtered[t] = predicted
        if y is None:
            continue
        found = np.asarray(log_likelihood(y), dtype=np.float64)
        if found.shape != (K,):
            raise InputError(f"log_likelihood returned shape {found.shape}, expected ({K},): one number per state")
        possible = found[predicted > 0].max()
        if not np.isfinite(possible):
            raise InputError(f"observation {t} is {y!r}: no state that is possible there explains it")
        likelihood[t] = np.exp(np.where(predicted > 0, found - possible, -np.inf))
        joint = predicted * likelihood[t]
        total[t] += np.log(joint.sum()) + possible
        filtered[t] = joint / joint.sum()
    smoothed, later = filtered.copy(), np.ones(K)  # later is proportional to p(y_{t+1} .. | x_t)
    for t in range(T - 2, -1, -1):
        later = moves @ (likelihood[t + 1] * later)
        later /= later.max()
        smoothed[t] = filtered[t] * later / (filtered[t] @ later)
    return Marginals(filtered, smoothed, total)


class Linear(NamedTuple):
    """Matrices of the linear part for each particle, or without the particle axis if shared by all."""

    F: Any  #: (n, d, d)
    Q: Any
    H: Any  #: (n, k, d)
    R: Any  #: (n, k, k)
    b: Any = 0.0  #: (n, d)


@dataclass(frozen=True)
class ConditionallyLinear:
    """A model that is linear and Gaussian given the part u, which is drawn.

    ``sample_initial(rng, n)`` draws u_0 (n, ...), ``sample_transition(rng, u)`` draws u_t given u_{t-1}, and
    ``linear(u)`` gives the matrices. `mean` (d,) and `cov` (d, d) are those of z_0, for any u_0.
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
    """The Rao-Blackwellised filter of a model with `n` particles.

    `components` are further fields of `ParticleFilter`, such as ``resampler``.
    """
    return ParticleFilter(
        initial=_Initial(model), transition=_Predict(model), update=_Correct(model), n=n, **components
    )


def ekf_proposal(f: _Map, Q: Any, h: _Map, R: Any, jacobian: _Map) -> Callable[[np.ndarray, Any], MultivariateNormal]:
    """A proposal for `guided`: the update of the extended Kalman filter from each particle.

    Given x_{t-1} the state is N(f(x_{t-1}), Q); `h` is linearised at its mean (Doucet, Godsill, Andrieu 2000, section
    II D). The arguments are as in `nonlinear_gaussian`; `jacobian` gives the derivatives of `h`, (n, k, d) or (k, d).
    It is computed for all particles at once; filterpy's ExtendedKalmanFilter holds a single state.
    """
    Q, R = _covariance("Q", Q), _covariance("R", R)

    def proposal(x: np.ndarray, y: Any) -> MultivariateNormal:
        mean = f(x)
        H = np.asarray(jacobian(mean), np.float64)
        cross = Q @ np.swapaxes(H, -1, -2)
        return _conditional(mean, Q, h(mean), H @ cross + R, cross, y)

    return proposal


def ukf_proposal(
    f: _Map, Q: Any, h: _Map, R: Any, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0
) -> Callable[[np.ndarray, Any], MultivariateNormal]:
    """A proposal for `guided`: the update of the unscented Kalman filter from each particle.

    Needs no derivatives (van der Merwe, Doucet, de Freitas, Wan 2000). `alpha`, `beta` and `kappa` are those of
    filterpy's MerweScaledSigmaPoints: spread of the points, weight of the central one, secondary spread. The other
    arguments are as in `nonlinear_gaussian`.
    """
    from filterpy.kalman import MerweScaledSigmaPoints

    Q, R = _covariance("Q", Q), _covariance("R", R)
    points = MerweScaledSigmaPoints(len(Q), alpha, beta, kappa)
    offsets = points.sigma_points(np.zeros(len(Q)), Q)

    def proposal(x: np.ndarray, y: Any) -> MultivariateNormal:
        mean = f(x)
        sigma = mean[:, None] + offsets
        z = np.reshape(h(sigma.reshape(-1, len(Q))), (*sigma.shape[:2], len(R)))
        centre = np.einsum("s,nsk->nk", points.Wm, z)
        z = z - centre[:, None]
        S = np.einsum("s,nsi,nsj->nij", points.Wc, z, z) + R
        return _conditional(mean, Q, centre, S, np.einsum("s,si,nsj->nij", points.Wc, offsets, z), y)

    return proposal


def _conditional(
    mean: np.ndarray, cov: np.ndarray, predicted: np.ndarray, S: np.ndarray, cross: np.ndarray, y: Any
) -> MultivariateNormal:
    """The normal distribution of x given y, from their joint moments."""
    gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(cross, -1, -2)), -1, -2)
    residual = np.atleast_1d(np.asarray(y, np.float64)) - predicted
    return MultivariateNormal(mean + (gain @ residual[..., None])[..., 0], cov - gain @ S @ np.swapaxes(gain, -1, -2))
