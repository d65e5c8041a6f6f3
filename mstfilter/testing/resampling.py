"""Contracts of resamplers, with tests of proper weighting.

A resampler is properly weighted if the mean over its output of w f(x) has, for every f, the expectation of the mean
over its input. Particle i of m *carries* the sum of the output weights of its copies, divided by the number n of
copies and by the mean input weight. For a properly weighted resampler it carries W_i on average. With equal output
weights this means that it gets n W_i copies on average. The tests repeat a resampling 3000 times, which detects a
bias of 0.1 copies.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mstfilter.smc import Population, Resampler, TransformResampler, WeightResampler, as_matrix, log_mean_exp
from mstfilter.testing.contract import (
    FALSE_ALARM,
    RandomContract,
    prerequisite,
    reports_errors,
    skip_unless_properly_weighted,
    statistical,
)

_REPEATS = 3000
#: Weights and numbers of particles of the statistical tests. Every particle is selected now and then.
_CASES: tuple[tuple[tuple[float, ...], int], ...] = (
    ((0.11, 0.36, 0.15, 0.38), 3),
    ((0.41, 0.24, 0.2, 0.1, 0.05), 7),
    ((0.05, 0.1, 0.2, 0.24, 0.41), 2),
)
_OTHER_ORDER = (2, 0, 4, 1, 3)
_ZEROS = ((0, 0, 1, 2, 3), (1, 2, 3, 0, 0), (1, 0, 2, 0, 3))
_N_COMPARISONS = sum(len(weights) for weights, _ in _CASES)


class ResamplerContract(RandomContract):
    """The contract of every `Resampler`. Its two statistical tests have a false-alarm rate of at most 1e-6 each."""

    def population(self, weights: Any) -> Population:
        """The particles of the example with given weights, and with parents that identify them."""
        n = len(weights)
        particles = self.example(np.random.default_rng(0), n)[0].realised().particles
        return Population(particles, _log(weights), {"previous": np.arange(n)[::-1]})

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        return {"population": self.population(np.linspace(1, 2 + seed, 40)), "n": 25}

    def call(self, component: Resampler, rng: np.random.Generator, inputs: dict[str, Any]) -> Population:
        return component.resample(rng, inputs["population"], inputs["n"])

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert isinstance(result, Population), f"resample returns {type(result).__name__}, expected a Population"
        ancestors = result.parents.get("ancestor")
        assert ancestors is not None, 'the result has no parents "ancestor"'
        m = len(inputs["population"])
        wrong = ancestors[(ancestors < 0) | (ancestors >= m)]
        assert not len(wrong), f"ancestor {wrong[0]} is out of range: there are {m} particles; off by one?"

    def resample(self, component: Resampler, population: Population, n: int, rng: np.random.Generator) -> Population:
        return self.checked_call(component, {"population": population, "n": n}, rng)

    @prerequisite
    def test_ancestors_in_range(self) -> None:
        """Ancestors are indices of particles that exist."""
        component = self.make()
        for m, n in ((5, 5), (5, 3), (5, 12), (2, 9)):
            for seed in range(40):
                self.resample(component, self.population(np.linspace(1, 2, m)), n, np.random.default_rng(seed))

    @prerequisite
    def test_gives_n_particles(self) -> None:
        """It returns n particles for any n; at most n if ``exact_size`` is False."""
        component = self.make()
        for m in (1, 4, 7):
            for n in (1, 2, m, 2 * m + 3, 50):
                rng = np.random.default_rng(n)
                found = len(self.resample(component, self.population(np.linspace(1, 3, m)), n, rng))
                enough = found == n if component.exact_size else 1 <= found <= n
                assert enough, f"asked to make {n} particles of {m} it returns {found}"

    def test_takes_one_particle(self) -> None:
        """It works for a single particle, whose weight it keeps."""
        component = self.make()
        chosen = self.resample(component, self.population([np.exp(-3.0)]), 1, np.random.default_rng(0))
        if component.properly_weighted:
            assert abs(chosen.log_weights[0] + 3.0) <= 1e-9, (
                f"the only particle had log weight -3 and has {chosen.log_weights[0]:.4g} afterwards"
            )

    def test_zero_weights_are_never_chosen(self) -> None:
        """A particle of weight zero is never selected."""
        component = self.make()
        for weights in (*_ZEROS, (0, 0, 0, 1, 0), (0, 1, 0, 0, 0)):
            for seed in range(60):
                n = (1, 4, 11)[seed % 3]
                chosen = self.resample(component, self.population(weights), n, np.random.default_rng(seed))
                wrong = _without_weight(chosen, weights)
                assert not len(wrong), f"of weights {weights} it selects particle {wrong[0]}, weight 0"

    def test_handles_extreme_uniforms(self) -> None:
        """It handles the smallest and the largest uniform number, 0 and 1 - 2^-53."""
        component = self.make()
        for value in (0.0, 1 - 2.0**-53):
            for weights in (*_ZEROS, (0.1, 0.2, 0.3)):
                for n in (1, 3, 10):
                    chosen = self.resample(component, self.population(weights), n, _ConstantGenerator(value))
                    wrong = _without_weight(chosen, weights)
                    assert not len(wrong), (
                        f"if rng.random() gives {value:.17g}, of weights {weights} it selects particle {wrong[0]}, "
                        'weight 0: use np.searchsorted with side="right", and end at a particle with weight'
                    )

    def test_keeps_parents(self) -> None:
        """Selected particles keep their parents."""
        population = self.population((1.0, 2.0, 1.5, 0.5, 2.0))
        chosen = self.resample(self.make(), population, 4, np.random.default_rng(1))
        expected = population.parents["previous"][chosen.parents["ancestor"]]
        assert "previous" in chosen.parents and np.array_equal(chosen.parents["previous"], expected), (
            'parents "previous" of the result are not those of the ancestors'
        )

    def test_depends_on_the_generator(self) -> None:
        """Different generators give different results, if n W_i are not integers."""
        component = self.make()
        skip_unless_properly_weighted(component)
        population = self.population((0.41, 0.24, 0.2, 0.1, 0.05))
        chosen = [self.resample(component, population, 2, np.random.default_rng(seed)) for seed in range(40)]
        assert len({tuple(c.parents["ancestor"].tolist()) for c in chosen}) > 1, (
            "forty generators with different seeds give the same result: it ignores `rng`"
        )

    def test_scale_of_weights_is_irrelevant(self) -> None:
        """A common factor of the weights does not change the selection."""
        component, population = self.make(), self.population((0.11, 0.36, 0.15, 0.38))
        for seed in range(10):
            a = self.resample(component, population, 6, np.random.default_rng(seed))
            for shift in (0.5, 100.0, -100.0, 1e4, -1e4):
                shifted = population.reweighted(np.full(4, shift))
                with np.errstate(all="ignore"):
                    try:
                        b = self.resample(component, shifted, 6, np.random.default_rng(seed))
                    except AssertionError as error:
                        raise AssertionError(f"log weights + {shift:g} (overflow or underflow?): {error}") from error
                assert np.array_equal(a.parents["ancestor"], b.parents["ancestor"]), (
                    f"adding {shift:g} to all log weights changes the selection (overflow or underflow?)"
                )
                if component.properly_weighted:
                    assert np.allclose(b.log_weights - shift, a.log_weights, atol=1e-8), (
                        f"adding {shift:g} to all log weights does not add it to those of the result"
                    )

    # --- proper weighting ---

    @statistical
    def test_carried_weight(self) -> None:
        """A particle gets n W_i copies on average, or copies that carry W_i if their weights differ."""
        component = self.make()
        skip_unless_properly_weighted(component)
        for seed, (weights, n) in enumerate(_CASES):
            carried, equal_weights = self._carried(component, weights, n, seed)
            mean, expected = carried.mean(axis=0), np.asarray(weights) / np.sum(weights)
            total = carried.sum(axis=1)
            assert not equal_weights or np.abs(total - 1).max() <= 1e-9, (
                f"the mean weight after selection is {total[0]:.4g} of the one before, expected the same"
            )
            excess = np.abs(mean - expected) - _tolerance(carried, 1.0 / n, _N_COMPARISONS)
            i = int(np.argmax(excess))
            if equal_weights:
                fault = (
                    f"copies are biased: particle {i} (W = {expected[i]:.3g}) gets {n * mean[i]:.3f} copies on "
                    f"average, expected {n * expected[i]:.3f}{_shift_hint(mean, expected)}"
                )
            else:
                fault = (
                    f"output weights are wrong: particle {i} carries {mean[i]:.3f} of the weight on average, "
                    f"expected {expected[i]:.3f}"
                )
            assert excess[i] <= 0, f"{len(mean)} particles to {n}: {fault}"

    @statistical
    def test_order_of_particles_is_irrelevant(self) -> None:
        """The order of the particles does not change what each carries on average."""
        component = self.make()
        skip_unless_properly_weighted(component)
        weights, n = _CASES[1][0], 4
        orders = (tuple(range(5)), _OTHER_ORDER)
        samples = [self._carried(component, weights, n, seed, order)[0] for seed, order in enumerate(orders)]
        a, b = (s.mean(axis=0) for s in samples)
        excess = np.abs(a - b) - sum(_tolerance(s, 1.0 / n, 2 * len(weights)) for s in samples)
        i = int(np.argmax(excess))
        assert excess[i] <= 0, (
            f"the result depends on the order of the particles: the one of W = {weights[i]:.3g} carries {a[i]:.3f} "
            f"of the weight as number {i}, and {b[i]:.3f} as number {_OTHER_ORDER.index(i)}"
        )

    def _carried(
        self,
        component: Resampler,
        weights: tuple[float, ...],
        n: int,
        seed: int,
        order: tuple[int, ...] | None = None,
    ) -> tuple[np.ndarray, bool]:
        """What each particle carries in each of many runs, with the particles in an order.

        Returns
        -------
        carried : (repeats, m) float64
            Columns are in the order of `weights`.
        equal_weights : bool
            Whether all output weights were equal in every run.
        """
        m = len(weights)
        positions = np.arange(m) if order is None else np.asarray(order)
        population = self.population(weights).reweighted(np.full(m, 3.0))
        given = population.take(positions)
        rng, mean = np.random.default_rng(seed), log_mean_exp(population.log_weights)
        carried, equal = np.zeros((_REPEATS, m)), True
        for r in range(_REPEATS):
            chosen = self.resample(component, given, n, rng)
            out = np.exp(chosen.log_weights - mean)
            equal = equal and bool(np.ptp(out) <= 1e-9 * out.max())
            carried[r] = np.bincount(positions[chosen.parents["ancestor"]], out, minlength=m) / len(out)
        return carried, equal


class WeightResamplerContract(ResamplerContract):
    """The contract of every `WeightResampler`: that of a `Resampler`, and properties of `select`."""

    @prerequisite
    def test_select_returns_integers(self) -> None:
        """`select` returns (n,) integer ancestors."""
        component: WeightResampler = self.make()
        for m, n in ((5, 3), (2, 9)):
            with reports_errors(f"{m} particles to {n}"):
                ancestors = np.asarray(component.select(np.random.default_rng(0), _log(np.linspace(1, 2, m)), n)[0])
            assert ancestors.ndim == 1 and np.issubdtype(ancestors.dtype, np.integer), (
                f"ancestors are {ancestors.dtype} of shape {ancestors.shape}, expected int ({n},)"
            )

    def test_many_particles(self) -> None:
        """Small weights are not lost by rounding among 100 000 particles."""
        component: WeightResampler = self.make()
        # One particle of weight 1, then 100 000 that share a thousandth: they get 100 copies on average.
        m, n = 100_001, 100_000
        weights = np.full(m, 1e-8)
        weights[0] = 1.0
        expected = n * weights[1:].sum() / weights.sum()
        population = Population(np.arange(float(m)), np.log(weights))
        for seed in range(3):
            try:
                chosen = self.resample(component, population, n, np.random.default_rng(seed))
            except AssertionError as error:
                raise AssertionError(f"cumulated in single precision? {error}") from error
            if not component.properly_weighted:
                continue
            share = np.exp(chosen.log_weights - population.log_mean_weight)
            light = share[chosen.parents["ancestor"] > 0].sum() * (n / len(chosen))
            # Eight standard deviations of the noisiest scheme: the false-alarm rate is below 1e-10.
            assert abs(light - expected) <= 8 * np.sqrt(expected), (
                f"the particles of small weight get {light:.0f} copies in total, expected {expected:.0f}: "
                "cumulated in single precision, or biased?"
            )


class TransformResamplerContract(RandomContract):
    """The contract of every `TransformResampler`: n new particles of equal weight whose mean is the weighted mean.

    The example has particles that are arrays of numbers, or mappings of such arrays.
    """

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        particles = self.example(np.random.default_rng(seed), 20)[0].realised().particles
        return {"population": Population(particles, _log(np.linspace(1, 2 + seed, 20))), "n": 12}

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
                found = len(self._resample(component, np.linspace(1, 3, m), n)[1])
                enough = found == n if component.exact_size else 1 <= found <= n
                assert enough, f"asked to make {n} particles of {m} it returns {found}"

    def test_keeps_the_weighted_mean(self) -> None:
        """The mean of the new particles is the weighted mean of the old ones, also with weights of zero."""
        for weights in ((1, 2, 1.5, 0.5, 2), *_ZEROS, (1, 1e-6, 1e-12, 1, 1)):
            for n in (1, 3, 5, 9):
                old, new = self._resample(self.make(), weights, n)
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
        a = self._resample(self.make(), weights, 6)[1]
        for shift in (100.0, -100.0, 1e4, -1e4):
            b = self._resample(self.make(), weights, 6, shift)[1]
            assert np.allclose(as_matrix(a.particles), as_matrix(b.particles)), (
                f"adding {shift:g} to all log weights changes the new particles (overflow or underflow?)"
            )

    def _resample(self, component: Any, weights: Any, n: int, shift: float = 0.0) -> tuple[Population, Population]:
        particles = self.example(np.random.default_rng(0), len(weights))[0].realised().particles
        old = Population(particles, _log(weights) + shift)
        return old, self.checked_call(component, {"population": old, "n": n})


def _tolerance(samples: np.ndarray, unit: float, n_comparisons: int) -> np.ndarray:
    """Empirical Bernstein bound of |sample mean - expectation| (Audibert, Munos, Szepesvari 2009, theorem 1).

    It holds with probability 1 - FALSE_ALARM for all comparisons together, without a normal approximation. For
    variance s^2, range R (the observed one, at least `unit`), N samples and x = log(3 comparisons / FALSE_ALARM) the
    bound is sqrt(2 s^2 x / N) + 3 R x / N.
    """
    level = np.log(3 * n_comparisons / FALSE_ALARM)
    span = np.maximum(np.ptp(samples, axis=0), unit)
    return np.sqrt(2 * samples.var(axis=0) * level / len(samples)) + 3 * span * level / len(samples)


def _shift_hint(mean: np.ndarray, expected: np.ndarray) -> str:
    """A hint if the copies are those of the neighbouring particle."""
    for shift in (-1, 1):
        if np.abs(np.roll(mean, -shift) - expected).max() < np.abs(mean - expected).max() / 4:
            return "; the copies are those of the particle next to it: off by one?"
    return ""


def _log(weights: Any) -> np.ndarray:
    """Log weights, -inf for zero."""
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(weights, dtype=np.float64))


def _without_weight(chosen: Population, weights: tuple[float, ...]) -> np.ndarray:
    """Ancestors whose weight is zero."""
    ancestors = chosen.parents["ancestor"]
    return ancestors[np.asarray(weights)[ancestors] == 0]


class _ConstantGenerator(np.random.Generator):
    """A generator whose `random` always returns the same value."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(np.random.SeedSequence(0)))
        self._value = value

    def random(self, size=None, dtype=np.float64, out=None):  # type: ignore[no-untyped-def]
        return self._value if size is None else np.full(size, self._value)
