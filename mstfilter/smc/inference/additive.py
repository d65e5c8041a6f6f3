"""Smoothed sums over the path, while the observations arrive.

Many questions about the past are sums over time: the number of jumps so far, the distance travelled, the statistics
of the EM algorithm. For a sum S_t = h(x_0) + h(x_0, x_1) + .. + h(x_{t-1}, x_t), it is enough to keep for each
particle the expectation of the sum given that the path ends there:

    S_t(x_t) = sum_i p_i (S_{t-1}(x_i) + h(x_i, x_t)),     p_i proportional to w_i f(x_t | x_i)

These sums take n^2 densities per step (Del Moral, Doucet, Singh 2010). PaRIS replaces each by the mean over two draws
of i, which is enough to keep the variance bounded (Olsson and Westerborn 2017). No population but the last is stored.

>>> import numpy as np
>>> from mstfilter.smc import Dynamics, Normal, StateSpaceModel, additive, bootstrap
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> def squared_step(previous, x):
...     return np.zeros(len(x)) if previous is None else (x - 0.9 * previous) ** 2
>>> for total in additive(bootstrap(model, n=500), [0.3, -0.1, 0.8], squared_step, Dynamics(model)):
...     pass                                            # E[sum of squared noise up to t | y_0 .. y_t]
>>> bool(abs(total - 0.5) < 0.1)
True
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal, get_args

import numpy as np

from mstfilter.base.errors import InputError, check_choice, check_integer
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inference.smoothing import Backward, BackwardMethod, Moves
from mstfilter.smc.inputs import bind_step, check_observations, check_signature, split_input, step_parameters
from mstfilter.smc.interfaces import DensityTransition, State
from mstfilter.smc.population import Particles, Population, take

AdditiveMethod = Literal["paris", "forward", "genealogy"]


def additive(
    filter: ParticleFilter,
    observations: Iterable[Any],
    function: Callable[..., np.ndarray],
    transition: DensityTransition | None = None,
    seed: int | State = 0,
    method: AdditiveMethod = "paris",
    *,
    draws: int = 2,
    backward: BackwardMethod = "exact",
    steps: int = 1,
    log_bound: float | None = None,
) -> Iterator[np.ndarray]:
    """Yield, after each observation, E[h(x_0) + h(x_0, x_1) + .. + h(x_{t-1}, x_t) | y_0 .. y_t].

    Parameters
    ----------
    filter : ParticleFilter
        Any properly weighted filter of the model.
    function : callable
        ``(previous, particles) -> (n, ...)``: h for n pairs of states. `previous` is None at the first step. A
        parameter ``t`` gets the index of the step, and ``u`` its input.
    transition : DensityTransition, optional
        The transition of the model, ``Dynamics(model)``. Not needed for "genealogy".
    method : "paris", "forward" or "genealogy"
        "paris" takes the mean over `draws` predecessors of each particle, at least 2 for a bounded variance.
        "forward" computes the sums over all predecessors, with n^2 densities. "genealogy" takes the parent of each
        particle: it needs no density, and its variance grows with the square of t.
    backward, steps, log_bound
        How "paris" draws predecessors: `method` and the other arguments of `backward_paths`. With n particles, "mcmc"
        and "rejection" take a time proportional to n.
    """
    check_choice("method", method, get_args(AdditiveMethod))
    check_integer("draws", draws)
    check_signature("function", function, 2)
    if method != "genealogy" and transition is None:
        raise InputError(f"the method {method} needs the transition of the model", "transition=Dynamics(model)")
    kernel = None if transition is None else Backward(transition, backward, steps, log_bound)
    state, sums = seed if isinstance(seed, State) else filter.start(seed), None
    names = step_parameters(function, 2)
    for observation in check_observations(observations):
        past = state.population
        state, _ = filter.step(state, observation)
        population, t = state.population, state.t - 1
        assert population is not None
        h = bind_step(function, names, t, split_input(observation)[1])
        if past is None or sums is None:
            sums = _rows(h(None, population.particles), len(population))
        elif method == "genealogy":
            sums = _through(population.known_parents()[None], past, population.particles, sums, h)
        else:
            assert kernel is not None
            moves = kernel.moves(past, population.particles, observation, t - 1)
            if method == "forward":
                sums = _over_all(moves, sums, h)
            else:
                rng = state.key.child("backward", t).generator()
                index = moves.draw(rng, population.known_parents() if backward == "mcmc" else None, draws)
                sums = _through(index, past, population.particles, sums, h)
        yield np.tensordot(population.weights, sums, axes=1)


def _through(index: np.ndarray, past: Population, later: Particles, sums: np.ndarray, h: Any) -> np.ndarray:
    """(n, ...) the means of the sums over the predecessors `index` (draws, n) of each later particle."""
    draws, n = index.shape
    flat = index.ravel()
    repeated = later if draws == 1 else take(later, np.tile(np.arange(n), draws))
    found = sums[flat] + _rows(h(take(past.realised().particles, flat), repeated), len(flat))
    return found.reshape(draws, n, *found.shape[1:]).mean(axis=0)


def _over_all(moves: Moves, sums: np.ndarray, h: Any) -> np.ndarray:
    """(n, ...) the expected sums over all predecessors of each later particle."""
    parts, m = [], len(sums)
    past = moves.population.realised().particles
    for rows, log_weights in moves.blocks(np.arange(len(moves))):
        weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
        weights /= weights.sum(axis=1, keepdims=True)
        pairs = take(past, np.tile(np.arange(m), len(rows))), take(moves.later, np.repeat(rows, m))
        added = _rows(h(*pairs), len(rows) * m).reshape(len(rows), m, *sums.shape[1:])
        parts.append(np.einsum("ij,ij...->i...", weights, sums + added))
    return np.concatenate(parts)


def _rows(found: Any, n: int) -> np.ndarray:
    values = np.asarray(found, np.float64)
    if values.shape[:1] != (n,):
        raise InputError(f"the function returned shape {values.shape}, expected one row for each of {n} pairs")
    return values
