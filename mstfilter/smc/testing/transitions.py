"""Contracts of what moves particles: transitions and rejuvenations.

A transition moves each particle as if it were alone, in any order, with weights that do not depend on the others. One
with a density must move by it. A rejuvenation must leave p(x_t | x_{t-1}, y_t) invariant. Comparisons with exact
draws need a method `exact` (`mstfilter.smc.testing.exact`).

>>> from dataclasses import dataclass
>>> import numpy as np
>>> from mstfilter.smc import Population, Transition
>>> from mstfilter.smc.testing import TransitionContract, check_properties
>>> @dataclass(frozen=True)
... class Shrink(Transition):
...     def predict(self, rng, population, observation):
...         x = population.particles
...         moved = x - 0.1 * (x - x.mean()) + 0.1 * rng.standard_normal(x.shape)     # the mean of the others
...         return Population(moved, population.log_weights, population.parents)
>>> {result.name for result in check_properties(Shrink(), TransitionContract) if result.failure}
{'moves_do_not_depend_on_others'}
"""

from __future__ import annotations

from functools import cached_property
from itertools import permutations, product
from typing import Any
from unittest import SkipTest

import numpy as np

from mstfilter.smc import DensityTransition, Population, as_matrix, union
from mstfilter.smc.testing.contract import (
    ScaleContract,
    reports_errors,
    same,
    seeded,
    skip_unless_properly_weighted,
    statistical,
)
from mstfilter.smc.testing.copies import quantile
from mstfilter.smc.testing.exact import (
    DrawsContract,
    WeightedRows,
    check_parents,
    check_same_law,
    check_uncorrelated,
)

_N = 6


