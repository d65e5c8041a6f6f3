"""Properties of transitions, proposals and updates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mstfilter.smc import Population, Proposal, Transition, Update
from mstfilter.testing.properties import (
    FALSE_ALARM,
    Broken,
    Example,
    NotApplicable,
    Suite,
    Untouched,
    add_generator_properties,
    guarded,
    needs_proper_weights,
    only_in_place,
    same,
)

__all__ = ["PROPOSAL", "TRANSITION", "UPDATE"]

TRANSITION, PROPOSAL, UPDATE = Suite("transition"), Suite("proposal"), Suite("update")
_N = 6


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _is_population(found: Any, what: str) -> Population:
    if not isinstance(found, Population):
        raise Broken(f"{what}: it returns {type(found).__name__}, expected a Population")
    return found


# -- transition ------------------------------------------------------------------------------------------------------


def _predict(component: Transition, population: Population, observation: Any, seed: int = 3) -> Population:
    with guarded(f"{len(population)} particles, observation {'None' if observation is None else 'given'}"):
        return _is_population(component.predict(_rng(seed), population, observation), "predict")


@TRANSITION.property("it leaves its input alone", essential=True)
def leaves_input_alone(component: Transition, example: Example) -> None:
    """Particles, weights and observation are the same afterwards."""
    population, observation = example(_rng(), _N)
    before = Untouched(population=population, observation=observation)
    with only_in_place():
        _predict(component, population, observation)
    before.verify()


@TRANSITION.property("every particle is moved, or parents say where the particles come from")
def says_where_particles_come_from(component: Transition, example: Example) -> None:
    """As many particles as before, or parents "previous" in range."""
    for n in (1, 2, _N):
        population, observation = example(_rng(), n)
        moved = _predict(component, population, observation)
        previous = moved.parents.get("previous")
        if previous is None and len(moved) != n:
            raise Broken(f'{n} particles became {len(moved)}, and parents "previous" do not say which is which')
        if previous is not None and not ((previous >= -1) & (previous < n)).all():
            raise Broken(f'parents "previous" hold {int(np.max(previous))} where there were {n} particles')


@TRANSITION.property("it moves particles where the observation is missing (None)")
def takes_a_missing_observation(component: Transition, example: Example) -> None:
    """None is an observation like any other."""
    _predict(component, example(_rng(), _N)[0], None)


add_generator_properties(
    TRANSITION, lambda component, example, rng: component.predict(rng, *example(np.random.default_rng(0), _N))
)


@TRANSITION.property("multiplying all weights by a constant multiplies them afterwards and changes nothing else")
def scale_of_weights_is_irrelevant(component: Transition, example: Example) -> None:
    """Log weights + c in, the same + c out (components that are properly weighted)."""
    needs_proper_weights(component)
    population, observation = example(_rng(), _N)
    a = _predict(component, population, observation)
    for shift in (50.0, -50.0):
        b = _predict(component, population.reweighted(np.full(_N, shift)), observation)
        if len(a) != len(b) or not np.allclose(b.log_weights - shift, a.log_weights, atol=1e-9, rtol=0):
            raise Broken(f"log weights + {shift:g} in do not give log weights + {shift:g} out")


@TRANSITION.property("a particle's move does not depend on its place among the others", statistical=True)
def order_of_particles_is_irrelevant(component: Transition, example: Example) -> None:
    """Distribution-free comparison (Kolmogorov-Smirnov) of every particle's moves in two orders; arrays only."""
    from scipy.stats import ks_2samp

    from mstfilter.smc import as_matrix

    population, observation = example(_rng(), _N)
    if not isinstance(population.particles, (np.ndarray, dict)):
        raise NotApplicable("moves of objects are not compared")
    if len(_predict(component, population, observation)) != _N:
        raise NotApplicable("the number of particles changes")
    order = np.arange(_N)[::-1]
    samples: list[list[np.ndarray]] = [[], []]
    for seed in range(300):
        for side, taken in enumerate((np.arange(_N), order)):
            given = population.take(taken)
            moved = _predict(component, given, observation, seed + 1000 * side)
            rows = np.column_stack([as_matrix(moved.particles), moved.log_weights - given.log_weights])
            samples[side].append(rows[np.argsort(taken)])
    a, b = np.array(samples[0]), np.array(samples[1])
    level = FALSE_ALARM / a[0].size
    for i in range(_N):
        for j in range(a.shape[2]):
            # The weights of equal moves may differ in the last bits with the order of a sum.
            x, y = np.round(a[:, i, j], 9), np.round(b[:, i, j], 9)
            if ks_2samp(x, y).pvalue < level:
                raise Broken(
                    f"particle {i} moves differently as number {order[i]} (mean {x.mean():.3g}, {y.mean():.3g})"
                )


