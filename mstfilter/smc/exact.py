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
from mstfilter.smc.inputs import AtStep, bind_step, check_observations, split_input, step_parameters, with_step
from mstfilter.smc.interfaces import Proposal, Transition, Update
from mstfilter.smc.population import Population, union
from mstfilter.smc.state_space import StateSpaceModel
from mstfilter.smc.streams import Rows

_Map = Callable[[np.ndarray], np.ndarray]  #: of particles (n, d)


def linear_gaussian(F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any, B: Any = None) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = F x_{t-1} + B u_t + N(0, Q), y_t = H x_t + N(0, R); particles are (n, d).

    The matrices may have a first axis of T entries: entry t of `F`, `B` and `Q` moves x_{t-1} to x_t, entry 0 is not
    used; entry t of `H` and `R` belongs to y_t. With `B` (d, j), each step after the first needs an input (j,), see
    `WithInput`. `Q` and `P0` may be singular (see `nonlinear_gaussian`). `kalman_filter` has the exact answers.

    Raises InputError if a shape does not fit, and in a step if there is no entry for it or no input.
    """
    m0 = np.asarray(m0, np.float64)
    if m0.ndim != 1:
        raise InputError(f"m0 has shape {m0.shape}, expected one number per entry of the state: (d,)")
    F, H, B = _linear(F, H, B, len(m0))
    k = H.shape[-2]
    for name, given, size in (("R", R, k), ("Q", Q, len(m0))):
        if np.shape(given)[-2:] != (size, size):
            raise InputError(f"{name} has shape {np.shape(given)}, expected ({size}, {size}) as m0 and H")

    def f(x: np.ndarray, **step: Any) -> np.ndarray:
        moved = x @ _entry("F", F, **step).T
        return moved if B is None else moved + _input_effect(_entry("B", B, **step), step["u"])

    def h(x: np.ndarray, **step: Any) -> np.ndarray:
        return x @ _entry("H", H, **step).T

    of_step = {**_varies(F, B), **({} if B is None else {"u": True})}
    return nonlinear_gaussian(
        with_step(f, of_step) if of_step else lambda x: x @ F.T,
        Q,
        with_step(h, {"t": True}) if H.ndim == 3 else lambda x: x @ H.T,
        R,
        m0,
        P0,
    )


def _linear(F: Any, H: Any, B: Any, d: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Checked matrices of a linear model, possibly with a first axis of times."""
    matrices = []
    for name, given, n_rows in (("F", F, d), ("H", H, None), ("B", B, d)):
        array = None if given is None else np.asarray(given, np.float64)
        if array is not None:
            rows, columns = array.shape[-2:] if array.ndim in (2, 3) else (-1, -1)
            if rows != (n_rows or rows) or (name != "B" and columns != d) or rows < 0:
                expected = f"({n_rows or 'k'}, {'j' if name == 'B' else d})"
                raise InputError(f"{name} has shape {array.shape}, expected {expected} as m0 has {d} entries")
        matrices.append(array)
    return tuple(matrices)  # type: ignore[return-value]


def _varies(*arrays: np.ndarray | None) -> dict[str, bool]:
    """The parameter t, for a function of matrices of which one changes with time."""
    return {"t": True} if any(a is not None and a.ndim == 3 for a in arrays) else {}


def _entry(name: str, given: Any, t: int = 0, u: Any = None) -> Any:
    """The matrix of step t, or the entry of a list."""
    if isinstance(given, np.ndarray) and given.ndim == 2:
        return given
    if t >= len(given):
        raise InputError(f"{name} has {len(given)} entries, and none for step {t}")
    return given[t]


def _input_effect(B: np.ndarray, u: Any) -> np.ndarray:
    """B u (d,), or (m, d) for one input for each row. Without BLAS, whose rounding depends on the number of rows."""
    u = _vectors("input", u, B.shape[1])
    return (B * u[..., None, :]).sum(axis=-1)


def _vectors(what: str, given: Any, size: int) -> np.ndarray:
    """An observation or input (size,) of all particles, or (m, size) of the rows of a batch."""
    vector = np.asanyarray(given, np.float64)
    if vector.shape == (size,) and not isinstance(vector, Rows):
        return vector
    by_row = isinstance(vector, Rows)
    if vector.ndim == by_row:
        vector = vector[..., None]
    if vector.shape[by_row:] != (size,):
        raise InputError(f"the {what} has shape {vector.shape[by_row:]}, expected ({size},)")
    return vector


class _Noise:
    """Normal noise of mean 0."""

    def __init__(self, name: str, cov: np.ndarray, k: int | None, semidefinite: bool) -> None:
        root, self.singular = _covariance(name, cov, k, semidefinite)
        self.size, self.root = len(root), root.T
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


