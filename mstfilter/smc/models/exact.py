"""Linear-Gaussian and finite models, and their exact posteriors.

Two kinds of models have posteriors that can be computed: Kalman's recursions give the mean and covariance of a linear
model with Gaussian noise, and sums over all states give the probabilities of a finite one. They tell how far a filter
is from the truth:

>>> import numpy as np
>>> from mstfilter.smc import bootstrap, kalman_filter, linear_gaussian
>>> model = {"F": [[0.9]], "Q": [[0.25]], "H": [[1.0]], "R": [[1.0]], "m0": [0.0], "P0": [[1.0]]}
>>> states, ys = linear_gaussian(**model).simulate(20, seed=1)
>>> exact = kalman_filter(**model, observations=ys)
>>> state, _ = bootstrap(linear_gaussian(**model), n=10_000).run(ys, seed=0)
>>> bool(abs(state.log_evidence - exact.log_evidence[-1]) < 0.05)
True

`hidden_markov` and `forward_backward` do the same for a chain of K states (Rabiner 1989).

A missing observation is None. Matrices that change with time have a first axis of length T. Entry t of F, Q and B
belongs to the transition from x_{t-1} to x_t, and entry 0 is not used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.inputs import AtStep, check_observations, missing_input, split_input
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.models.distributions import as_distribution
from mstfilter.smc.models.gaussian import entry, nonlinear_gaussian, vector_of
from mstfilter.smc.models.state_space import StateSpaceModel


def linear_gaussian(F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any, B: Any = None) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = F x_{t-1} + B u_t + N(0, Q), y_t = H x_t + N(0, R); particles are (n, d).

    The matrices may have a first axis of length T. Entry t of `H` and `R` belongs to y_t. With `B` (d, j), each step
    after the first needs an input (j,), see `WithInput`. `Q` and `P0` may be singular (see `nonlinear_gaussian`).
    `kalman_filter` computes the exact posteriors.

    Raises InputError if shapes do not fit, if a matrix has no entry for a step, or if a required input is missing.
    """
    m = _matrices(F, Q, H, R, m0, P0, B)
    model = _Linear(m["F"], m["H"], None if B is None else m["B"])
    return nonlinear_gaussian(model.f, Q, model.h, R, m0, P0)


@dataclass(frozen=True, eq=False)
class _Linear(AtStep):
    """The functions f and h of a linear model, whose matrices may have a first axis of steps."""

    F: np.ndarray
    H: np.ndarray
    B: np.ndarray | None
    t: int = 0
    u: Any = None

    @property
    def depends_on_step(self) -> bool:
        return self.B is not None or self.F.ndim == 3 or self.H.ndim == 3

    def at_step(self, t: int, u: Any = None) -> _Linear:
        return replace(self, t=t, u=u)

    def f(self, x: np.ndarray) -> np.ndarray:
        moved = x @ _entry("F", self.F, self.t).T
        if self.B is None:
            return moved
        if self.u is None:
            raise missing_input(self.t)
        return moved + _input_effect(_entry("B", self.B, self.t), self.u)

    def h(self, x: np.ndarray) -> np.ndarray:
        return x @ _entry("H", self.H, self.t).T


def _matrices(
    F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any, B: Any, n_steps: int | None = None
) -> dict[str, np.ndarray]:
    """Checked matrices of a linear model. A first axis of steps must have length `n_steps` (None: any length)."""
    start = np.asarray(m0, np.float64)
    if start.ndim != 1:
        raise InputError(f"m0 has shape {start.shape}, expected one number per entry of the state: (d,)")
    d, k, j = len(start), np.atleast_2d(H).shape[-2], np.atleast_1d(B).shape[-1]
    found = {"m0": start}
    shapes = {"F": (d, d), "Q": (d, d), "H": (k, d), "R": (k, k), "P0": (d, d), "B": (d, j)}
    for name, given in {"F": F, "Q": Q, "H": H, "R": R, "P0": P0, "B": B}.items():
        array, shape = np.asarray(given, np.float64), shapes[name]
        steps = array.shape[:1] if n_steps is None else (n_steps,)
        if given is not None and array.shape != shape and (name == "P0" or array.shape != (*steps, *shape)):
            raise InputError(f"{name} has shape {array.shape}, expected {shape} as m0 and H, or one for each step")
        found[name] = array
    return found


