"""Contracts of transitions, proposals, updates and rejuvenations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mstfilter.smc import DensityTransition, Population, as_matrix
from mstfilter.testing.contract import (
    FALSE_ALARM,
    RandomContract,
    reports_errors,
    same,
    skip_unless_properly_weighted,
    statistical,
)

_N = 6


def _rng(seed: int = 3) -> np.random.Generator:
    return np.random.default_rng(seed)


class _PopulationContract(RandomContract):
    """What contracts share of components that return a population."""

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, Population), f"it returns {type(result).__name__}, expected a Population"

    def check_scale(self, inputs: dict[str, Any], name: str) -> None:
        """Check that adding a number to the log weights of the population `name` adds it to those of the result."""
        component = self.make()
        skip_unless_properly_weighted(component)
        unshifted = self.checked_call(component, inputs)
        for shift in (50.0, -50.0):
            population = inputs[name].reweighted(np.full(len(inputs[name]), shift))
            shifted = self.checked_call(component, {**inputs, name: population})
            equal = len(unshifted) == len(shifted) and np.allclose(
                shifted.log_weights - shift, unshifted.log_weights, atol=1e-9, rtol=0
            )
            assert equal, f"log weights + {shift:g} in do not give log weights + {shift:g} out"


class TransitionContract(_PopulationContract):
    """The contract of every `Transition`. Its one statistical test has a false-alarm rate of at most 1e-6."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.predict(rng, inputs["population"], inputs["observation"])

    def test_parents_are_valid(self) -> None:
        """It keeps the number of particles, or sets parents "previous" to indices of old particles."""
        component = self.make()
        for n in (1, 2, _N):
            moved = self.checked_call(component, self.inputs(n))
            previous = moved.parents.get("previous")
            if previous is None:
                assert len(moved) == n, f'{n} particles became {len(moved)}, and there are no parents "previous"'
            else:
                assert ((previous >= -1) & (previous < n)).all(), (
                    f'parents "previous" contain {int(np.max(previous))}, and there were {n} particles'
                )

    def test_takes_a_missing_observation(self) -> None:
        """It moves particles if the observation is missing (None)."""
        self.checked_call(self.make(), {**self.inputs(_N), "observation": None})

    def test_scale_of_weights_is_irrelevant(self) -> None:
        """A common factor of the weights is kept and has no other effect."""
        self.check_scale(self.inputs(_N), "population")

    @statistical
    def test_order_of_particles_is_irrelevant(self) -> None:
        """The move of a particle does not depend on its position among the others."""
        from scipy.stats import ks_2samp

        component, inputs = self.make(), self.inputs(_N)
        population = inputs["population"]
        if not isinstance(population.particles, (np.ndarray, dict)):
            pytest.skip("the particles are objects, whose moves are not compared")
        if len(self.checked_call(component, inputs)) != _N:
            pytest.skip("the number of particles changes")
        orders = (np.arange(_N), np.arange(_N)[::-1])
        samples: list[list[np.ndarray]] = [[], []]
        for seed in range(300):
            for side, order in enumerate(orders):
                given = population.take(order)
                moved = self.checked_call(component, {**inputs, "population": given}, _rng(seed + 1000 * side))
                rows = np.column_stack([as_matrix(moved.particles), moved.log_weights - given.log_weights])
                samples[side].append(rows[np.argsort(order)])
        # Kolmogorov-Smirnov tests of each coordinate of each particle. Rounding: equal weights may differ in the last
        # bits, since the order of a sum differs.
        a, b = (np.round(np.array(s), 9) for s in samples)
        for i in range(_N):
            for j in range(a.shape[2]):
                x, y = a[:, i, j], b[:, i, j]
                assert ks_2samp(x, y).pvalue >= FALSE_ALARM / a[0].size, (
                    f"particle {i} moves differently as number {orders[1][i]} (mean {x.mean():.3g}, {y.mean():.3g})"
                )


class DensityTransitionContract(TransitionContract):
    """The contract of every `DensityTransition`: that of a `Transition`, and properties of `log_prob`."""

    def test_log_prob_of_own_moves_is_finite(self) -> None:
        """`log_prob` gives one finite number for each move that `predict` makes."""
        component = self.make()
        for n in (1, _N):
            inputs = self.inputs(n)
            found = self._log_prob(component, inputs, self.checked_call(component, inputs))
            assert found.shape == (n,), f"log densities of {n} moves have shape {found.shape}, expected ({n},)"
            assert np.isfinite(found).all(), f"log density of a move is {found[~np.isfinite(found)][0]}"

    def test_log_prob_of_a_move_does_not_depend_on_others(self) -> None:
        """`log_prob` treats every pair of rows alone."""
        component, inputs = self.make(), self.inputs(_N)
        moved, rows = self.checked_call(component, inputs), np.array([4, 0, 3])
        found = self._log_prob(component, inputs, moved)
        fewer_inputs = {**inputs, "population": inputs["population"].take(rows)}
        fewer = self._log_prob(component, fewer_inputs, moved.take(rows))
        assert np.allclose(fewer, found[rows], atol=1e-9), "three of six moves have other log densities alone"

    @staticmethod
    def _log_prob(component: DensityTransition, inputs: dict[str, Any], moved: Population) -> np.ndarray:
        with reports_errors("log_prob"):
            old = inputs["population"].particles
            return np.asarray(component.log_prob(old, moved.particles, inputs["observation"]))


