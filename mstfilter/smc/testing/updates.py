"""Contracts of what makes and weighs particles: proposals and updates.

An update multiplies the weight of each predicted particle by a factor that depends on this particle and the
observation, p(y_t | x_t) in a bootstrap filter. A proposal draws as many particles as it is asked for, independently.
Comparisons with exact draws need a method `exact` (`mstfilter.smc.testing.exact`).

>>> from mstfilter.smc import Reweight
>>> from mstfilter.smc.testing import UpdateContract, check_properties
>>> update = Reweight(lambda x, y: -0.5 * (x - x.mean() - y) ** 2)                    # x.mean() mixes particles
>>> [result.name for result in check_properties(update, UpdateContract) if result.failure]
['weight_of_a_particle_does_not_depend_on_others']
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest import SkipTest

import numpy as np

from mstfilter.smc import Population, as_matrix
from mstfilter.smc.population import take
from mstfilter.smc.testing.contract import (
    ScaleContract,
    reports_errors,
    same,
    seeded,
    skip_unless_properly_weighted,
    statistical,
)
from mstfilter.smc.testing.exact import (
    DrawsContract,
    ExactContract,
    WeightedRows,
    check_mean_weight,
    check_parents,
    compare_factors,
)

_N = 6


class ProposalContract(DrawsContract):
    """The contract of every `Proposal`. Each statistical test has a false-alarm rate of at most 1e-6.

    Two tests need a method ``exact(self, rng, n)`` that returns n exact draws from the distribution of the weighted
    particles, and the observation. For an initial proposal the exact draws are from p(x_0). An optional third item
    ``log_likelihood(particles) -> (n,)`` multiplies all weights, so that the weights vary less.
    """

    exact_types = (Population,)
    independent = False

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"observation": self.example(seeded(0), 2)[1], "n": n}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.sample(rng, inputs["observation"], inputs["n"])

    def variants(self) -> list[dict[str, Any]]:
        return [self.inputs(n) for n in (1, 2, 20)]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        found, n = len(result), inputs["n"]
        assert found == n, f"asked for {n} particles it returns {found}: repeat some if needed"

    def check_unused_generator(self, own: bool) -> None:
        super().check_unused_generator(own)
        component = self.make()
        particles = self.checked_call(component, self.inputs(6)).realised().particles
        equal = all(same(take(particles, np.array([0])), take(particles, np.array([k]))) for k in range(1, 6))
        assert equal or not component.properly_weighted, (
            "it returns the same different particles at every call and never uses its generator: draw from `rng`, or "
            "declare draws = False and properly_weighted = False"
        )

    def rows_of(self, case: tuple[Any, ...], rows: np.ndarray, rng: np.random.Generator) -> WeightedRows:
        _, observation, *likelihood = case
        found = self.checked_call(self.make(), {"observation": observation, "n": len(rows)}, rng)
        return self.exact_rows((found, observation, *likelihood))

    def exact_rows(self, case: tuple[Any, ...]) -> WeightedRows:
        population, _, *likelihood = case
        log_g = sum(log_g(population.particles) for log_g in likelihood)
        return as_matrix(population.particles), population.log_weights + log_g

    @statistical
    def test_draws_vary_like_independent_ones(self) -> None:
        """Means of draws vary at most like means of independent draws."""
        skip_unless_properly_weighted(self.make())
        component, inputs = self.make(), self.inputs(100)
        if self.exact is not None:
            inputs["observation"] = self.exact_case(1, 1)[1]
        if not isinstance(self.checked_call(component, {**inputs, "n": 2}).particles, (np.ndarray, dict)):
            raise SkipTest("the particles are objects")
        found = (self.checked_call(component, inputs, seeded(seed)) for seed in range(100, 500))
        calls = [as_matrix(population.particles) for population in found]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = 100 * np.mean(calls, axis=1).var(axis=0) / np.concatenate(calls).var(axis=0)
        # Stratified and sorted draws pass. 1.45 is above the quantile 1 - 1e-7 of chi^2_399 / 399.
        assert not (ratio > 1.45).any(), (
            f"means of 100 draws have {np.nanmax(ratio):.3g} times the variance of independent ones: is a random "
            "number used for several particles?"
        )


class UpdateContract(ScaleContract, ExactContract):
    """The contract of every `Update`. The statistical test has a false-alarm rate of at most 1e-6.

    The statistical test needs a method ``exact(self, rng, n)`` that returns n predicted particles x ~ p(x), a second
    population, and y. The second population holds exact draws of p(x | y), or the predicted particles with exact
    weights p(y | x). Exact weights are compared one by one, including a constant factor. For exact draws, the
    evidence is tested only if a fourth item of `exact` is log p(y).
    """

    weighted = "predicted"

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        predicted, observation = self.example(seeded(seed), n)
        predicted = replace(predicted, parents={"previous": np.arange(n)})
        proposed = self.example(seeded(seed + 1), 4)[0]
        proposed = replace(proposed, log_weights=np.zeros(4), parents={"proposed": np.arange(4)})
        return {"predicted": predicted, "proposed": proposed, "observation": observation}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.update(rng, inputs["predicted"], inputs["proposed"], inputs["observation"])

    def variants(self) -> list[dict[str, Any]]:
        """Inputs with predicted particles, with proposed particles, and with predicted and proposed particles."""
        return [{**self.inputs(_N), **absent} for absent in ({"proposed": None}, {"predicted": None}, {})]

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        for name, given in (("previous", inputs["predicted"]), ("proposed", inputs["proposed"])):
            if given is not None:
                check_parents(result, name, len(given))

    def test_parents_belong_to_their_particles(self) -> None:
        """A particle of the result that equals a predicted particle has its index as parent "previous"."""
        inputs = {**self.inputs(_N), "proposed": None}
        out = self.checked_call(self.make(), inputs).realised()
        index = out.parents.get("previous", np.arange(len(out)))
        old = [take(inputs["predicted"].particles, np.array([i])) for i in range(_N)]
        for k in range(len(out)):
            copies = [i for i in range(_N) if same(take(out.particles, np.array([k])), old[i])]
            assert not copies or index[k] in copies or index[k] < 0, (
                f'particle {k} is predicted particle {copies[0]}, and its parent "previous" is {int(index[k])}'
            )

    def test_weight_of_a_particle_does_not_depend_on_others(self) -> None:
        """The factor by which the weight of a particle changes does not depend on the other particles."""
        component, inputs = skip_unless_properly_weighted(self.make()), {**self.inputs(_N), "proposed": None}
        every = self._factors(component, inputs, np.arange(_N))
        if every is None:
            raise SkipTest("it makes other particles than the predicted ones")
        if not same(every, self._factors(component, inputs, np.arange(_N), seed=4)):
            raise SkipTest("its weights are random")
        rows = np.argsort(-every)[:3]  # the heaviest, since no population is without weight
        some = self._factors(component, inputs, rows)
        assert some is None or np.allclose(some, every[rows], rtol=1e-9, atol=1e-9), (
            f"the log weights of particles change by {every[rows]} among six particles, and by {some} among three: "
            "likelihoods are not normalised or ranked"
        )

    def _factors(self, component: Any, inputs: dict[str, Any], rows: np.ndarray, seed: int = 3) -> np.ndarray | None:
        """Changes of the log weights of some of the predicted particles; None if the result has other particles."""
        given = inputs["predicted"].take(rows).labelled({"previous": np.arange(len(rows))})
        out = self.checked_call(component, {**inputs, "predicted": given}, seeded(seed))
        kept = len(out) == len(given) and same(out.realised().particles, given.realised().particles)
        return out.log_weights - given.log_weights if kept else None

    def test_order_of_particles_is_irrelevant(self) -> None:
        """Predicted particles in another order get the same weights, if the update keeps the particles."""
        component, inputs = self.make(), {**self.inputs(_N), "proposed": None}
        every = self._factors(component, inputs, np.arange(_N))
        if every is None or not same(every, self._factors(component, inputs, np.arange(_N), seed=4)):
            raise SkipTest("it makes other particles than the predicted ones, or its weights are random")
        for rows in (np.arange(_N)[::-1], np.roll(np.arange(_N), 1)):
            found = self._factors(component, inputs, rows)
            assert found is None or np.allclose(found, every[rows], rtol=1e-6, atol=1e-6), (
                f"the log weights of particles change by {every[rows]}, and in another order by {found}: a weight "
                "depends on the place in the array"
            )

    def test_weights_of_distant_particles_are_numbers(self) -> None:
        """Particles far from the observation get a small weight or none, but not NaN."""
        if not self.on_numbers:
            raise SkipTest("the particles have an example of their own")
        inputs = {**self.inputs(_N), "proposed": None}
        predicted = inputs["predicted"]
        far = predicted.moved(np.where(np.arange(_N) < 3, 1.0, 20.0) * predicted.particles)
        with np.errstate(all="ignore"), reports_errors("three of six particles are far from the observation"):
            self.check_result(self.call(self.make(), seeded(3), {**inputs, "predicted": far}), inputs)

    @statistical
    def test_weights_are_those_of_the_posterior(self) -> None:
        """Weighted predicted particles have the distribution p(x | y), and the exact evidence if it is given."""
        component = skip_unless_properly_weighted(self.make())

        def updated(n: int, seed: int = 2) -> tuple[Population, Population]:
            predicted, _, observation, *_ = self.exact_case(1, n)
            inputs = {"predicted": predicted, "proposed": None, "observation": observation}
            return predicted, self.checked_call(component, inputs, seeded(seed))

        n = self.draws_in_time(updated)
        predicted, out = updated(n)
        _, weighted, _, *evidence = self.exact_case(1, n)
        if as_matrix(out.particles).shape[1] != as_matrix(weighted.particles).shape[1]:
            raise SkipTest("its particles have another dimension than the exact ones")
        if same(out.particles, predicted.particles) and same(weighted.particles, predicted.particles):
            if same(out.log_weights, updated(n, seed=5)[1].log_weights):
                compare_factors(out.log_weights, weighted.log_weights)
            evidence = [weighted.log_mean_weight]
        _, exact, *_ = self.exact_case(3, n)
        x, lw = _merged(as_matrix(out.particles), out.log_weights)
        self.compare_weighted(x, lw, as_matrix(exact.particles), exact.log_weights)
        for log_evidence in evidence:
            w = np.exp(out.log_weights - predicted.log_mean_weight - log_evidence)
            v = np.exp(exact.log_weights - log_evidence) if np.ptp(exact.log_weights) else np.ones(n)
            check_mean_weight(w, v)


def _merged(x: np.ndarray, log_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows without copies, and the log of the sum of the weights of each row."""
    rows, index = np.unique(x, axis=0, return_inverse=True)
    if len(rows) == len(x):
        return x, log_weights
    top = log_weights.max()
    return rows, np.log(np.bincount(index.ravel(), np.exp(log_weights - top))) + top
