"""Contracts of resamplers.

A resampler is properly weighted if the expected mean of w f(x) over the selected particles is that over all of them,
for every f. So a particle of normalised weight W_i must get n W_i copies on average. If output weights differ, the
copies must have the total weight W_i on average. The contract resamples small populations many times, among them ones
with ties, zeros and one heavy weight (`mstfilter.smc.testing.copies`):

>>> import numpy as np
>>> from dataclasses import dataclass
>>> from mstfilter.smc import WeightResampler
>>> from mstfilter.smc.testing import WeightResamplerContract, check_properties
>>> @dataclass(frozen=True)
... class Rounded(WeightResampler):
...     # n W_i copies, rounded down; the heaviest particle gets the rest
...     def select(self, rng, log_weights, n):
...         W = np.exp(log_weights - log_weights.max())
...         copies = np.floor(n * W / W.sum()).astype(int)
...         copies[W.argmax()] += n - copies.sum()
...         return np.repeat(np.arange(len(W)), copies), None
>>> results = check_properties(Rounded(), WeightResamplerContract)
>>> next(result.failure for result in results if result.name == "carried_weight")     # it favours one of them
'...copies are biased: particle ...'

A scheme that declares itself not properly weighted, as `LargestWeights` does, may be biased.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from mstfilter.smc import Population, Resampler, WeightResampler
from mstfilter.smc.population import take
from mstfilter.smc.testing.contract import (
    FALSE_ALARM,
    ScaleContract,
    same,
    seeded,
    skip_unless_properly_weighted,
    statistical,
)
from mstfilter.smc.testing.copies import CASES, MOST_CALLS, Case, Sample, fault_message

_ZEROS = ((0, 0, 1, 2, 3), (1, 2, 3, 0, 0), (1, 0, 2, 0, 3), (0, 0, 0, 1, 0), (0, 1, 0, 0, 0))


class ResamplerContract(ScaleContract):
    """The contract of every `Resampler`. The statistical tests have a false-alarm rate of at most 1e-6 each.

    The particles of `example` must differ. The tests detect a mean that deviates by about six standard errors over
    the calls of a `Case`, if the deviation is at least 0.3 % of the particle's weight.
    """

    returns = Population
    #: Fewer calls and particles than for a `WeightResampler`: schemes that compare particles are slower.
    cases: tuple[Case, ...] = tuple(
        replace(case, calls=case.calls // max(2, len(case.weights) // 15))
        for case in CASES
        if len(case.weights) < 500
    )

    def population(self, weights: Any) -> Population:
        """The particles of `example` with the given weights. The parents identify the particles."""
        n = len(weights)
        particles = self.example(seeded(0), n)[0].realised().particles
        index = np.arange(n)
        with np.errstate(divide="ignore"):
            log_weights = np.log(weights)
        return Population(particles, log_weights, {"previous": index[::-1], "proposed": index + n})

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.population(np.linspace(1, 2 + seed, 40)), "n": 25}

    def variants(self) -> list[dict[str, Any]]:
        """Inputs with m > n, m = n and m < n particles, and with weights of zero."""
        cases = [(np.linspace(1, 2, m), n) for m, n in ((40, 25), (20, 20), (30, 80), (1, 3), (2, 1))]
        cases.append((np.array(_ZEROS[0]), 5))
        return [{"population": self.population(weights), "n": n} for weights, n in cases]

    def call(self, component: Resampler, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.resample(rng, inputs["population"], inputs["n"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        ancestors = result.parents.get("ancestor")
        assert ancestors is not None, 'the result has no parents "ancestor"'
        m, found, n = len(inputs["population"]), len(result), inputs["n"]
        wrong = ancestors[(ancestors < 0) | (ancestors >= m)]
        assert not len(wrong), f"ancestor {wrong[0]} is out of range: there are {m} particles; off by one?"
        scheme = self.make()
        enough = found == n if scheme.exact_size else found >= 1 and (found <= n or scheme.chooses_n)
        assert enough, f"asked to make {n} particles of {m} it returns {found}"

    def features(self, result: Population, given: Population) -> np.ndarray:
        """(2m,) number and total weight of the copies of each particle."""
        ancestors, m = result.parents["ancestor"], len(given)
        carried = np.exp(result.log_weights - given.log_mean_weight)
        return np.concatenate([np.bincount(ancestors, weights, m) for weights in (None, carried)])

    def resample(self, component: Resampler, population: Population, n: int, rng: np.random.Generator) -> Population:
        return self.checked_call(component, {"population": population, "n": n}, rng)

    def test_zero_weights_are_never_chosen(self) -> None:
        """A particle of weight zero is never selected."""
        for seed, weights in product(range(60), _ZEROS):
            chosen = self.resample(self.make(), self.population(weights), (1, 4, 5, 11)[seed % 4], seeded(seed))
            ancestors = chosen.parents["ancestor"]
            wrong = ancestors[np.asarray(weights)[ancestors] == 0]
            assert not len(wrong), (
                f"of weights {weights} it selects particle {wrong[0]}, weight 0: use np.searchsorted with "
                'side="right", and end at a particle with weight'
            )

    def test_keeps_parents(self) -> None:
        """The selected particles equal the particles at the ancestors, and keep their parents."""
        component = self.make()
        for n in (1, 4, 5, 12):
            population = self.population((1.0, 2.0, 1.5, 0.5, 2.0))
            chosen = self.resample(component, population, n, seeded(1))
            expected = population.take(chosen.parents["ancestor"])
            for name, index in expected.parents.items():
                assert name in chosen.parents and np.array_equal(chosen.parents[name], index), (
                    f'parents "{name}" of the result are not those of the ancestors'
                )
            assert same(chosen.realised().particles, expected.particles), (
                "the particles of the result are not those of the ancestors"
            )

    @statistical
    def test_carried_weight(self) -> None:
        """A particle gets n W_i copies on average, or copies of total weight W_i if output weights differ."""
        component = skip_unless_properly_weighted(self.make())
        for seed, case in enumerate(self.cases):
            self.tested = f"out of time after {seed} of {len(self.cases)} cases, in which it holds"
            sample = self._carried(component, case, seed)
            assert self._excess(sample) <= 0, fault_message(sample, int(np.argmax(sample.evidence())))

    @statistical
    def test_carried_weight_of_equal_particles(self) -> None:
        """Each of two equal particles carries its weight on average. A scheme that merges them draws one."""
        component = skip_unless_properly_weighted(self.make())
        for seed, case in enumerate(self.cases[:4]):
            self.tested = f"out of time after {seed} of 4 cases, in which it holds"
            sample = self._carried(component, case, seed, repeats=2)
            message = "of equal particles: " + fault_message(sample, int(np.argmax(sample.evidence())))
            assert self._excess(sample) <= 0, message

    def _carried(self, component: Resampler, case: Case, seed: int, repeats: int = 1) -> Sample:
        """The weight of the copies of each particle and each group of particles in many calls.

        Calls are added while a mean deviates but the evidence against the scheme is below the bound.
        """
        given = self.population(case.weights)
        given = replace(given, particles=take(given.particles, np.arange(len(given)) // repeats))
        population = Population(given.particles, given.log_weights + 3.0)  # faster without parents
        rng, sample, calls = seeded(seed), Sample(case), case.calls
        while True:
            while sample.calls < calls:
                chosen = self.checked_call(component, {"population": population, "n": case.n}, rng)
                sample.add(chosen.parents["ancestor"], np.exp(chosen.log_weights - population.log_mean_weight))
            clear = sample.evidence().max() == 0 or self._excess(sample) > 0
            if clear or calls >= MOST_CALLS * case.calls:
                return sample
            calls *= 2

    def _excess(self, sample: Sample) -> float:
        """Largest log evidence against a mean, minus its bound at level `FALSE_ALARM` for all cases together."""
        evidence = sample.evidence()
        return float(evidence.max() - np.log(2 * len(evidence) * len(self.cases) / FALSE_ALARM))


class WeightResamplerContract(ResamplerContract):
    """The contract of every `WeightResampler`: the properties of `ResamplerContract`, and one of `select`."""

    cases = CASES

    @statistical
    def test_many_particles(self) -> None:
        """Small weights of 100 000 particles are not lost by rounding."""
        component = skip_unless_properly_weighted(self.make())
        few, many = self._light_copies(component, 100, 60), self._light_copies(component, 100_000, 5)
        # If all are draws of one law, the five are above, or below, all sixty with probability 1 / C(65, 5) = 1.2e-7.
        assert many.max() >= few.min() - 80 and many.min() <= few.max() + 80, (
            f"100 000 particles that share a thousandth of the weight get {many.mean():.0f} copies in total, and 100 "
            f"particles that share it get {few.mean():.0f}: cumulated in single precision?"
        )

    def _light_copies(self, component: WeightResampler, n_light: int, calls: int) -> np.ndarray:
        """Copies of light particles among 100 000 copies. Light particles have .1 % of the weight of particle 0."""
        n, rng, copies = 100_000, seeded(n_light), []
        weights = np.append(1.0, np.full(n_light, 1e-3 / n_light))
        population = Population(np.arange(float(len(weights))), np.log(weights))
        seconds = self._seconds(component, population, n)
        self.check_time(3 * seconds, f"out of time: a selection of 100 000 particles takes about {seconds:.0f} s")
        for _ in range(calls):
            chosen = self.resample(component, population, n, rng)
            share = np.exp(chosen.log_weights - population.log_mean_weight)
            copies.append(share[chosen.parents["ancestor"] > 0].sum() * (n / len(chosen)))
        return np.array(copies)

    def _seconds(self, component: WeightResampler, population: Population, n: int) -> float:
        """Time of a call, estimated from two calls with few particles; 0 if the time of the test is not bounded."""
        if self.until == math.inf:
            return 0.0
        seconds = []
        for size in (2000, 8000):
            few = population.take(np.arange(min(size, len(population))))
            start = time.monotonic()
            self.resample(component, few, size, seeded(1))
            seconds.append(time.monotonic() - start)
        power = np.log(seconds[1] / seconds[0]) / np.log(4) if seconds[1] > 0.01 else 1.0
        return float(seconds[1] * (n / 8000) ** np.clip(power, 1.0, 2.5))
