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
from mstfilter.testing.copies import quantile

_N = 6


def _rng(seed: int = 3) -> np.random.Generator:
    return np.random.default_rng(seed)


class _PopulationContract(RandomContract):
    """What contracts share of components that return a population."""

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, Population), f"it returns {type(result).__name__}, expected a Population"

    def check_scale(self, inputs: dict[str, Any], name: str) -> None:
        """Check that adding a number to the log weights of the population `name` adds it to those of the result."""
        component = skip_unless_properly_weighted(self.make())
        unshifted = self.checked_call(component, inputs)
        for shift in (50.0, -50.0):
            population = inputs[name].reweighted(np.full(len(inputs[name]), shift))
            shifted = self.checked_call(component, {**inputs, name: population})
            equal = len(unshifted) == len(shifted) and np.allclose(
                shifted.log_weights - shift, unshifted.log_weights, atol=1e-9, rtol=0
            )
            assert equal, f"log weights + {shift:g} in do not give log weights + {shift:g} out"


class _ExactContract(_PopulationContract):
    """Properties of components with exact draws to compare with.

    Define a method ``exact(self, rng, n)`` (or a function ``exact(rng, n)`` beside the component). It returns a
    population of `n` particles before the call, a population of exact draws, or with exact weights, after it, and the
    observation. A fourth item ``log_likelihood(particles) -> (n,)`` multiplies the weights on both sides: it makes
    the weights f / q of a guided move even. The test is skipped if one of 10,000 weights exceeds 1 % of the total.
    """

    exact: Callable[[np.random.Generator, int], tuple[Any, ...]] | None = None

    def exact_case(self, seed: int, n: int = 10_000) -> tuple[Any, ...]:
        """Exact draws; skips the test if there are none."""
        if self.exact is None:
            pytest.skip("there are no exact draws to compare with: write exact(rng, n)")
        return self.exact(_rng(seed), n)

    def compare_weighted(self, found: np.ndarray, lw: np.ndarray, exact: np.ndarray, exact_lw: np.ndarray) -> None:
        """Compare the weighted distributions of rows, by the probabilities of 19 intervals of each column.

        The difference of two weighted means is normal up to errors that a twentieth of the level allows for.
        """
        samples = []
        for log_weights in (lw, exact_lw):
            w = np.exp(log_weights - log_weights.max())
            w /= w.sum()
            if w.max() > 0.01:
                pytest.skip(
                    f"the weights of the exact case are too uneven (effective sample size {1 / (w @ w):.3g}): "
                    "return log p(y | x_t) as a fourth item of exact"
                )
            samples.append(w)
        for j in range(found.shape[1]):
            order = np.argsort(exact[:, j])
            cumulative = np.cumsum(samples[1][order])[:-1]
            limits = exact[order[cumulative.searchsorted(np.arange(0.05, 1, 0.05))], j]
            (p, s), (q, r) = (
                _weighted_fractions(x[:, j], w, limits) for x, w in zip((found, exact), samples, strict=True)
            )
            what = self.columns(j, found.shape[1])
            excess = np.abs(p - q) - quantile(40 * found.shape[1] * len(limits)) * np.hypot(s, r) - 1e-9
            k = int(np.argmax(excess))
            assert excess[k] <= 0, (
                f"the weighted distribution is wrong: {what} is below {limits[k]:.3g} with probability {p[k]:.3f}, "
                f"expected {q[k]:.3f}"
            )

    def columns(self, j: int, n_columns: int) -> str:
        """What column `j` is."""
        return (
            f"coordinate {j} of x_t" if 2 * j < n_columns else f"coordinate {j - n_columns // 2} of x_t - x_{{t-1}}"
        )


