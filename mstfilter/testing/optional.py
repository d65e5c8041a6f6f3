"""Properties of lookaheads, rejuvenations and codecs: the optional parts of a filter.

A rejuvenation has to leave p(x_t | x_{t-1}, y_t) as it is. That is tested where exact draws of it are given, as a
function ``exact(rng, n) -> (previous, population, observation)``: `n` paired rows, x_t drawn from that law.
"""

from __future__ import annotations

import copy
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from mstfilter.smc import Codec, Lookahead, Population, Rejuvenation, as_matrix
from mstfilter.testing.properties import (
    FALSE_ALARM,
    Broken,
    Exact,
    Example,
    Suite,
    Untouched,
    add_generator_properties,
    guarded,
    needs_proper_weights,
    only_in_place,
    same,
)

__all__ = ["CODEC", "LOOKAHEAD", "REJUVENATION"]

LOOKAHEAD, REJUVENATION, CODEC = Suite("lookahead"), Suite("rejuvenation"), Suite("codec")
_N = 6


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


# -- lookahead -------------------------------------------------------------------------------------------------------


def _priority(component: Lookahead, population: Population, observation: Any) -> np.ndarray:
    n = len(population)
    with guarded(f"{n} particles"):
        found = np.asarray(component.log_priority(population, observation), dtype=np.float64)
    if found.shape != (n,):
        raise Broken(f"log priorities of {n} particles have shape {found.shape}, expected ({n},)")
    return found


@LOOKAHEAD.property("it leaves its input alone", essential=True)
def lookahead_leaves_input_alone(component: Lookahead, example: Example) -> None:
    """Particles, weights and observation are the same afterwards."""
    population, observation = example(_rng(), _N)
    before = Untouched(population=population, observation=observation)
    with only_in_place():
        component.log_priority(population, observation)
    before.verify()


@LOOKAHEAD.property("it gives one finite number a particle", essential=True)
def priorities_are_finite(component: Lookahead, example: Example) -> None:
    """A particle that can never be selected would bias the filter."""
    for n in (1, 2, 40):
        found = _priority(component, *example(_rng(), n))
        if not np.isfinite(found).all():
            value = found[~np.isfinite(found)][0]
            raise Broken(f"a log priority is {value}: -inf would bias the filter, bound it from below")


@LOOKAHEAD.property("the scale of the weights and the order of the particles do not matter")
def priority_ignores_scale_and_order(component: Lookahead, example: Example) -> None:
    """Log weights + c give the same priorities; another order gives the same in that order."""
    population, observation = example(_rng(), _N)
    found = _priority(component, population, observation)
    for shift in (1000.0, -1000.0):
        moved = _priority(component, population.reweighted(np.full(_N, shift)), observation)
        if not np.allclose(moved, found, atol=1e-9):
            raise Broken(f"adding {shift:g} to all log weights changes the priorities")
    order = np.array([3, 0, 5, 1, 4, 2])
    if not np.allclose(_priority(component, population.take(order), observation), found[order], atol=1e-9):
        raise Broken("in another order the particles have other priorities")


@LOOKAHEAD.property("it keeps no memory: an earlier call changes nothing")
def lookahead_has_no_memory(component: Lookahead, example: Example) -> None:
    """The driver takes off the priority that it added: asked again it must be the same."""
    population, observation = example(_rng(), _N)
    first = _priority(component, population, observation)
    _priority(component, *example(_rng(1), 9))
    if not np.array_equal(_priority(component, population, observation), first):
        raise Broken("asked again it gives other priorities: it keeps something, or draws")


# -- rejuvenation ----------------------------------------------------------------------------------------------------


def _previous(example: Example, n: int) -> Population:
    return example(_rng(1), n)[0]


def _move(
    component: Rejuvenation,
    population: Population,
    previous: Population | None,
    observation: Any,
    rng: np.random.Generator | None = None,
) -> Population:
    what = f"{len(population)} particles, {'no previous ones' if previous is None else 'previous ones'}"
    with guarded(what if observation is not None else f"{what}, observation None"):
        moved = component.move(_rng(3) if rng is None else rng, population, previous, observation)
    if not isinstance(moved, Population):
        raise Broken(f"move returns {type(moved).__name__}, expected a Population")
    return moved


@REJUVENATION.property("it leaves its input alone", essential=True)
def move_leaves_input_alone(component: Rejuvenation, example: Example) -> None:
    """Particles, weights, previous particles and observation are the same afterwards."""
    population, observation = example(_rng(), _N)
    previous = _previous(example, _N)
    before = Untouched(population=population, previous=previous, observation=observation)
    with only_in_place():
        component.move(_rng(3), population, previous, observation)
    before.verify()


@REJUVENATION.property("it returns as many particles, with the log weights that they had")
def move_keeps_number_and_weights(component: Rejuvenation, example: Example) -> None:
    """Also at the first step (previous None) and where the observation is missing (None)."""
    for n in (1, 2, _N):
        population, observation = example(_rng(), n)
        for previous, y in ((_previous(example, n), observation), (None, observation), (_previous(example, n), None)):
            moved = _move(component, population, previous, y)
            if len(moved) != n:
                raise Broken(f"{n} particles became {len(moved)}")
            if not np.array_equal(moved.log_weights, population.log_weights):
                raise Broken("log weights are others after the move: a kernel that keeps the law leaves them alone")