def _entry(name: str, given: np.ndarray, t: int) -> np.ndarray:
    """The matrix of step t."""
    return given if given.ndim == 2 else entry(name, given, t)


def _input_effect(B: np.ndarray, u: Any) -> np.ndarray:
    """B u (d,), computed without BLAS. The rounding of BLAS depends on the number of rows."""
    u = vector_of("the input", u, B.shape[1])
    return (B * u[..., None, :]).sum(axis=-1)


class Kalman(NamedTuple):
    """Exact posteriors and evidence of a linear-Gaussian model."""

    means: np.ndarray  #: (T, d) E[x_t | y_0 .. y_t]
    covariances: np.ndarray  #: (T, d, d) Cov[x_t | y_0 .. y_t]
    smoothed_means: np.ndarray  #: (T, d) E[x_t | y_0 .. y_{T-1}]
    smoothed_covariances: np.ndarray  #: (T, d, d) Cov[x_t | y_0 .. y_{T-1}]
    log_evidence: np.ndarray  #: (T,) log p(y_0 .. y_t)


def kalman_filter(
    F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any, observations: Iterable[Any], B: Any = None
) -> Kalman:
    """Kalman filter and Rauch-Tung-Striebel smoother. Observations are (k,), or None if missing.

    The arguments are as in `linear_gaussian`. Matrices that change with time have a first axis of length T. With `B`,
    give each observation with its input as `WithInput`. The recursions are those of square roots of covariances by QR
    decompositions (Kailath, Sayed, Hassibi 2000, section 12.1), so entries of the state may have very different
    scales. `Q`, `R` and `P0` may be singular.

    Raises InputError if shapes do not fit, a covariance is not positive semidefinite, an input is missing, an
    observation is not finite, or the covariance of an observation is singular.
    """
    given = [split_input(y) for y in check_observations(observations)]
    T, found = len(given), _matrices(F, Q, H, R, m0, P0, B, len(given))
    found |= {name: _root(name, found[name]) for name in ("Q", "R", "P0")}
    m = {name: np.broadcast_to(found[name], (T, *found[name].shape[-2:])) for name in "FQHR"}
    d, k = len(found["m0"]), m["H"].shape[1]
    means, roots, total = np.empty((T, d)), np.empty((T, d, d)), np.zeros(T)
    moves = []  # means of x_{t+1}, and roots of the joint covariances of x_{t+1} and x_t, given y_0 .. y_t
    x, root = found["m0"], found["P0"]  # the covariance of x is root root'
    for t, (y, u) in enumerate(given):
        total[t] = total[t - 1] if t else 0.0
        if t:
            if B is not None and u is None:
                raise InputError(f"observation {t} has no input", "with B, give WithInput(y, u)")
            x = m["F"][t] @ x + (0.0 if B is None else _input_effect(_entry("B", found["B"], t), u))
            joint = _triangular([[m["F"][t] @ root, m["Q"][t]], [root, np.zeros((d, d))]])
            moves.append((x, joint))
            root = joint[:d, :d]
        if y is not None:
            joint = _triangular([[m["R"][t], m["H"][t] @ root], [np.zeros((d, k)), root]])
            S, root = joint[:k, :k], joint[k:, k:]
            if (abs(np.diag(S)) <= 1e-14 * np.linalg.norm(S, axis=1)).any():
                raise InputError(f"the covariance H P H' + R of observation {t} is singular", "is R too small?")
            observed = vector_of(f"observation {t}", y, k)
            if not np.isfinite(observed).all():
                hint = "one that is missing is None"
                raise InputError(f"observation {t} is {observed.tolist()}, expected finite numbers", hint)
            z = np.linalg.solve(S, observed - m["H"][t] @ x)
            x = x + joint[k:, :k] @ z
            total[t] -= 0.5 * (z @ z + k * np.log(2 * np.pi)) + np.log(abs(np.diag(S))).sum()
        means[t], roots[t] = x, root
    smoothed, smoothed_roots = means.copy(), roots.copy()
    for t in range(T - 2, -1, -1):
        predicted, joint = moves[t]
        later, cross = joint[:d, :d], joint[d:, :d]
        size = np.maximum(np.linalg.norm(later, axis=1), np.finfo(float).tiny)
        inverse = np.linalg.pinv(later / size[:, None], rcond=1e-12) / size
        smoothed[t] = means[t] + cross @ (inverse @ (smoothed[t + 1] - predicted))
        free = cross - cross @ inverse @ later  # parts that x_{t+1} does not determine
        smoothed_roots[t] = _triangular([[joint[d:, d:], free, cross @ inverse @ smoothed_roots[t + 1]]])
    covariances = (r @ np.swapaxes(r, -1, -2) for r in (roots, smoothed_roots))
    return Kalman(means, next(covariances), smoothed, next(covariances), total)