def _weighted_fractions(x: np.ndarray, w: np.ndarray, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities that x is at most each limit, and their standard errors, for weights that sum to one."""
    below = x[:, None] <= limits
    p = w @ below
    return p, np.sqrt((w * w) @ (below - p) ** 2)


class TransitionContract(_ExactContract):
    """The contract of every `Transition`. Its two statistical tests have a false-alarm rate of at most 1e-6 each.

    One needs a method ``exact(self, rng, n)`` that returns n rows x_{t-1}, draws of x_t from f(x_t | x_{t-1}) given
    them, and the observation; for a guided move also log p(y_t | x_t), a function of x_t. If the transition weights
    by the observation, the population of x_t has these weights.
    """

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

    def test_weights_stay_with_their_particles(self) -> None:
        """It keeps the order of the particles, or sets parents "previous"."""
        component, inputs = skip_unless_properly_weighted(self.make()), self.inputs(_N)
        old = 0.1 * np.arange(_N) ** 2
        given = replace(inputs["population"], log_weights=old, parents={})
        moved = self.checked_call(component, {**inputs, "population": given})
        parents = moved.parents.get("previous", np.arange(len(moved)))
        permuted = len(moved) == _N and same(np.sort(moved.log_weights), old) and (parents >= 0).all()
        assert not permuted or np.array_equal(moved.log_weights, old[parents]), (
            'the particles have another order than before, and parents "previous" do not state it'
        )

    @statistical
    def test_weighted_moves_are_those_of_the_model(self) -> None:
        """Weighted moves have the distribution of the model, also jointly with x_{t-1}, and keep the total weight."""
        component = skip_unless_properly_weighted(self.make())
        population, _, observation, *likelihood = self.exact_case(1)
        moved = self.checked_call(component, {"population": population, "observation": observation}, _rng(2))
        other, fresh, *_ = self.exact_case(3)
        before = population.take(moved.parents.get("previous", np.arange(len(moved))))
        change, exact_lw = moved.log_weights - before.log_weights, fresh.log_weights - other.log_weights
        log_g = sum(log_likelihood(moved.particles) for log_likelihood in likelihood)
        exact_lw = exact_lw + sum(log_likelihood(fresh.particles) for log_likelihood in likelihood)
        found, exact, lw = _columns(before, moved), _columns(other, fresh), log_g + change
        try:
            self.compare_weighted(found, lw, exact, exact_lw)
        except (AssertionError, pytest.skip.Exception) as error:
            try:
                self.compare_weighted(found, log_g - change, exact, exact_lw)
            except (AssertionError, pytest.skip.Exception):
                raise error from None
            raise AssertionError(
                "the weighted distribution is right if the change of the log weights has the opposite sign: "
                "is it log q - log f?"
            ) from error
        w, v = np.exp(lw), np.exp(exact_lw)
        bound = quantile(40) * np.hypot(w.std() / len(w) ** 0.5, v.std() / len(v) ** 0.5) + 1e-9
        assert abs(w.mean() - v.mean()) <= bound, f"the mean weight is {w.mean():.4g}, expected {v.mean():.4g}"

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
        noise = a - a.mean(axis=0)
        spread = np.abs(noise).max(axis=(0, 1))
        for c in np.flatnonzero(spread > 1e-6):
            assert np.abs(noise[:, :, c] - noise[:, :1, c]).max() > 1e-6 * spread[c], (
                "all particles get the same noise: draw one random number for each, size=len(population)"
            )
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


class UpdateContract(_ExactContract):
    """The contract of every `Update`. Its one statistical test has a false-alarm rate of at most 1e-6.

    That test needs a method ``exact(self, rng, n)`` that returns n predicted particles x ~ p(x), exact draws of
    p(x | y) or the predicted particles with exact weights p(y | x), and y. A constant factor of the weights is free.
    """

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

    def test_parents_belong_to_their_particles(self) -> None:
        """A predicted particle that it keeps has that particle as parent "previous"."""
        inputs = {**self.inputs(_N), "proposed": None}
        inputs["predicted"] = replace(inputs["predicted"], parents={"previous": np.arange(_N)})
        out = self.checked_call(self.make(), inputs).realised()
        index = out.parents.get("previous", np.arange(len(out)))
        old = [inputs["predicted"].take(np.array([i])).particles for i in range(_N)]
        for k in range(len(out)):
            copies = [i for i in range(_N) if same(out.take(np.array([k])).particles, old[i])]
            assert not copies or index[k] in copies or index[k] < 0, (
                f'particle {k} is predicted particle {copies[0]}, and its parent "previous" is {int(index[k])}'
            )

    @statistical
    def test_weights_are_those_of_the_posterior(self) -> None:
        """Weighted predicted particles have the distribution p(x | y)."""
        component = skip_unless_properly_weighted(self.make())
        predicted, _, observation, *_ = self.exact_case(1)
        inputs = {"predicted": predicted, "proposed": None, "observation": observation}
        out = self.checked_call(component, inputs, _rng(2))
        _, exact, *_ = self.exact_case(3)
        self.compare_weighted(
            as_matrix(out.particles), out.log_weights, as_matrix(exact.particles), exact.log_weights
        )

    def columns(self, j: int, n_columns: int) -> str:
        return f"coordinate {j} of x"

    def test_scale_of_weights_is_irrelevant(self) -> None:
        """A common factor of the weights is kept and has no other effect."""
        self.check_scale({**self.inputs(_N), "proposed": None}, "predicted")


class RejuvenationContract(_ExactContract):
    """The contract of every `Rejuvenation`. Its one statistical test has a false-alarm rate of at most 1e-6.

    That test needs exact draws of p(x_t | x_{t-1}, y_t). Define a method ``exact(self, rng, n)`` that returns a
    population of `n` rows x_{t-1} (None: the first step), a population of draws x_t given them and y_t, and y_t.
    """

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

        component = skip_unless_properly_weighted(self.make())
        # Exact draws after five moves against other exact draws: x_t, and x_t - x_{t-1}.
        n, rng = 4000, _rng(2)
        previous, population, observation = self.exact_case(1, n)
        for _ in range(5):
            inputs = {"population": population, "previous": previous, "observation": observation}
            population = self.checked_call(component, inputs, rng)
        moved = _columns(previous, population)
        fresh_previous, fresh, _ = self.exact_case(3, n)
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