add_generator_properties(
    REJUVENATION,
    lambda component, example, rng: component.move(
        rng, example(_rng(), _N)[0], _previous(example, _N), example(_rng(), _N)[1]
    ),
)


@REJUVENATION.property("it keeps p(x_t | x_{t-1}, y_t) as it is", statistical=True, needs_exact=True)
def move_keeps_the_law(component: Rejuvenation, exact: Exact) -> None:
    """Exact draws moved five times against fresh exact draws, with x_t - x_{t-1} beside x_t (Kolmogorov-Smirnov)."""
    needs_proper_weights(component)
    from scipy.stats import ks_2samp

    n = 4000
    previous, population, observation = exact(_rng(1), n)
    rng = _rng(2)
    for _ in range(5):
        population = _move(component, population, previous, observation, rng)
    moved = _columns(previous, population)
    fresh_previous, fresh, _ = exact(_rng(3), n)
    wanted = _columns(fresh_previous, fresh)
    for j in range(moved.shape[1]):
        if ks_2samp(moved[:, j], wanted[:, j]).pvalue < FALSE_ALARM / moved.shape[1]:
            what = f"x_t ({j})" if j < moved.shape[1] / 2 or previous is None else "x_t - x_{t-1}"
            raise Broken(
                f"exact draws are no longer exact after five moves: {what} has mean {moved[:, j].mean():.4g} and "
                f"sd {moved[:, j].std():.4g}, expected {wanted[:, j].mean():.4g} and {wanted[:, j].std():.4g}"
            )


def _columns(previous: Population | None, population: Population) -> np.ndarray:
    x = as_matrix(population.particles)
    if previous is None:
        return x
    old = as_matrix(previous.particles)
    return np.concatenate([x, x - old], axis=1) if old.shape == x.shape else x


# -- codec -----------------------------------------------------------------------------------------------------------


def _encoded(component: Codec, particles: Any, n: int) -> dict[str, np.ndarray]:
    with guarded(f"encode {n} particles"):
        arrays = component.encode(particles)
    if not isinstance(arrays, Mapping):
        raise Broken(f"encode returns {type(arrays).__name__}, expected a mapping of names to arrays")
    for name, array in arrays.items():
        if not isinstance(name, str):
            raise Broken(f"encode names an array {name!r}, expected a str")
        if not isinstance(array, np.ndarray):
            raise Broken(f"encode gives a {type(array).__name__} as {name!r}, expected an array")
        if array.dtype.hasobject:
            raise Broken(f"{name!r} is an array of Python objects, which only pickle could store")
    return dict(arrays)


def _stored(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What comes back from a file."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{f"particles/{name}": a for name, a in arrays.items()})
    file.seek(0)
    with np.load(file, allow_pickle=False) as data:
        return {name.removeprefix("particles/"): data[name] for name in data.files}


@CODEC.property("it leaves its input alone", essential=True)
def codec_leaves_input_alone(component: Codec, example: Example) -> None:
    """Particles are the same afterwards."""
    particles = example(_rng(), _N)[0].realised().particles
    before = Untouched(particles=particles)
    with only_in_place():
        component.encode(particles)
    before.verify()


@CODEC.property("it encodes particles as named arrays without Python objects", essential=True)
def encodes_as_arrays(component: Codec, example: Example) -> None:
    """What `numpy.savez` stores without pickle."""
    for n in (1, 2, _N):
        _encoded(component, example(_rng(), n)[0].realised().particles, n)


@CODEC.property("particles come back from a file bit for bit")
def particles_come_back(component: Codec, example: Example) -> None:
    """In number, order, type and value; also duplicates, as a resampling leaves them."""
    for n in (1, 2, _N):
        population = example(_rng(), n)[0].realised()
        doubled = population.take(np.repeat(np.arange(n), 2)[: n + 1])
        for particles in (population.particles, doubled.particles):
            fresh = copy.deepcopy(component)  # a new process has encoded nothing
            arrays = _stored(_encoded(component, particles, n))
            with guarded(f"decode {n} particles"):
                found = Population(fresh.decode(arrays)).particles
            again = _encoded(fresh, found, n)
            if not same(found, Population(particles).particles) or not same(again, arrays):
                raise Broken(f"{n} particles that were encoded and decoded are not the same")


@CODEC.property("it keeps no memory: an earlier call changes nothing")
def codec_has_no_memory(component: Codec, example: Example) -> None:
    """The same particles give the same arrays."""
    particles = example(_rng(), _N)[0].realised().particles
    first = _encoded(component, particles, _N)
    _encoded(component, example(_rng(1), 9)[0].realised().particles, 9)
    if not same(_encoded(component, particles, _N), first):
        raise Broken("the same particles give other arrays after a call in between: it keeps something")
