"""Properties of triggers, sizes, similarities and equivalences."""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.smc import Equivalence, Population, Similarity, Size, Trigger
from mstfilter.testing.properties import Broken, Example, Suite, Untouched, guarded

__all__ = ["EQUIVALENCE", "SIMILARITY", "SIZE", "TRIGGER"]

TRIGGER, SIZE, SIMILARITY, EQUIVALENCE = Suite("trigger"), Suite("size"), Suite("similarity"), Suite("equivalence")


def _examples(example: Example) -> list[Population]:
    """Populations of 1, 2 and 12 particles; with even, uneven and hardly any weights."""
    rng = np.random.default_rng(0)
    populations = [example(rng, n)[0] for n in (1, 2, 12)]
    whole = populations[-1]
    even, peaked = np.zeros(12), np.where(np.arange(12) == 5, 0.0, -80.0)
    return [*populations, Population(whole.particles, even), Population(whole.particles, peaked)]


def _particles(example: Example, n: int = 9) -> Any:
    return example(np.random.default_rng(0), n)[0].realised().particles


# -- trigger ---------------------------------------------------------------------------------------------------------


@TRIGGER.property("it answers True or False")
def answers_yes_or_no(component: Trigger, example: Example) -> None:
    """For any population and time."""
    for population in _examples(example):
        for t in (0, 1, 7):
            with guarded(f"{len(population)} particles at time {t}"):
                answer = component.wants(population, t)
            if not isinstance(answer, (bool, np.bool_)):
                raise Broken(f"its answer is {answer!r}, expected True or False")


@TRIGGER.property("the scale of the weights and the order of the particles do not matter")
def trigger_ignores_scale_and_order(component: Trigger, example: Example) -> None:
    """Log weights + c, or particles in another order, give the same answer."""
    for population in _examples(example):
        with guarded(f"{len(population)} particles"):
            answer = bool(component.wants(population, 3))
            for shift in (1000.0, -1000.0):
                if bool(component.wants(population.reweighted(np.full(len(population), shift)), 3)) != answer:
                    raise Broken(f"adding {shift:g} to all log weights changes its answer")
            if bool(component.wants(population.take(np.arange(len(population))[::-1]), 3)) != answer:
                raise Broken("another order of the particles changes its answer")


@TRIGGER.property("it leaves the population alone and keeps no memory")
def trigger_has_no_memory(component: Trigger, example: Example) -> None:
    """Asked again it says the same."""
    population = _examples(example)[2]
    before = Untouched(population=population)
    with guarded("asked three times"):
        answers = {bool(component.wants(population, 2)) for _ in range(3)}
    before.verify()
    if len(answers) > 1:
        raise Broken("asked again it changes its answer")


# -- size ------------------------------------------------------------------------------------------------------------


@SIZE.property("it answers a whole number of at least 1")
def answers_a_number(component: Size, example: Example) -> None:
    """For any population."""
    for population in _examples(example):
        with guarded(f"{len(population)} particles"):
            n = component.choose(population)
        if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1:
            raise Broken(f"for {len(population)} particles its answer is {n!r}, expected an int of at least 1")


@SIZE.property("the scale of the weights and the order of the particles do not matter")
def size_ignores_scale_and_order(component: Size, example: Example) -> None:
    """Log weights + c, or particles in another order, give the same number."""
    for population in _examples(example):
        with guarded(f"{len(population)} particles"):
            n = component.choose(population)
            for shift in (1000.0, -1000.0):
                if component.choose(population.reweighted(np.full(len(population), shift))) != n:
                    raise Broken(f"adding {shift:g} to all log weights changes its answer")
            if component.choose(population.take(np.arange(len(population))[::-1])) != n:
                raise Broken("another order of the particles changes its answer")


@SIZE.property("it leaves the population alone and keeps no memory")
def size_has_no_memory(component: Size, example: Example) -> None:
    """Asked again it says the same."""
    population = _examples(example)[2]
    before = Untouched(population=population)
    with guarded("asked three times"):
        answers = {component.choose(population) for _ in range(3)}
    before.verify()
    if len(answers) > 1:
        raise Broken(f"asked three times it answers {sorted(answers)}")


# -- similarity ------------------------------------------------------------------------------------------------------


def _matrix(component: Similarity, particles: Any, n: int) -> np.ndarray:
    with guarded(f"{n} particles"):
        found = np.asarray(component.matrix(particles))
    if found.shape != (n, n):
        raise Broken(f"similarities of {n} particles have shape {found.shape}, expected ({n}, {n})")
    return found


