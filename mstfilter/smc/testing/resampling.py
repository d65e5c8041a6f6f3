"""Contracts of resamplers.

A resampler must be properly weighted. A particle of normalised weight W_i gets n W_i copies on average, or copies
that together carry W_i if their weights differ. `mstfilter.smc.testing.copies` lists the weights and numbers of
particles of the tests: n = m, n < m and n > m, ties, zeros, heavy and light weights.

A scheme that makes new particles instead of copies is a `TransformResampler` and has another law. The new population
keeps the weighted mean of the particles, and its output weights are equal.

A scheme may be correct and slow. For example, the cost of rejection grows with max w / mean w. The generator of the
statistical tests counts its draws. A case that exceeds the budget is skipped as "too slow at this weight". The clock
is not used, so the outcome of a check does not depend on the machine.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest import SkipTest

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc import Population, Resampler, TransformResampler, WeightResampler, as_matrix
from mstfilter.smc.testing.contract import (
    FALSE_ALARM,
    BatchedContract,
    Contract,
    prerequisite,
    same,
    seeded,
    skip_unless_properly_weighted,
    statistical,
)
from mstfilter.smc.testing.copies import (
    BUDGET,
    CASES,
    HEAVY_CASES,
    HEAVY_CASES_OF_WEIGHTS,
    MOST_CALLS,
    Case,
    ConstantGenerator,
    CountingGenerator,
    Sample,
    evidence_hint,
    fault_message,
    log_of,
)

_ZEROS = ((0, 0, 1, 2, 3), (1, 2, 3, 0, 0), (1, 0, 2, 0, 3))


class ResamplerContract(Contract):
    """The contract of every `Resampler`. The statistical tests have a false-alarm rate of at most 1e-6 each.

    The particles of the example must differ. The tests detect a deviation of a mean of about six standard errors in
    the calls of a `Case`, and at least 0.3 % of the particle's weight.
    """

    #: Fewer calls: schemes that compare particles are slower.
    cases: tuple[Case, ...] = tuple(
        replace(case, calls=case.calls // max(2, len(case.weights) // 15)) for case in CASES
    )
    heavy_cases: tuple[Case, ...] = (replace(HEAVY_CASES[0], calls=400),)

    def population(self, weights: Any) -> Population:
        """The particles of the example with given weights, and with parents that identify them."""
        n = len(weights)
        particles = self.example(seeded(0), n)[0].realised().particles
        index = np.arange(n)
        return Population(particles, log_of(weights), {"previous": index[::-1], "proposed": index, "mate": index + n})

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.population(np.linspace(1, 2 + seed, 40)), "n": 25}

    def variants(self) -> list[dict[str, Any]]:
        """More particles than are selected, as many, and fewer; also weights of zero."""
        weights = (np.linspace(1, 2, 40), (0.2, 0.5, 0.3, 0.9, 0.4, 0.6, 0.1), (0.5, 0.2, 0.7), _ZEROS[0], (0.4, 0.3))
        return [{"population": self.population(w), "n": n} for w, n in zip(weights, (25, 7, 8, 5, 1), strict=True)]

    def call(self, component: Resampler, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.resample(rng, inputs["population"], inputs["n"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, Population), f"resample returns {type(result).__name__}, expected a Population"
        ancestors = result.parents.get("ancestor")
        assert ancestors is not None, (
            'the result has no parents "ancestor": a scheme that makes new particles inherits TransformResampler'
        )
        m = len(inputs["population"])
        wrong = ancestors[(ancestors < 0) | (ancestors >= m)]
        assert not len(wrong), f"ancestor {wrong[0]} is out of range: there are {m} particles; off by one?"

    def resample(self, component: Resampler, population: Population, n: int, rng: np.random.Generator) -> Population:
        return self.checked_call(component, {"population": population, "n": n}, rng)

    @prerequisite
    def test_gives_n_particles(self) -> None:
        """It returns n particles for any n, at most n if ``exact_size`` is False; their ancestors exist."""
        component = self.make()
        for m in (1, 2, 4, 7):
            for n in (1, 2, m, 2 * m + 3, 50):
                for seed in range(10):
                    found = len(self.resample(component, self.population(np.linspace(1, 3, m)), n, seeded(seed)))
                    enough = found == n if component.exact_size else 1 <= found <= n
                    assert enough, f"asked to make {n} particles of {m} it returns {found}"

    def test_zero_weights_are_never_chosen(self) -> None:
        """A particle of weight zero is never selected, also by the uniform numbers 0 and 1 - 2^-53."""
        component, slow = self.make(), []
        for weights in (*_ZEROS, (0, 0, 0, 1, 0), (0, 1, 0, 0, 0)):
            for when, rng, n in _typical_and_extreme():
                try:
                    ancestors = self.resample(component, self.population(weights), n, rng).parents["ancestor"]
                except SkipTest:
                    slow.append(f"it does not end if {when}")
                    continue
                wrong = ancestors[np.asarray(weights)[ancestors] == 0]
                assert not len(wrong), (
                    f"if {when}, of weights {weights} it selects particle {wrong[0]}, weight 0: use "
                    'np.searchsorted with side="right", and end at a particle with weight'
                )
        if slow:
            raise SkipTest(slow[0])

    def test_keeps_parents(self) -> None:
        """Selected particles are those of the ancestors and keep their parents."""
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

    def test_depends_on_the_generator(self) -> None:
        """Different generators give different results, if n W_i are not integers."""
        component = skip_unless_properly_weighted(self.make())
        population = self.population((0.41, 0.24, 0.2, 0.1, 0.05))
        one = seeded(0)
        for fault, generators in (
            ("forty generators with different seeds give", [seeded(seed) for seed in range(40)]),
            ("it does not advance `rng`: forty calls with one generator give", [one] * 40),
        ):
            chosen = [self.resample(component, population, 2, rng) for rng in generators]
            different = len({tuple(c.parents["ancestor"].tolist()) for c in chosen}) > 1
            assert different, f"{fault} the same result: it ignores `rng`"

    def test_scale_of_weights_is_irrelevant(self) -> None:
        """A common factor of the weights does not change the selection."""
        component = self.make()
        for seed in range(10):
            population = self.population(((0.11, 0.36, 0.15, 0.38), (0.11, 0.36, 0.0, 0.38))[seed // 5])
            n = (6, 4, 1)[seed % 3]
            a = self.resample(component, population, n, seeded(seed))
            for shift in (0.5, 100.0, -100.0, 1e4, -1e4):
                changed = f"log weights + {shift:g} (overflow or underflow?)"
                with np.errstate(all="ignore"):
                    try:
                        b = self.resample(component, population.reweighted(np.full(4, shift)), n, seeded(seed))
                    except AssertionError as error:
                        raise AssertionError(f"{changed}: {error}") from error
                assert same(a.parents["ancestor"], b.parents["ancestor"]), f"{changed} change the selection"
                kept = np.allclose(b.log_weights - shift, a.log_weights, atol=1e-8)
                assert kept or not component.properly_weighted, f"{changed} do not add it to those of the result"

    # --- proper weighting ---

    @statistical
    def test_carried_weight(self) -> None:
        """A particle gets n W_i copies on average, or copies that carry W_i if their weights differ."""
        self._check_cases(self.cases)

    @statistical
    def test_largest_weight(self) -> None:
        """The heaviest particle carries its weight on average, to 1 %, and the others carry theirs."""
        self._check_cases(self.heavy_cases)

    def _check_cases(self, cases: tuple[Case, ...]) -> None:
        """Compare the mean weight that each particle and each group of particles carries with its expectation."""
        component = skip_unless_properly_weighted(self.make())
        slow = []
        for seed, case in enumerate(cases):
            try:
                sample = self._carried(component, case, len(cases), seed)
            except SkipTest as reason:
                slow.append(str(reason))
                continue
            W = sample.expected[: len(case.weights)]
            exact = not (sample.equal_weights and sample.all_n) or abs(sample.total - 1) <= 1e-9
            assert exact, (
                f"{len(W)} particles to {case.n}: the mean weight after selection is {sample.total:.4g} of the one "
                f"before, expected the same{evidence_hint(sample.total, W)}"
            )
            evidence = sample.evidence()
            assert _excess(sample, len(cases)) <= 0, fault_message(sample, int(np.argmax(evidence)))
        if slow:
            raise SkipTest(
                slow[0] if len(cases) == 1 else f"{slow[0]} ({len(slow)} of {len(cases)} cases, others hold)"
            )

    def _carried(self, component: Resampler, case: Case, n_cases: int, seed: int) -> Sample:
        """The weight that each particle and each group carries in many calls.

        Calls are added while a mean is suspicious and the evidence is not sufficient.
        """
        m = len(case.weights)
        given = self.population(case.weights)
        population = Population(given.particles, given.log_weights + 3.0)  # faster without parents
        spread = m * max(case.weights) / sum(case.weights)
        slow = f"too slow at this weight: {m} particles to {case.n}, max w / mean w = {spread:.3g}"
        rng, sample = CountingGenerator(seed, BUDGET, slow), Sample(case)
        calls = case.calls
        while True:
            while sample.calls < calls:
                chosen = self.checked_call(component, {"population": population, "n": case.n}, rng)
                if sample.calls == 0 and rng.drawn * calls > BUDGET:
                    raise SkipTest(f"{slow}: a call draws {rng.drawn:.3g} random numbers")
                sample.add(chosen.parents["ancestor"], np.exp(chosen.log_weights - population.log_mean_weight))
            clear = sample.evidence().max() == 0 or _excess(sample, n_cases) > 0
            if clear or calls >= MOST_CALLS * case.calls:
                return sample
            calls *= 2


def _typical_and_extreme() -> Iterator[tuple[str, np.random.Generator, int]]:
    """Description of the generator, the generator, and a number of particles to select."""
    for seed in range(60):
        yield f"the generator has seed {seed}", seeded(seed), (1, 4, 5, 11)[seed % 4]
    for value in (0.0, 1 - 2.0**-53):
        for n in (1, 3, 10):
            yield f"rng.random() gives {value:.17g}", ConstantGenerator(value, 200_000), n


def _excess(sample: Sample, n_cases: int) -> float:
    """Largest log evidence against a mean, minus its bound for one of `n_cases` cases at level `FALSE_ALARM`."""
    evidence = sample.evidence()
    return float(evidence.max() - np.log(2 * len(evidence) * n_cases / FALSE_ALARM))


class WeightResamplerContract(BatchedContract, ResamplerContract):
    """The contract of every `WeightResampler`: that of a `Resampler`, and properties of `select`."""

    slot = "resampler"
    cases = CASES
    heavy_cases = HEAVY_CASES_OF_WEIGHTS

    @statistical
    def test_many_particles(self) -> None:
        """Small weights are not lost by rounding among 100 000 particles."""
        component: WeightResampler = self.make()
        few = self._light_copies(component, 100, 60)
        try:
            many = self._light_copies(component, 100_000, 5)
        except AssertionError as error:
            raise AssertionError(f"single precision, or too few bits for the indices? {error}") from error
        # If all are draws of one law, the five are above, or below, all sixty with probability 1 / C(65, 5) = 1.2e-7.
        wrong = component.properly_weighted and (many.max() < few.min() - 80 or many.min() > few.max() + 80)
        rounded = abs(few.mean() - 100) < 80  # else it is another fault
        hint = ": cumulated in single precision?" if rounded else ""
        assert not wrong, (
            f"100 000 particles that share a thousandth of the weight get {many.mean():.0f} copies in total, and 100 "
            f"particles that share it get {few.mean():.0f}{hint}"
        )

    def _light_copies(self, component: WeightResampler, n_light: int, calls: int) -> np.ndarray:
        """Copies of all particles except the first, which has 1000 times their total weight, among 100 000 copies."""
        n, slow = 100_000, "too slow at this weight: max w / mean w = 1e5"
        weights = np.full(n_light + 1, 1e-3 / n_light)
        weights[0] = 1.0
        population = Population(np.arange(float(len(weights))), np.log(weights))
        rng = CountingGenerator(n_light, BUDGET // 2, slow)
        copies = []
        for _ in range(calls):
            chosen = self.resample(component, population, n, rng)
            share = np.exp(chosen.log_weights - population.log_mean_weight)
            copies.append(share[chosen.parents["ancestor"] > 0].sum() * (n / len(chosen)))
        return np.array(copies)


class TransformResamplerContract(Contract):
    """The contract of every `TransformResampler`: n new particles of equal weight and with the weighted mean.

    For n other than the number of particles it may raise InputError. The particles of the example are arrays of
    numbers, or mappings of such arrays. Reich (2013), "A nonparametric ensemble transform method for Bayesian
    inference".
    """

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        particles = self.example(seeded(seed), 20)[0].realised().particles
        return {"population": Population(particles, log_of(np.linspace(1, 2 + seed, 20))), "n": 20}

    def call(self, component: TransformResampler, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.resample(rng, inputs["population"], inputs["n"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, Population), f"resample returns {type(result).__name__}, expected a Population"
        assert not result.parents, f"new particles have parents {sorted(result.parents)}, expected none"
        before = inputs["population"].log_mean_weight
        assert np.allclose(result.log_weights, before, rtol=0, atol=1e-9), (
            f"log weights of the result lie in {result.log_weights.min():.6g} .. {result.log_weights.max():.6g}, "
            f"expected the log mean of the old weights, {before:.6g}"
        )

    @prerequisite
    def test_gives_n_particles(self) -> None:
        """It returns n particles for any n; at most n if ``exact_size`` is False."""
        component = self.make()
        for m in (1, 4, 7):
            for n in (1, 2, m, 2 * m + 3):
                pair = self._resample(component, np.linspace(1, 3, m), n)
                found = n if pair is None else len(pair[1])
                enough = found == n if component.exact_size else 1 <= found <= n
                assert enough, f"asked to make {n} particles of {m} it returns {found}"

    def test_keeps_the_weighted_mean(self) -> None:
        """The mean of the new particles is the weighted mean of the old ones, also with weights of zero."""
        for weights in ((1, 2, 1.5, 0.5, 2), *_ZEROS, (1, 1e-6, 1e-12, 1, 1)):
            for n in (1, 3, 5, 9):
                pair = self._resample(self.make(), weights, n)
                if pair is None:
                    continue
                old, new = pair
                x = as_matrix(old.particles)
                found, expected = as_matrix(new.particles).mean(axis=0), old.weights @ x
                i = int(np.argmax(np.abs(found - expected)))
                assert np.allclose(found, expected, rtol=0, atol=1e-6 * max(np.abs(x).max(), 1e-300)), (
                    f"of weights {weights} to {n} particles, coordinate {i} has mean {found[i]:.6g}, expected "
                    f"{expected[i]:.6g}"
                )

    def test_common_factor_of_weights(self) -> None:
        """A common factor of the weights does not change the new particles."""
        weights = np.array([0.11, 0.36, 0.15, 0.38])
        a = self._resample(self.make(), weights, 4)
        for shift in (100.0, -100.0, 1e4, -1e4):
            b = self._resample(self.make(), weights, 4, shift)
            equal = a and b and np.allclose(as_matrix(a[1].particles), as_matrix(b[1].particles))
            assert equal, f"adding {shift:g} to all log weights changes the new particles (overflow or underflow?)"

    def test_keeps_a_spread(self) -> None:
        """The variance of the new particles is a quarter to four times the weighted one of the old particles."""
        inputs = self.inputs(0)
        population = inputs["population"]
        x, w = as_matrix(population.particles), population.weights
        before = w @ (x - w @ x) ** 2
        after = as_matrix(self.checked_call(self.make(), inputs).particles).var(axis=0)
        ratio = (after[before > 0] / before[before > 0]).tolist()
        assert all(0.25 <= r <= 4 for r in ratio), f"the variance of the particles changes by a factor {ratio[0]:.3g}"

    def _resample(
        self, component: Any, weights: Any, n: int, shift: float = 0.0
    ) -> tuple[Population, Population] | None:
        """The particles before and after; None if the component refuses n other than their number."""
        particles = self.example(seeded(0), len(weights))[0].realised().particles
        population = Population(particles, log_of(weights) + shift)
        inputs = {"population": population, "n": n}
        if n != len(weights):
            try:
                self.call(component, seeded(3), inputs)
            except InputError:
                return None
        return population, self.checked_call(component, inputs)
