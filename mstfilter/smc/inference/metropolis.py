"""Metropolis-Hastings steps of many chains at once.

A Metropolis kernel leaves a density p invariant, known up to a factor. It proposes a new state from
q and accepts it with probability min(1, p(new) q(old | new) / (p(old) q(new | old))); otherwise the chain stays. With
one chain for each row, all chains take a step in one call:

>>> import numpy as np
>>> from mstfilter.smc.inference.metropolis import moved
>>> def propose(rng, x):                                        # p is N(0, 1), q is symmetric
...     new = x + rng.standard_normal(x.shape)
...     return new, 0.5 * (x**2 - new**2)
>>> rng = np.random.default_rng(0)
>>> x, share = moved(rng, np.full(1000, 3.0), propose, steps=50)
>>> bool(abs(x.mean()) < 0.2), round(float(x.std()), 1)                 # however far they started
(True, 1.0)

`RandomWalkMove` uses the kernel as a move of a resample-move filter (Gilks and Berzuini 2001), and `pmmh` for
parameters of a model. Reference: Chopin and Papaspiliopoulos (2020), "An introduction to sequential Monte Carlo",
chapter 15.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import PositiveInt
from mstfilter.smc.interfaces import Rejuvenation
from mstfilter.smc.models.state_space import StateSpaceModel
from mstfilter.smc.population import Particles, Population

_Chains = TypeVar("_Chains")  # states of Markov chains


def choose_rows(accepted: np.ndarray, new: Any, old: Any) -> Any:
    """Row i of `new` if ``accepted[i]``, otherwise row i of `old`. Both are arrays or mappings of arrays."""
    if isinstance(old, Mapping):
        return {name: choose_rows(accepted, new[name], a) for name, a in old.items()}
    rows = accepted if old.ndim == 1 else accepted.reshape(-1, *(1,) * (old.ndim - 1))
    return np.where(rows, new, old)


def metropolis(
    rng: np.random.Generator,
    state: _Chains,
    propose: Callable[[np.random.Generator, _Chains], tuple[_Chains, np.ndarray]],
    steps: int = 1,
) -> Iterator[tuple[_Chains, np.ndarray]]:
    """Metropolis-Hastings steps of n chains.

    Parameters
    ----------
    state
        One row per chain: an array, or a mapping of arrays. The state can hold log densities, so that `propose`
        need not evaluate those of the present state again.
    propose : callable
        ``(rng, state) -> (new, log_ratio)``: a proposed state, and (n,) the log of p(new) q(old | new) / (p(old)
        q(new | old)). A proposal with a log ratio of NaN (both states are impossible) is rejected.

    Yields
    ------
    state, accepted
        After each step: the state, and (n,) bool whether the proposal of a chain was accepted.
    """
    for _ in range(steps):
        new, log_ratio = propose(rng, state)
        accepted = -rng.standard_exponential(len(log_ratio)) < log_ratio  # the log of a uniform number
        state = choose_rows(accepted, new, state)
        yield state, accepted


def moved(
    rng: np.random.Generator,
    state: _Chains,
    propose: Callable[[np.random.Generator, _Chains], tuple[_Chains, np.ndarray]],
    steps: int,
) -> tuple[_Chains, float]:
    """The state after `steps` steps of `metropolis`, and the share of accepted proposals."""
    taken = proposed = 0
    for after, accepted in metropolis(rng, state, propose, steps):
        state = after
        taken, proposed = taken + int(np.count_nonzero(accepted)), proposed + len(accepted)
    return state, taken / proposed


@dataclass(frozen=True)
class RandomWalkMove(Rejuvenation):
    """Metropolis steps with Gaussian increments on an array of particles.

    ``notes["accepted"]`` is the acceptance rate.

    The Metropolis kernel leaves p(x_t | x_{t-1}, y_t) invariant. The weights do not change.

    Parameters
    ----------
    model : StateSpaceModel
        The model with its log densities. Particles are float arrays (n,) or (n, d), or mappings of such arrays.
    scale : float or array_like
        Standard deviation of a step, in the units of the state. A scale that does not depend on the particles keeps
        the evidence unbiased.
    steps : int
        Number of Metropolis steps per move.
    """

    model: StateSpaceModel
    scale: Any = 1.0
    steps: PositiveInt = 1
    step_functions: ClassVar = {"model": None}

    def __post_init__(self) -> None:
        super().__post_init__()
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
            with np.errstate(all="ignore"):  # a density is NaN where a parameter of the model is out of range
                log_p = log_target(x)
                return {"x": x, "log_p": log_p}, log_p - now["log_p"]

        start = {"x": population.particles, "log_p": log_target(population.particles)}
        state, share = moved(rng, start, propose, self.steps)
        return Population(state["x"], population.log_weights, population.parents, {"accepted": share})

    def _step(self, rng: np.random.Generator, x: Particles) -> Particles:
        if isinstance(x, np.ndarray):
            if x.dtype.kind != "f":
                raise InputError(
                    f"particles are {x.dtype}, expected floats", "write a Rejuvenation for discrete states"
                )
            return x + self.scale * rng.standard_normal(x.shape)
        return {name: self._step(rng, a) for name, a in x.items()}
