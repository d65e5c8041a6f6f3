"""Metropolis-Hastings steps of many chains at once: `metropolis`, and a move for resample-move filters.

>>> def propose(rng, now):                           # a random walk on N(0, 1)
...     x = now + rng.standard_normal(len(now))
...     return x, 0.5 * (now**2 - x**2)
>>> for x, accepted in metropolis(rng, np.zeros(100), propose, steps=50):
...     pass

The same kernel moves particles (`RandomWalkMove`, and `ProgramMove` for programs), parameters (`pmmh` and
`smc_sampler`) and the ancestors of backward paths (`backward_paths`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from mstfilter.errors import InputError, check_component, check_integer
from mstfilter.smc.distributions import hypothetical
from mstfilter.smc.interfaces import Rejuvenation
from mstfilter.smc.population import Particles, Population
from mstfilter.smc.state_space import StateSpaceModel

State = TypeVar("State")


def choose_rows(accepted: np.ndarray, new: Any, old: Any) -> Any:
    """Rows of `new` where `accepted` is True, else of `old`: arrays, or mappings of such."""
    if isinstance(old, Mapping):
        return {name: choose_rows(accepted, new[name], a) for name, a in old.items()}
    return np.where(accepted.reshape(-1, *(1,) * (old.ndim - 1)), new, old)


def metropolis(
    rng: np.random.Generator,
    state: State,
    propose: Callable[[np.random.Generator, State], tuple[State, np.ndarray]],
    steps: int = 1,
    choose: Callable[[np.ndarray, State, State], State] = choose_rows,
) -> Iterator[tuple[State, np.ndarray]]:
    """Metropolis-Hastings steps of n chains.

    Parameters
    ----------
    state
        One row per chain: an array, or a mapping of arrays. It also holds the log densities, so that those of the
        present state are not evaluated again.
    propose : callable
        ``(rng, state) -> (new, log_ratio)``: a proposed state, and (n,) the log of p(new) q(old | new) / (p(old)
        q(new | old)). A ratio of NaN (both states are impossible) is rejected.
    choose : callable
        ``(accepted, new, old) -> state`` of new and old rows.

    Yields
    ------
    state, accepted
        After each step, and (n,) bool whether its proposal was accepted.
    """
    for _ in range(steps):
        new, log_ratio = propose(rng, state)
        accepted = np.log1p(-rng.random(len(log_ratio))) < log_ratio
        state = choose(accepted, new, state)
        yield state, accepted


def moved(
    rng: np.random.Generator,
    state: State,
    propose: Callable[[np.random.Generator, State], tuple[State, np.ndarray]],
    steps: int,
    choose: Callable[[np.ndarray, State, State], State] = choose_rows,
) -> tuple[State, float]:
    """The state after `steps` steps of `metropolis`, and the share of accepted proposals."""
    shares = []
    for after, accepted in metropolis(rng, state, propose, steps, choose):
        state = after
        shares.append(accepted.mean())
    return state, float(np.mean(shares))


@dataclass(frozen=True)
class RandomWalkMove(Rejuvenation):
    """Metropolis steps with Gaussian increments on an array of particles; ``notes["accepted"]`` is their rate.

    After a resampling several particles share a parent. The move separates them by a Markov kernel that leaves
    p(x_t | x_{t-1}, y_t) invariant; the weights do not change.

    Parameters
    ----------
    model : StateSpaceModel
        With its log densities. Particles are floating-point arrays (n,) or (n, d), or mappings of such.
    scale : float or array_like
        Standard deviation of a step, in the units of the state. Fixed, so that the evidence is unbiased.
    steps : int
        Metropolis steps per move.
    """

    model: StateSpaceModel
    scale: Any = 1.0
    steps: int = 1
    step_functions: ClassVar = {"model": None}

    def __post_init__(self) -> None:
        check_component("model", self.model, StateSpaceModel)
        check_integer("steps", self.steps)
        scale = np.asarray(self.scale, dtype=np.float64)
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise InputError(f"scale is {self.scale!r}, expected positive finite numbers")

    def move(
        self, rng: np.random.Generator, population: Population, previous: Population | None, observation: Any
    ) -> Population:
        def log_target(x: Any) -> np.ndarray:
            if previous is None:
                prior = self.model.density("log_initial")(x)
            else:
                prior = self.model.density("log_transition")(previous.particles, x)
            return prior if observation is None else prior + self.model.log_likelihood(x, observation)

        def propose(rng: np.random.Generator, now: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray]:
            x = self._step(rng, now["x"])
            with hypothetical():
                log_p = log_target(x)
                return {"x": x, "log_p": log_p}, log_p - now["log_p"]

        start = {"x": population.particles, "log_p": log_target(population.particles)}
        state, share = moved(rng, start, propose, self.steps)
        return Population(state["x"], population.log_weights, population.parents, {"accepted": share})

    def _step(self, rng: np.random.Generator, x: Particles) -> Particles:
        if isinstance(x, np.ndarray):
            return x + self.scale * rng.standard_normal(x.shape)
        return {name: self._step(rng, a) for name, a in x.items()}