def _noises(name: str, given: Any, k: int | None = None, semidefinite: bool = False) -> list[_Noise]:
    """The noise of all steps, or one for each entry of the first axis of a covariance (T, k, k)."""
    cov = np.asarray(given, np.float64)
    return [_Noise(name, matrix, k, semidefinite) for matrix in (cov if cov.ndim == 3 else cov[None])]


def _gaussian_functions(f: _Map, h: _Map, q: _Noise, r: _Noise) -> tuple[Callable[..., Any], ...]:
    """Transition, log likelihood and log density of the transition."""

    def transition(rng: np.random.Generator, x: np.ndarray) -> np.ndarray:
        return f(x) + q.draw(rng, len(x))

    def log_likelihood(x: np.ndarray, y: Any) -> np.ndarray:
        return r.log_prob(_vectors("observation", y, r.size) - h(x))

    def log_transition(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        return q.log_prob(new - f(old))

    return transition, log_likelihood, log_transition


def nonlinear_gaussian(
    f: Callable[..., Any], Q: Any, h: Callable[..., Any], R: Any, m0: Any, P0: Any
) -> StateSpaceModel:
    """x_0 ~ N(m0, P0), x_t = f(x_{t-1}) + N(0, Q), y_t = h(x_t) + N(0, R).

    `f` and `h` give the next states (n, d), and the observations (n, k) without noise, of particles (n, d), row by
    row. They may have the further parameters ``t`` and ``u``; `Q` and `R` may have a first axis of T entries.

    `Q` and `P0` may be singular, as that of noise that acts on the velocity only. x_t then has no density given
    x_{t-1}: the model has no `log_transition` (for `P0`: no `log_initial`), and what needs it raises InputError. A
    conditional path is then drawn without ancestor sampling.
    """
    m0 = np.asarray(m0, np.float64)
    Qs, Rs = _noises("Q", Q, len(m0), True), _noises("R", R)
    p = _Noise("P0", np.asarray(P0, np.float64), len(m0), True)
    in_f, in_h = step_parameters(f, 1), step_parameters(h, 1)
    functions = _gaussian_functions(f, h, Qs[0], Rs[0])
    moves = {**in_f, **({"t": True} if np.ndim(Q) == 3 else {})}
    sees = {**in_h, **({"t": True} if np.ndim(R) == 3 else {})}

    def of_step(which: int, parameters: dict[str, bool]) -> Callable[..., Any]:
        def function(*args: Any, t: int = 0, u: Any = None) -> Any:
            q, r = (_entry(name, of, t) if len(of) > 1 else of[0] for name, of in (("Q", Qs), ("R", Rs)))
            bound = bind_step(f, in_f, t, u), bind_step(h, in_h, t, u), q, r
            return _gaussian_functions(*bound)[which](*args)

        return with_step(function, parameters) if parameters else functions[which]

    return StateSpaceModel(
        lambda rng, n: m0 + p.draw(rng, n),
        of_step(0, moves),
        of_step(1, sees),
        None if p.singular else lambda x: p.log_prob(x - m0),
        None if any(q.singular for q in Qs) else of_step(2, moves),
        batched=True,
    )


def _covariance(name: str, given: Any, d: int | None = None, semidefinite: bool = False) -> tuple[np.ndarray, bool]:
    """A square root of a covariance: the Cholesky factor, or one by eigenvalues if it is singular; whether it is."""
    cov = np.asarray(given, dtype=np.float64)
    if cov.ndim != 2 or cov.shape != (d or len(cov), d or len(cov)):
        expected = "(k, k)" if d is None else f"({d}, {d}) as m0 has {d} entries"
        raise InputError(f"{name} has shape {cov.shape}, expected {expected}")
    if np.allclose(cov, cov.T):
        values, vectors = np.linalg.eigh(cov)
        rounding = 1e-14 * max(values.max(), 0.0)
        if (values > rounding).all():
            return np.linalg.cholesky(cov), False
        if semidefinite and (values >= -rounding).all():
            return vectors * np.sqrt(np.maximum(values, 0.0)), True
    kind = "semidefinite" if semidefinite else "definite"
    raise InputError(f"{name} is {cov.tolist()}, expected a covariance: symmetric and positive {kind}")


def _definite(name: str, given: Any) -> np.ndarray:
    """A covariance that must be positive definite."""
    _covariance(name, given)
    return np.asarray(given, np.float64)


class Kalman(NamedTuple):
    """Exact answers of a linear-Gaussian model."""

    means: np.ndarray  #: (T, d) E[x_t | y_0 .. y_t]
    covariances: np.ndarray  #: (T, d, d) Cov[x_t | y_0 .. y_t]
    smoothed_means: np.ndarray  #: (T, d) E[x_t | y_0 .. y_{T-1}]
    smoothed_covariances: np.ndarray  #: (T, d, d) Cov[x_t | y_0 .. y_{T-1}]
    log_evidence: np.ndarray  #: (T,) log p(y_0 .. y_t)


def kalman_filter(
    F: Any, Q: Any, H: Any, R: Any, m0: Any, P0: Any, observations: Iterable[Any], B: Any = None
) -> Kalman:
    """The Kalman filter and the Rauch-Tung-Striebel smoother of filterpy, of (k,) observations; None if missing.

    The arguments are as in `linear_gaussian`; matrices that change have T entries. With `B` the inputs are given with
    the observations, by `WithInput`. Raises InputError if a shape does not fit, an input is not given or an
    observation is not finite.
    """
    from filterpy.kalman import KalmanFilter

    given = [split_input(y) for y in check_observations(observations)]
    m0, P0 = np.asarray(m0, dtype=np.float64), np.asarray(P0, dtype=np.float64)
    T, d, k = len(given), len(m0), np.shape(H)[-2]
    matrices = {}
    for name, value, shape in (("F", F, (d, d)), ("Q", Q, (d, d)), ("H", H, (k, d)), ("R", R, (k, k))):
        array = np.asarray(value, dtype=np.float64)
        if array.shape not in (shape, (T, *shape)):
            raise InputError(f"{name} has shape {array.shape}, expected {shape} or {(T, *shape)}")
        matrices[name] = np.broadcast_to(array, (T, *shape))
    if P0.shape != (d, d):
        raise InputError(f"P0 has shape {P0.shape}, expected {(d, d)} as m0 has {d} entries")
    # x_t - offset_t has no input, and the same covariances.
    offsets = _offsets(matrices["F"], B, [u for _, u in given])
    kf = KalmanFilter(dim_x=d, dim_z=k)
    kf.x, kf.P = m0.copy(), P0.copy()
    means, covariances, total = np.empty((T, d)), np.empty((T, d, d)), np.zeros(T)
    for t, (y, _) in enumerate(given):
        total[t] = total[t - 1] if t else 0.0
        kf.F, kf.Q, kf.H, kf.R = (matrices[name][t] for name in "FQHR")
        if t:
            kf.predict()
        if y is not None:
            kf.update(_observed(t, y, k) - kf.H @ offsets[t])
            total[t] += kf.log_likelihood
        means[t], covariances[t] = kf.x, kf.P
    smoothed = means, covariances
    if T > 1:
        moves = list(matrices["F"]), list(matrices["Q"])
        smoothed = kf.rts_smoother(means, covariances, *moves, inv=_inverse)[:2]
    return Kalman(means + offsets, covariances, smoothed[0] + offsets, smoothed[1], total)


def _inverse(cov: np.ndarray) -> np.ndarray:
    """The inverse of a covariance; the pseudo-inverse if it is singular, as a condition on its range needs."""
    values = np.linalg.eigvalsh(cov)
    if values.min() > 1e-12 * values.max():
        return np.linalg.inv(cov)
    return np.linalg.pinv(cov, rcond=1e-12, hermitian=True)


def _observed(t: int, y: Any, k: int) -> np.ndarray:
    vector = np.atleast_1d(np.asarray(y, dtype=np.float64))
    if vector.shape != (k,):
        raise InputError(f"observation {t} has shape {vector.shape}, expected ({k},)")
    if not np.isfinite(vector).all():
        raise InputError(
            f"observation {t} is {vector.tolist()}, expected finite numbers", "one that is missing is None"
        )
    return vector


def _offsets(F: np.ndarray, B: Any, inputs: list[Any]) -> np.ndarray:
    """(T, d) the effect of all inputs so far on the state."""
    T, d = F.shape[:2]
    found = np.zeros((T, d))
    if B is None:
        return found
    B = np.asarray(B, np.float64)
    if B.ndim not in (2, 3) or B.shape[-2] != d or (B.ndim == 3 and len(B) != T):
        raise InputError(f"B has shape {B.shape}, expected ({d}, j) or ({T}, {d}, j)")
    for t in range(1, T):
        if inputs[t] is None:
            raise InputError(f"observation {t} has no input", "with B, give WithInput(y, u)")
        found[t] = F[t] @ found[t - 1] + _input_effect(_entry("B", B, t), inputs[t])
    return found


def hidden_markov(initial: Any, transition: Any, log_likelihood: Callable[..., Any]) -> StateSpaceModel:
    """A model with K states 0 .. K-1; particles are (n,) int. `forward_backward` has the exact answers.

    `initial` (K,) has the probabilities of x_0, row i of `transition` (K, K) those of x_t given x_{t-1} = i. With a
    first axis of T entries, entry t moves x_{t-1} to x_t; entry 0 is not used. ``log_likelihood(y)`` (K,) is
    log p(y_t | x_t = 0 .. K-1); -inf if impossible. It may have the further parameters ``t`` and ``u``.
    """
    start, moves = _chain(initial, transition)
    # The last positive entry is 1 exactly, so that u < 1 never selects a state of probability 0.
    below_start, below = (np.cumsum(p, axis=-1) / p.sum(axis=-1, keepdims=True) for p in (start, moves))
    for cumulative in (below_start, below):
        cumulative[cumulative >= cumulative[..., -1:]] = 1.0
    with np.errstate(divide="ignore"):
        log_start, log_moves = np.log(start), np.log(moves)

    def move(rng: np.random.Generator, x: np.ndarray, **step: Any) -> np.ndarray:
        return (_entry("transition", below, **step)[x] <= rng.random(len(x))[:, None]).sum(axis=-1)

    def log_move(old: np.ndarray, new: np.ndarray, **step: Any) -> np.ndarray:
        return _entry("transition", log_moves, **step)[old, new]

    def weigh(x: np.ndarray, y: Any, **step: Any) -> np.ndarray:
        return np.asarray(log_likelihood(y, **step), dtype=np.float64)[x]

    return StateSpaceModel(
        lambda rng, n: (below_start <= rng.random(n)[:, None]).sum(axis=-1),
        with_step(move, _varies(moves)),
        with_step(weigh, step_parameters(log_likelihood, 1)),
        lambda x: log_start[x],
        with_step(log_move, _varies(moves)),
        batched=None,
    )


def _chain(initial: Any, transition: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checked probabilities (K,) of the first state and (K, K), or (T, K, K), of the moves."""
    start, moves = _probabilities("initial", initial, 1), _probabilities("transition", transition, 2)
    if moves.shape[-2:] != (len(start),) * 2:
        raise InputError(f"transition has shape {moves.shape}, expected {(len(start),) * 2} as initial")
    return start, moves


def _probabilities(name: str, given: Any, ndim: int) -> np.ndarray:
    """Rows of probabilities that sum to one."""
    p = np.asarray(given, dtype=np.float64)
    if p.ndim not in ((1,) if ndim == 1 else (2, 3)) or not p.size:
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
    initial: Any, transition: Any, log_likelihood: Callable[..., Any], observations: Iterable[Any]
) -> Marginals:
    """The forward-backward algorithm of a model with K states (Rabiner 1989); arguments as in `hidden_markov`.

    Raises InputError if a shape does not fit, or no state explains an observation.
    """
    start, moves = _chain(initial, transition)
    ys = [split_input(y) for y in check_observations(observations)]
    T, K, of_step = len(ys), len(start), step_parameters(log_likelihood, 1)
    if moves.ndim == 3 and len(moves) != T:
        raise InputError(f"transition has {len(moves)} entries, expected one for each of {T} observations")
    moves = np.broadcast_to(moves, (T, K, K))
    filtered, likelihood, total = np.empty((T, K)), np.ones((T, K)), np.zeros(T)
    for t, (y, u) in enumerate(ys):
        predicted = filtered[t - 1] @ moves[t] if t else start
        total[t] = total[t - 1] if t else 0.0
        filtered[t] = predicted
        if y is None:
            continue
        found = np.asarray(bind_step(log_likelihood, of_step, t, u)(y), dtype=np.float64)
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
        later = moves[t + 1] @ (likelihood[t + 1] * later)
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
class ConditionallyLinear(AtStep):
    """A model that is linear and Gaussian given the part u, which is drawn.

    ``sample_initial(rng, n)`` draws u_0 (n, ...), ``sample_transition(rng, u)`` draws u_t given u_{t-1}, and
    ``linear(u)`` gives the matrices. `mean` (d,) and `cov` (d, d) are those of z_0, for any u_0. The functions may
    have a further parameter ``t``, the index of the step, or ``u`` after a first one of another name, its input.
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
    step_functions: ClassVar = {"model": None}

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
    Q, R = (_definite(name, given) for name, given in (("Q", Q), ("R", R)))

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

    Q, R = (_definite(name, given) for name, given in (("Q", Q), ("R", R)))
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