# -- proposal --------------------------------------------------------------------------------------------------------


def _sample(component: Proposal, observation: Any, n: int, seed: int = 3) -> Population:
    with guarded(f"{n} particles"):
        return _is_population(component.sample(_rng(seed), observation, n), "sample")


@PROPOSAL.property("it leaves its input alone", essential=True)
def leaves_observation_alone(component: Proposal, example: Example) -> None:
    """The observation is the same afterwards."""
    observation = example(_rng(), 2)[1]
    before = Untouched(observation=observation)
    with only_in_place():
        _sample(component, observation, 5)
    before.verify()


@PROPOSAL.property("it returns n particles, whatever n")
def gives_n_particles(component: Proposal, example: Example) -> None:
    """Exactly n, repeated where there are fewer different ones."""
    observation = example(_rng(), 2)[1]
    for n in (1, 2, 7, 20):
        found = len(_sample(component, observation, n))
        if found != n:
            raise Broken(f"asked for {n} particles it returns {found}: repeat some where there are too few")


@PROPOSAL.property("it keeps no memory: an earlier call changes nothing")
def has_no_memory(component: Proposal, example: Example) -> None:
    """The same call before and after another one."""
    observation = example(_rng(), 2)[1]
    first = _sample(component, observation, 5, seed=1)
    _sample(component, observation, 9, seed=2)
    again = _sample(component, observation, 5, seed=1)
    if not (
        same(first.realised().particles, again.realised().particles) and same(first.log_weights, again.log_weights)
    ):
        raise Broken("the same call gives another result after a call in between: it keeps something")


add_generator_properties(
    PROPOSAL, lambda component, example, rng: component.sample(rng, example(np.random.default_rng(0), 2)[1], 5)
)


# -- update ----------------------------------------------------------------------------------------------------------


def _pair(example: Example) -> tuple[Population, Population, Any]:
    predicted, observation = example(_rng(), _N)
    proposed = replace(example(_rng(1), 4)[0], log_weights=np.zeros(4))
    return predicted, proposed, observation


def _update(component: Update, predicted: Population | None, proposed: Population | None, y: Any) -> Population:
    names = [name for name, p in (("predicted", predicted), ("proposed", proposed)) if p is not None]
    with guarded(f"{' and '.join(names)} particles"):
        return _is_population(component.update(_rng(3), predicted, proposed, y), "update")


@UPDATE.property("it leaves its input alone", essential=True)
def update_leaves_input_alone(component: Update, example: Example) -> None:
    """Particles, weights and observation are the same afterwards."""
    predicted, proposed, observation = _pair(example)
    before = Untouched(predicted=predicted, proposed=proposed, observation=observation)
    with only_in_place():
        _update(component, predicted, proposed, observation)
    before.verify()


@UPDATE.property("it takes predicted particles, proposed ones, or both")
def takes_any_of_its_inputs(component: Update, example: Example) -> None:
    """At the first step of MST there is no prediction; without a proposal there is nothing proposed."""
    predicted, proposed, observation = _pair(example)
    _update(component, predicted, None, observation)
    _update(component, None, proposed, observation)
    _update(component, predicted, proposed, observation)


@UPDATE.property("parents point at particles that exist")
def parents_exist(component: Update, example: Example) -> None:
    """Indices in [-1, n)."""
    predicted, proposed, observation = _pair(example)
    predicted = replace(predicted, parents={"previous": np.arange(len(predicted))})
    proposed = replace(proposed, parents={"proposed": np.arange(len(proposed))})
    out = _update(component, predicted, proposed, observation)
    for name, n in (("previous", len(predicted)), ("proposed", len(proposed))):
        index = out.parents.get(name)
        if index is not None and not ((index >= -1) & (index < n)).all():
            raise Broken(f'parents "{name}" hold {int(np.max(index))} where there are {n} particles')


def _run_update(component: Update, example: Example, rng: np.random.Generator) -> Population:
    return component.update(rng, *_pair(example))


add_generator_properties(UPDATE, _run_update)


@UPDATE.property("multiplying all weights by a constant multiplies them afterwards and changes nothing else")
def update_scales_with_weights(component: Update, example: Example) -> None:
    """Log weights + c in, the same + c out (components that are properly weighted)."""
    needs_proper_weights(component)
    predicted, _, observation = _pair(example)
    a = _update(component, predicted, None, observation)
    for shift in (50.0, -50.0):
        b = _update(component, predicted.reweighted(np.full(len(predicted), shift)), None, observation)
        if len(a) != len(b) or not np.allclose(b.log_weights - shift, a.log_weights, atol=1e-9, rtol=0):
            raise Broken(f"log weights + {shift:g} in do not give log weights + {shift:g} out")