@SIMILARITY.property("it gives an (n, n) matrix of finite numbers in [0, 1], 1 on the diagonal")
def similarities_are_shares(component: Similarity, example: Example) -> None:
    """Up to rounding."""
    for n in (1, 2, 9):
        S = _matrix(component, _particles(example, n), n)
        if not np.isfinite(S).all() or S.min() < -1e-9 or S.max() > 1 + 1e-9:
            raise Broken(f"similarities lie in [{np.min(S):.3g}, {np.max(S):.3g}], expected finite ones in [0, 1]")
        if not np.allclose(np.diag(S), 1.0, atol=1e-9):
            raise Broken(f"a particle has similarity {np.diag(S).min():.3g} to itself, expected 1")


@SIMILARITY.property("it is symmetric")
def similarity_is_symmetric(component: Similarity, example: Example) -> None:
    """S_ij = S_ji."""
    S = _matrix(component, _particles(example), 9)
    i, j = np.unravel_index(np.argmax(np.abs(S - S.T)), S.shape)
    if abs(S[i, j] - S[j, i]) > 1e-9:
        raise Broken(f"particle {i} is {S[i, j]:.4g} like {j}, but {j} is {S[j, i]:.4g} like {i}")


@SIMILARITY.property("the similarity of two particles does not depend on the others, nor on their order")
def similarity_of_pairs(component: Similarity, example: Example) -> None:
    """Rows and columns of a part of the particles, in another order."""
    population = example(np.random.default_rng(0), 9)[0].realised()
    S = _matrix(component, population.particles, 9)
    part = np.array([7, 2, 4, 0])
    found = _matrix(component, population.take(part).particles, 4)
    if not np.allclose(found, S[np.ix_(part, part)], atol=1e-9):
        raise Broken("the similarities of four of nine particles are others when only these are given")


@SIMILARITY.property("it leaves the particles alone")
def similarity_leaves_particles_alone(component: Similarity, example: Example) -> None:
    """No change in place."""
    particles = _particles(example)
    before = Untouched(particles=particles)
    _matrix(component, particles, 9)
    before.verify()


# -- equivalence -----------------------------------------------------------------------------------------------------


def _classes(component: Equivalence, particles: Any, n: int) -> np.ndarray:
    with guarded(f"{n} particles"):
        found = np.asarray(component.classes(particles))
    if found.shape != (n,) or not np.issubdtype(found.dtype, np.integer):
        raise Broken(f"classes of {n} particles are {found.dtype} {found.shape}, expected int ({n},)")
    return found


@EQUIVALENCE.property("classes are numbered 0, 1, ... in the order in which they occur")
def classes_are_numbered(component: Equivalence, example: Example) -> None:
    """No gaps, first come first."""
    for n in (1, 2, 9):
        found = _classes(component, _particles(example, n), n)
        highest = np.maximum.accumulate(np.concatenate([[-1], found]))
        if (found < 0).any() or (found > highest[:-1] + 1).any():
            raise Broken(f"classes are {found.tolist()}")


@EQUIVALENCE.property("a particle equals itself")
def copies_are_equal(component: Equivalence, example: Example) -> None:
    """Every particle given twice falls into one class twice."""
    population = example(np.random.default_rng(0), 5)[0].realised()
    found = _classes(component, population.take(np.repeat(np.arange(5), 2)).particles, 10)
    if (found[::2] != found[1::2]).any():
        raise Broken("a particle and its copy are in different classes")


@EQUIVALENCE.property("whether two particles are equal does not depend on the others, nor on their order")
def classes_of_pairs(component: Equivalence, example: Example) -> None:
    """A part of the particles, in another order."""
    population = example(np.random.default_rng(0), 9)[0].realised()
    whole = _classes(component, population.particles, 9)
    part = np.array([8, 1, 5, 2, 0])
    found = _classes(component, population.take(part).particles, 5)
    if ((found[:, None] == found) != (whole[part][:, None] == whole[part])).any():
        raise Broken("five of nine particles fall into other classes when only these are given")


@EQUIVALENCE.property("it leaves the particles alone")
def equivalence_leaves_particles_alone(component: Equivalence, example: Example) -> None:
    """No change in place."""
    particles = _particles(example)
    before = Untouched(particles=particles)
    _classes(component, particles, 9)
    before.verify()