def _root(name: str, cov: np.ndarray) -> np.ndarray:
    """Square roots of covariances (..., n, n), from the eigenvalues of the correlations."""
    sd = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
    sd = np.where(sd > 0, sd, 1.0)
    values, axes = np.linalg.eigh(cov / sd[..., None] / sd[..., None, :])
    if not np.allclose(cov, np.swapaxes(cov, -1, -2)) or (values < -1e-10).any():
        raise InputError(f"{name} is {cov.tolist()}, expected a covariance: symmetric and positive semidefinite")
    return sd[..., None] * axes * np.sqrt(np.where(values > 1e-15, values, 0.0))[..., None, :]


def _triangular(blocks: list[list[np.ndarray]]) -> np.ndarray:
    """The lower triangular L with L L' = M M', for a matrix M of blocks."""
    upper: Any = np.linalg.qr(np.block(blocks).T, mode="r")
    return upper.T


def hidden_markov(initial: Any, transition: Any, emission: Any) -> StateSpaceModel:
    """A hidden Markov model with K states. Particles are (n,) int from 0 to K - 1.

    Parameters
    ----------
    initial : (K,) array_like
        Probabilities of x_0.
    transition : (K, K) array_like
        Row i holds the probabilities of x_t given x_{t-1} = i.
    emission : Distribution or callable
        The distribution of y_t, with one row for each state: ``Normal([0.0, 3.0], 1.0)``, or ``Categorical(p)`` with
        the probabilities (K, m) of m symbols. Or a function ``log_likelihood(y)`` (K,) that returns log p(y_t | x_t)
        for each state, -inf if the state cannot produce y_t; it may also have the parameters ``t`` and ``u``. Only
        a distribution can be simulated.

    `forward_backward` computes the exact posteriors.
    """
    start, moves = _chain(initial, transition)
    # The last positive entry is 1 exactly, so that u < 1 never selects a state of probability 0.
    below_start, below = (np.cumsum(p, axis=-1) / p.sum(axis=-1, keepdims=True) for p in (start, moves))
    for cumulative in (below_start, below):
        cumulative[cumulative >= cumulative[..., -1:]] = 1.0
    with np.errstate(divide="ignore"):
        log_start, log_moves = np.log(start), np.log(moves)

    states = _States.of(emission, len(start))
    return StateSpaceModel(
        lambda rng, n: (below_start <= rng.random(n)[:, None]).sum(axis=-1),
        lambda rng, x: (below[x] <= rng.random(len(x))[:, None]).sum(axis=-1),
        states.of_particles,
        lambda x: log_start[x],
        lambda old, new: log_moves[old, new],
        None if states.emission is None else states.sample_observation,
    )