class ProposalContract(_PopulationContract):
    """The contract of every `Proposal`."""

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"observation": self.example(_rng(0), 2)[1], "n": n}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.sample(rng, inputs["observation"], inputs["n"])

    def test_gives_n_particles(self) -> None:
        """It returns n particles for any n."""
        component = self.make()
        for n in (1, 2, 7, 20):
            found = self.checked_call(component, self.inputs(n))
            assert len(found) == n, f"asked for {n} particles it returns {len(found)}: repeat some if needed"


class UpdateContract(_PopulationContract):
    """The contract of every `Update`."""

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        predicted, observation = self.example(_rng(seed), n)
        proposed = replace(self.example(_rng(seed + 1), 4)[0], log_weights=np.zeros(4))
        return {"predicted": predicted, "proposed": proposed, "observation": observation}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.update(rng, **inputs)

    def test_takes_any_of_its_inputs(self) -> None:
        """It accepts predicted particles, proposed ones, or both."""
        component, inputs = self.make(), self.inputs(_N)
        for absent in ({"proposed": None}, {"predicted": None}, {}):
            self.checked_call(component, {**inputs, **absent})

    def test_parents_exist(self) -> None:
        """Parents are indices of particles that exist, or -1."""
        inputs = self.inputs(_N)
        sizes = {"previous": len(inputs["predicted"]), "proposed": len(inputs["proposed"])}
        for name, population in (("previous", "predicted"), ("proposed", "proposed")):
            inputs[population] = replace(inputs[population], parents={name: np.arange(sizes[name])})
        out = self.checked_call(self.make(), inputs)
        for name, n in sizes.items():
            index = out.parents.get(name, np.array([-1]))
            assert ((index >= -1) & (index < n)).all(), (
                f'parents "{name}" contain {int(np.max(index))}, and there were {n} particles'
            )

    def test_scale_of_weights_is_irrelevant(self) -> None:
        """A common factor of the weights is kept and has no other effect."""
        self.check_scale({**self.inputs(_N), "proposed": None}, "predicted")


class RejuvenationContract(_PopulationContract):
    """The contract of every `Rejuvenation`. Its one statistical test has a false-alarm rate of at most 1e-6.

    That test needs exact draws of p(x_t | x_{t-1}, y_t). Define a method ``exact(self, rng, n)`` that returns a
    population of `n` rows x_{t-1} (None: the first step), a population of draws x_t given them and y_t, and y_t.
    """

    exact: Callable[[np.random.Generator, int], tuple[Population | None, Population, Any]] | None = None

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {**super().inputs(n, seed), "previous": self.example(_rng(seed + 1), n)[0]}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.move(rng, inputs["population"], inputs["previous"], inputs["observation"])

    def test_keeps_number_and_weights(self) -> None:
        """It returns as many particles, with unchanged log weights, also if the past or the observation is None."""
        component = self.make()
        for n in (1, 2, _N):
            inputs = self.inputs(n)
            for absent in ({}, {"previous": None}, {"observation": None}):
                moved = self.checked_call(component, {**inputs, **absent})
                assert len(moved) == n, f"{n} particles became {len(moved)}"
                assert same(moved.log_weights, inputs["population"].log_weights), (
                    "it changes log weights: a kernel that keeps the distribution leaves them unchanged"
                )

    @statistical
    def test_keeps_the_distribution(self) -> None:
        """It leaves p(x_t | x_{t-1}, y_t) unchanged."""
        from scipy.stats import ks_2samp

        component = self.make()
        skip_unless_properly_weighted(component)
        if self.exact is None:
            pytest.skip("there are no exact draws to compare with: write exact(rng, n)")
        # Exact draws after five moves against other exact draws: x_t, and x_t - x_{t-1}.
        n, rng = 4000, _rng(2)
        previous, population, observation = self.exact(_rng(1), n)
        for _ in range(5):
            inputs = {"population": population, "previous": previous, "observation": observation}
            population = self.checked_call(component, inputs, rng)
        moved = _columns(previous, population)
        fresh_previous, fresh, _ = self.exact(_rng(3), n)
        expected = _columns(fresh_previous, fresh)
        for j in range(moved.shape[1]):
            what = f"x_t ({j})" if j < moved.shape[1] / 2 or previous is None else "x_t - x_{t-1}"
            assert ks_2samp(moved[:, j], expected[:, j]).pvalue >= FALSE_ALARM / moved.shape[1], (
                f"exact draws are no longer exact after five moves: {what} has mean {moved[:, j].mean():.4g} and sd "
                f"{moved[:, j].std():.4g}, expected {expected[:, j].mean():.4g} and {expected[:, j].std():.4g}"
            )


def _columns(previous: Population | None, population: Population) -> np.ndarray:
    """x_t, and x_t - x_{t-1} if both have as many columns."""
    x = as_matrix(population.particles)
    if previous is None:
        return x
    old = as_matrix(previous.particles)
    return np.concatenate([x, x - old], axis=1) if old.shape == x.shape else x