class TransitionContract(ScaleContract, DrawsContract):
    """The contract of every `Transition`. Each statistical test has a false-alarm rate of at most 1e-6.

    Three tests need a method ``exact(self, rng, n)`` that returns n rows x_{t-1}, draws of x_t from f(x_t | x_{t-1}),
    and the observation. For a guided move, `exact` also returns the function log p(y_t | x_t) of x_t. If the
    transition weights by the observation, the draws of x_t must carry the exact weights.
    """

    columns = "(x_t, x_t - x_{t-1})"

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.predict(rng, inputs["population"], inputs["observation"])

    def variants(self) -> list[dict[str, Any]]:
        return [{**inputs, **absent} for inputs in super().variants() for absent in ({}, {"observation": None})]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n, old = len(inputs["population"]), inputs["population"].log_weights
        assert len(result) == n or "previous" in result.parents, (
            f'{n} particles became {len(result)}, and there are no parents "previous"'
        )
        check_parents(result, "previous", n)
        particles, old_particles = result.particles, inputs["population"].particles
        if all(isinstance(one, np.ndarray) and one.dtype.kind == "f" for one in (particles, old_particles)):
            wrong = np.flatnonzero(~np.isfinite(particles).reshape(len(result), -1).all(axis=1))
            assert not len(wrong) or not np.isfinite(old_particles).all(), (
                f"particle {wrong[0]} becomes {particles[wrong[0]]}"
            )
        if same(np.sort(result.log_weights), np.sort(old)):
            parents = result.parents.get("previous", np.arange(n))
            assert np.array_equal(result.log_weights, np.where(parents < 0, result.log_weights, old[parents])), (
                'the particles have another order than before, and parents "previous" do not state it'
            )

    def rows_of(self, case: tuple[Any, ...], rows: np.ndarray, rng: np.random.Generator) -> WeightedRows:
        population, _, observation, *likelihood = case
        before = population.take(rows).reweighted(seeded(5).standard_normal(len(rows)))
        after = self.checked_call(self.make(), {"population": before, "observation": observation}, rng)
        before = before.take(after.parents.get("previous", np.arange(len(after))))
        return _columns(before, after), _change(before, after, likelihood)

    def exact_rows(self, case: tuple[Any, ...]) -> WeightedRows:
        before, after, _, *likelihood = case
        return _columns(before, after), _change(before, after, likelihood)

    @statistical
    def test_moves_without_observation_are_exact(self) -> None:
        """Without an observation, a guided move draws from the model."""
        skip_unless_properly_weighted(self.make())
        case = self.exact_case(3, 1000)
        if np.ptp(case[1].log_weights):
            raise SkipTest("the exact moves are weighted by the observation")
        if not np.ptp(self.rows_of(case[:3], np.arange(1000), seeded(2))[1]):
            raise SkipTest("the move does not use the observation")

        def drawn(n: int) -> WeightedRows:
            before, after, *_ = self.exact_case(1, n)
            return self.rows_of((before, after, None), np.arange(n), seeded(2))

        n = self.draws_in_time(drawn)
        before, after, *_ = self.exact_case(3, n)
        self.compare_rows(drawn(n), self.exact_rows((before, after, None)))

    @statistical
    def test_moves_do_not_depend_on_others(self) -> None:
        """A particle moves as it does beside other particles, unless the move is weighted."""
        component, inputs = skip_unless_properly_weighted(self.make()), self.inputs(_N)
        self._skip_objects(component, inputs)
        half = np.arange(_N // 2)
        population = inputs["population"]
        others = union(population.take(half), self.inputs(_N, 5)["population"].take(half)).particles
        given = Population(others, population.log_weights)
        a, b = (moves[:, half] for moves in (self.moves, self._moves(component, {**inputs, "population": given})))
        if np.ptp(np.concatenate([a, b])[..., -1]) > 1e-9:
            raise SkipTest("the moves are weighted, so that they may depend on all particles")
        # Both populations move with equal generators. If the laws are equal, every difference has mean 0.
        for power in (1, 2):
            difference = (a[..., :-1] ** power - b[..., :-1] ** power).reshape(len(a), -1)
            mean, sd = difference.mean(axis=0), difference.std(axis=0)
            bound = quantile(4 * difference.shape[1]) * sd / np.sqrt(len(a)) + 1e-6 * (1 + np.abs(a).max() ** power)
            assert (np.abs(mean) <= bound).all(), (
                "the same particle moves differently beside other particles: it uses their mean or spread, so "
                "declare properly_weighted = False or move each particle by itself"
            )

    @statistical
    def test_order_of_particles_is_irrelevant(self) -> None:
        """Particles move independently, and the order of the particles has no effect."""
        component, inputs = self.make(), self.inputs(_N)
        self._skip_objects(component, inputs)
        population, backwards = inputs["population"], np.arange(_N)[::-1]
        a = self.moves
        b = self._moves(component, {**inputs, "population": population.take(backwards)}, 1000)[:, ::-1]
        drawn = np.flatnonzero(np.ptp(a, axis=0).max(axis=0)[:-1] > 1e-6)[:4]  # without the change of the log weight
        n_tests = 4 * _N**2 * max(1, len(drawn)) ** 2
        for c, d in product(drawn, drawn):
            x, y = (np.concatenate([a[:, :, axis], b[:, :, axis]]) for axis in (c, d))
            for i, k in permutations(range(_N), 2):
                if c < d or (c == d and i < k):
                    check_uncorrelated(x[:, i], y[:, k], n_tests, f"moves of particles {i} and {k}")
        for i in range(_N):
            check_same_law(a[:, i], b[:, i], 4 * _N, f"particle {i} moves differently as number {backwards[i]}")

    def _skip_objects(self, component: Any, inputs: dict[str, Any]) -> None:
        """Skip the test if particles are objects, or if their number changes."""
        if not isinstance(inputs["population"].particles, (np.ndarray, dict)):
            raise SkipTest("the particles are objects, whose moves are not compared")
        if len(self.checked_call(component, inputs)) != len(inputs["population"]):
            raise SkipTest("the number of particles changes")

    @cached_property
    def moves(self) -> np.ndarray:
        """The results of 300 calls that two tests compare with those of other populations."""
        return self._moves(self.make(), self.inputs(_N))

    def _moves(self, component: Any, inputs: dict[str, Any], seed: int = 0) -> np.ndarray:
        """(300, n, d + 1) results of 300 calls: coordinates, and the change of the log weight.

        The results are rounded, because the order of summation changes the last bits.
        """
        given, moves = inputs["population"], []
        for k in range(300):
            moved = self.checked_call(component, inputs, seeded(seed + k))
            moves.append(np.column_stack([as_matrix(moved.particles), moved.log_weights - given.log_weights]))
        return np.round(np.array(moves), 9)


class DensityTransitionContract(TransitionContract):
    """The contract of every `DensityTransition`: the properties of `TransitionContract`, and those of `log_prob`."""

    def test_log_prob_is_of_each_move(self) -> None:
        """`log_prob` gives one finite number for each move of `predict`, independently of the other moves."""
        component, rows = self.make(), np.array([4, 0, 3])
        for n in (1, _N):
            inputs = self.inputs(n)
            moved = self.checked_call(component, inputs)
            found = self._log_prob(component, inputs, moved)
            assert found.shape == (n,), f"log densities of {n} moves have shape {found.shape}, expected ({n},)"
            assert np.isfinite(found).all(), f"log density of a move is {found[~np.isfinite(found)][0]}"
        fewer_inputs = {**inputs, "population": inputs["population"].take(rows)}
        fewer = self._log_prob(component, fewer_inputs, moved.take(rows))
        assert np.allclose(fewer, found[rows], atol=1e-9), "three of six moves have other log densities alone"

    @statistical
    def test_log_prob_is_the_density_of_its_moves(self) -> None:
        """The moves of `predict` have the density of `log_prob`, up to a constant factor.

        Let x' be a move from particle a or b, with probability 1/2 each. Then p = f(x' | a) / (f(x' | a) + f(x' | b))
        is the probability that x' was moved from a. With p computed for the true origin, (1 - p) h(log(p / (1 - p)))
        has mean 0 for every odd bounded function h; here it is linear up to 8. The particles a and b are 4, 8, ...
        or 8192 positions apart in the order of the first coordinate.
        """
        component, n = self.make(), 2**14
        if not isinstance(self.inputs(1)["population"].particles, (np.ndarray, dict)):
            raise SkipTest("the particles are objects")
        population, observation = self.example(seeded(1), n)
        given = Population(population.take(np.argsort(as_matrix(population.particles)[:, 0])).particles)
        inputs = {"population": given, "observation": observation}
        moved = self.checked_call(component, inputs, seeded(2))
        if np.ptp(moved.log_weights) > 0:
            raise SkipTest("moves are weighted: their density is another one")
        own = self._log_prob(component, inputs, moved)
        for shift in 2 ** np.arange(2, 14):
            self.tested = f"out of time: compared up to {shift // 2} positions apart"
            self.check_time()
            other = {**inputs, "population": given.take(np.arange(n) ^ shift)}
            logit = own - self._log_prob(component, other, moved)
            with np.errstate(over="ignore"):
                found = np.clip(logit, -8, 8) / (1 + np.exp(logit))
            bound = quantile(40 * 12) * found.std() / np.sqrt(n) + 1e-9
            assert abs(found.mean()) <= bound, (
                "`log_prob` is not the density of the moves of `predict`: for moves from two particles it is too "
                f"{'certain' if found.mean() < 0 else 'uncertain'} which is from which"
            )

    @staticmethod
    def _log_prob(component: DensityTransition, inputs: dict[str, Any], moved: Population) -> np.ndarray:
        with reports_errors("log_prob"):
            old = inputs["population"].particles
            return np.asarray(component.log_prob(old, moved.particles, inputs["observation"]))


class RejuvenationContract(DrawsContract):
    """The contract of every `Rejuvenation`: moves leave p(x_t | x_{t-1}, y_t) invariant.

    The statistical tests, each with a false-alarm rate of at most 1e-6, need a method ``exact(self, rng, n)`` that
    returns three values: n rows x_{t-1}, exact draws of x_t given x_{t-1} and y_t, and the observation y_t. At the
    first step x_{t-1} is None.
    """

    columns = "(x_t, x_t - x_{t-1}) after five moves of exact draws"
    exact_types = (Population | None, Population)

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {**super().inputs(n, seed), "previous": self.example(seeded(seed + 1), n)[0]}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.move(rng, inputs["population"], inputs["previous"], inputs["observation"])

    def variants(self) -> list[dict[str, Any]]:
        missing: tuple[dict[str, Any], ...] = ({}, {"previous": None}, {"observation": None})
        return [{**inputs, **absent} for inputs in super().variants() for absent in missing]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        n, log_weights = len(inputs["population"]), inputs["population"].log_weights
        assert len(result) == n, f"{n} particles became {len(result)}"
        assert same(result.log_weights, log_weights), (
            "it changes log weights: a kernel that keeps the distribution leaves them unchanged"
        )

    def rows_of(self, case: tuple[Any, ...], rows: np.ndarray, rng: np.random.Generator) -> WeightedRows:
        previous, population, observation = case
        previous, population = None if previous is None else previous.take(rows), population.take(rows)
        for _ in range(5):
            inputs = {"population": population, "previous": previous, "observation": observation}
            population = self.checked_call(self.make(), inputs, rng)
        return _columns(previous, population), np.zeros(len(rows))

    def exact_rows(self, case: tuple[Any, ...]) -> WeightedRows:
        previous, population, _ = case
        return _columns(previous, population), np.zeros(len(population))


def _columns(previous: Population | None, population: Population) -> np.ndarray:
    """Columns x_t, and x_t - x_{t-1} if x_t and x_{t-1} have the same shape."""
    x = as_matrix(population.particles)
    if previous is None:
        return x
    old = as_matrix(previous.particles)
    return np.concatenate([x, x - old], axis=1) if old.shape == x.shape else x


def _change(before: Population, after: Population, likelihood: list[Any]) -> np.ndarray:
    """Changes of the log weights, times the likelihood with which a guided move is compared."""
    return after.log_weights - before.log_weights + sum(log_g(after.particles) for log_g in likelihood)