def _chain(initial: Any, transition: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checked probabilities of the first state (K,), and of the transitions (K, K)."""
    found = []
    for name, given, axes in (("initial", initial, 1), ("transition", transition, 2)):
        p = np.asarray(given, dtype=np.float64)
        if p.ndim != axes or not p.size:
            raise InputError(f"{name} has shape {p.shape}, expected {'(K,)' if name == 'initial' else '(K, K)'}")
        if not ((p >= 0).all() and np.allclose(p.sum(axis=-1), 1.0)):
            raise InputError(f"{name} is {p.tolist()}, expected probabilities that sum to 1 in each row")
        found.append(p)
    start, moves = found
    if moves.shape != (len(start),) * 2:
        raise InputError(f"transition has shape {moves.shape}, expected {(len(start),) * 2} as initial")
    return start, moves


class Marginals(NamedTuple):
    """Exact posteriors and evidence of a model with K states."""

    filtered: np.ndarray  #: (T, K) p(x_t | y_0 .. y_t)
    smoothed: np.ndarray  #: (T, K) p(x_t | y_0 .. y_{T-1})
    log_evidence: np.ndarray  #: (T,) log p(y_0 .. y_t)


def forward_backward(initial: Any, transition: Any, emission: Any, observations: Iterable[Any]) -> Marginals:
    """The forward-backward algorithm (Rabiner 1989), with the arguments of `hidden_markov`.

    Raises InputError if a shape does not fit, or if an observation has probability 0.
    """
    from scipy.special import logsumexp

    with np.errstate(divide="ignore"):
        start, moves = map(np.log, _chain(initial, transition))
    ys = [split_input(y) for y in check_observations(observations)]
    T, K, states = len(ys), len(start), _States.of(emission, len(start))
    log_filtered, seen, total = np.empty((T, K)), np.zeros((T, K)), np.zeros(T)
    for t, (y, u) in enumerate(ys):
        total[t] = total[t - 1] if t else 0.0
        predicted = logsumexp(log_filtered[t - 1][:, None] + moves, axis=0) if t else start
        if y is not None:
            seen[t] = np.where(predicted > -np.inf, states.at_step(t, u).of_all(y), -np.inf)
        gain = logsumexp(predicted + seen[t])
        if not np.isfinite(gain):
            raise InputError(f"observation {t} is {y!r}: no state that is possible there explains it")
        total[t] += gain
        log_filtered[t] = predicted + seen[t] - gain
    log_smoothed, later = log_filtered.copy(), np.zeros(K)  # later is log p(y_{t+1} .. | x_t)
    for t in range(T - 2, -1, -1):
        later = logsumexp(moves + seen[t + 1] + later, axis=1)
        log_smoothed[t] += later - logsumexp(log_filtered[t] + later)
    return Marginals(np.exp(log_filtered), np.exp(log_smoothed), total)


@dataclass(frozen=True)
class _States(AtStep):
    """The log likelihoods of K states, and the distribution of observations if it is known."""

    log_likelihood: Callable[..., Any]
    K: int
    emission: Distribution | None = None
    step_functions: ClassVar = {"log_likelihood": 1}

    @classmethod
    def of(cls, emission: Any, K: int) -> _States:
        """From a function, or from a distribution with K rows."""
        if callable(emission):
            return cls(emission, K)
        given = as_distribution(emission)
        if given.parameter_shape[:1] != (K,):
            raise InputError(
                f"emission has parameters of shape {given.parameter_shape}, expected one row per state: {K}"
            )
        return cls(given.log_prob, K, given)

    def sample_observation(self, rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
        """(n, ...) an observation of each particle: of draws for all states, that of its own."""
        assert self.emission is not None
        return np.stack([self.emission.sample(rng, self.K)[k] for k in x])

    def of_all(self, y: Any) -> np.ndarray:
        """(K,) log p(y | x) of each state."""
        found = np.asarray(self.log_likelihood(y), dtype=np.float64)
        if found.shape != (self.K,):
            raise InputError(
                f"log_likelihood returned shape {found.shape}, expected ({self.K},): one number per state"
            )
        return found

    def of_particles(self, x: np.ndarray, y: Any) -> np.ndarray:
        """(n,) log p(y | x) of particles, which are states."""
        return self.of_all(y)[x]
