"""Data drawn from a model: every model has a method `simulate`.

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, ys = model.simulate(50, seed=1)
>>> states.shape, ys.shape
((50,), (50,))
>>> state, infos = bootstrap(model, n=1000).run(ys, seed=0)

A filter that is judged by such data is judged where its model is true. `simulate` draws from streams of its own, so
the filter may have the same seed. The first T steps do not depend on how many follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, check_integer, naming
from mstfilter.smc.inputs import WithInput
from mstfilter.smc.population import Particles, take
from mstfilter.smc.streams import Key

#: ``(rng, t, u, particles) -> (particles, y)``: the next two particles, and the observation of the first
Step = Callable[[np.random.Generator, int, Any, Particles | None], tuple[Particles, Any]]


def simulate_steps(step: Step, n_steps: int, seed: int, inputs: Iterable[Any] | None) -> tuple[Particles, Any]:
    """States and observations of a run of `step`, for the methods `simulate`.

    Two particles move, and the first is kept, because functions of a model that mix up particles and the entries of a
    vector show it with two.
    """
    check_integer("n_steps", n_steps)
    us = [None] * n_steps if inputs is None else list(inputs)
    if len(us) != n_steps:
        raise InputError(f"there are {len(us)} inputs for {n_steps} steps", "give one for each step, the first too")
    rng, x, states, ys = Key(seed).child("simulate").generator(), None, [], []
    for t, u in enumerate(us):
        with naming(f"step {t}"):
            x, y = step(rng, t, u, x)
        states.append(take(x, np.arange(1)))
        ys.append(y if inputs is None else WithInput(y, u))
    return _joined(states), _stacked(ys)


def first_row(ys: Any) -> Any:
    """The first of several observations: an array or list of them, or a mapping of arrays."""
    return {name: a[0] for name, a in ys.items()} if isinstance(ys, Mapping) else ys[0]


def _joined(states: list[Any]) -> Particles:
    """States of all steps, from particles of one row. Variables that some step lacks are left out."""
    if isinstance(states[0], np.ndarray):
        return np.concatenate(states)
    if isinstance(states[0], Mapping):
        names = [name for name in states[-1] if all(name in x for x in states)]
        return {name: np.concatenate([x[name] for x in states]) for name in names}
    return tuple(x for (x,) in states)


def _stacked(ys: list[Any]) -> Any:
    """Observations as one array if they are arrays or numbers of one shape, otherwise as a list."""
    if any(isinstance(y, WithInput | Mapping | tuple) for y in ys) or len({np.shape(y) for y in ys}) > 1:
        return ys
    return np.stack(ys)
