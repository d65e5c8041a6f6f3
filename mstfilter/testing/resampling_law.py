"""The law of proper weighting: properties of resamplers that show in many runs.

A resampler is properly weighted if the mean over its output of w f(x) has, for every f, the expectation of the
mean over its input. In terms of what is counted here: particle i of m carries on average w_i / m of the weight,
where it "carries" the sum of the output weights of its copies, divided by their number n. With equal output
weights this says that it gets n W_i copies on average. With 3000 runs a bias of 0.1 copies is seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mstfilter.smc import Population, Resampler, WeightResampler, log_mean_exp
from mstfilter.testing.properties import (
    FALSE_ALARM,
    Broken,
    Example,
    NotApplicable,
    guarded,
    needs_proper_weights,
)
from mstfilter.testing.resampling import RESAMPLER, log_of, population_of, resampled

__all__ = ["RESAMPLER"]

_REPEATS = 3000
#: Weights and numbers of particles for the law; none is so light that it is hardly ever chosen.
_LAWS: tuple[tuple[tuple[float, ...], int], ...] = (
    ((0.11, 0.36, 0.15, 0.38), 3),
    ((0.41, 0.24, 0.2, 0.1, 0.05), 7),
    ((0.05, 0.1, 0.2, 0.24, 0.41), 2),
)
_OTHER_ORDER = (2, 0, 4, 1, 3)


@dataclass(frozen=True)
class _Law:
    """Weight carried by each particle over many runs.

    Parameters
    ----------
    carried : (repeats, m) float64
        Sum of the output weights of a particle's copies, by number of copies and by mean input weight.
    copies : (repeats, m) int
        Number of copies.
    equal : bool
        Whether all output weights were equal in every run.
    expected : (m,) float64
        What `carried` is on average for a proper scheme: m W_i / m = W_i.
    """

    carried: np.ndarray
    copies: np.ndarray
    equal: bool
    expected: np.ndarray


def _sample(
    resampler: Resampler, example: Example, weights: np.ndarray, n: int, order: np.ndarray, seed: int
) -> _Law:
    """Resample many times, particles given in an order; results in the order of `weights`."""
    m = len(weights)
    population = population_of(example, log_of(weights) + 3.0)
    given = population.take(order)
    rng = np.random.default_rng(seed)
    carried, copies, equal = np.zeros((_REPEATS, m)), np.zeros((_REPEATS, m), np.int64), True
    mean = log_mean_exp(population.log_weights)
    for r in range(_REPEATS):
        chosen = resampled(resampler, given, n, rng)
        original = order[chosen.parents["ancestor"]]
        out = np.exp(chosen.log_weights - mean)
        equal = equal and bool(np.ptp(out) <= 1e-9 * out.max())
        carried[r] = np.bincount(original, out, minlength=m) / len(out)
        copies[r] = np.bincount(original, minlength=m)
    return _Law(carried, copies, equal, np.asarray(weights) / np.sum(weights))


def _tolerance(samples: np.ndarray, unit: float, comparisons: int) -> np.ndarray:
    """Empirical Bernstein bound of |sample mean - expectation| (Audibert, Munos, Szepesvari 2009, theorem 1).

    Holds with probability 1 - FALSE_ALARM for all comparisons together, without any normal approximation; the
    range is the observed one, at least `unit`.
    """
    level = np.log(3 * comparisons / FALSE_ALARM)
    span = np.maximum(np.ptp(samples, axis=0), unit)
    return np.sqrt(2 * samples.var(axis=0) * level / len(samples)) + 3 * span * level / len(samples)


def _laws(resampler: Resampler, example: Example) -> list[tuple[_Law, int]]:
    try:
        return _kept_laws(resampler, example)
    except TypeError:  # a component with a field that cannot be hashed
        return _kept_laws.__wrapped__(resampler, example)


@lru_cache(maxsize=1)
def _kept_laws(resampler: Resampler, example: Example) -> list[tuple[_Law, int]]:
    """Two properties look at the same samples."""
    return [
        (_sample(resampler, example, np.array(weights), n, np.arange(len(weights)), seed), n)
        for seed, (weights, n) in enumerate(_LAWS)
    ]


_COMPARISONS = sum(len(weights) for weights, _ in _LAWS)


@RESAMPLER.property("a particle gets n W_i copies on average, where all copies weigh the same", statistical=True)
def mean_number_of_copies(resampler: Resampler, example: Example) -> None:
    """Against the exact mean; false alarm below 1e-6."""
    needs_proper_weights(resampler)
    laws = [(law, n) for law, n in _laws(resampler, example) if law.equal]
    if not laws:
        raise NotApplicable("copies have different weights")
    for law, n in laws:
        mean, expected = law.copies.mean(axis=0), n * law.expected
        off = np.abs(mean - expected) - _tolerance(law.copies, 1.0, _COMPARISONS)
        if off.max() > 0:
            i = int(np.argmax(off))
            hint = ""
            for shift in (1, -1):
                if np.abs(np.roll(mean, -shift) - expected).max() < np.abs(mean - expected).max() / 4:
                    hint = "; the copies are those of the particle next to it: off by one?"
            raise Broken(
                f"copies are biased: of {len(expected)} particles to {n}, particle {i} (W = {law.expected[i]:.3g}) "
                f"gets {mean[i]:.3f} copies on average, expected {expected[i]:.3f}{hint}"
            )


@RESAMPLER.property("the output weights make the mean of w f(x) unbiased", statistical=True)
def output_weights(resampler: Resampler, example: Example) -> None:
    """What a particle carries is W_i on average; equal weights keep their mean exactly. False alarm below 1e-6."""
    needs_proper_weights(resampler)
    for law, n in _laws(resampler, example):
        total = law.carried.sum(axis=1)
        if law.equal:
            if np.abs(total - 1).max() > 1e-9:
                raise Broken(
                    f"the mean weight after selection is {total[0]:.4g} of the one before, expected the same"
                )
            continue
        mean = law.carried.mean(axis=0)
        off = np.abs(mean - law.expected) - _tolerance(law.carried, 1.0 / n, _COMPARISONS)
        if off.max() > 0:
            i = int(np.argmax(off))
            raise Broken(
                f"output weights are wrong: of {len(mean)} particles to {n}, particle {i} carries {mean[i]:.3f} of "
                f"the weight on average, expected {law.expected[i]:.3f}"
            )


@RESAMPLER.property("the order of the particles does not matter", statistical=True)
def order_of_particles_is_irrelevant(resampler: Resampler, example: Example) -> None:
    """A particle carries as much on average wherever it stands; false alarm below 1e-6."""
    needs_proper_weights(resampler)
    weights, n = np.array(_LAWS[1][0]), 4
    samples = [
        _sample(resampler, example, weights, n, np.asarray(order), seed).carried
        for seed, order in enumerate((np.arange(5), _OTHER_ORDER))
    ]
    a, b = (s.mean(axis=0) for s in samples)
    off = np.abs(a - b) - sum(_tolerance(s, 1.0 / n, 2 * len(weights)) for s in samples)
    if off.max() > 0:
        i = int(np.argmax(off))
        raise Broken(
            f"the result depends on the order of the particles: the one of W = {weights[i]:.3g} carries "
            f"{a[i]:.3f} of the weight as number {i}, and {b[i]:.3f} as number {_OTHER_ORDER.index(i)}"
        )


@RESAMPLER.property("light particles are not lost in rounding among 100 000")
def many_particles(resampler: Resampler, example: Example) -> None:
    """One heavy particle, then 100 000 light ones that share a thousandth of its weight: 100 copies on average."""
    if not isinstance(resampler, WeightResampler):
        raise NotApplicable("it may compare the particles, and there are no similarities of so many")
    m = 100_001
    weights = np.full(m, 1e-8)
    weights[0] = 1.0
    lw = np.log(weights)
    population = Population(np.arange(float(m)), lw)
    expected = 100_000 * weights[1:].sum() / weights.sum()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        try:
            with guarded("100 001 particles to 100 000"):
                ancestors, out = resampler.select(rng, lw.copy(), 100_000)
                chosen = population.take(ancestors, out)
                ancestors = np.asarray(ancestors)
        except Broken as broken:
            raise Broken(f"cumulated in single precision? {broken}") from broken
        if (ancestors < 0).any() or (ancestors >= m).any():
            raise Broken(
                f"ancestor {int(ancestors.max())} of 100 001 is out of range: cumulated in single precision?"
            )
        if not resampler.properly_weighted:
            continue
        share = np.ones(len(ancestors)) if out is None else np.exp(chosen.log_weights - log_mean_exp(lw))
        light = share[ancestors > 0].sum() * (100_000 / len(ancestors))
        # Eight standard deviations of the noisiest scheme: false alarm below 1e-10.
        if abs(light - expected) > 8 * np.sqrt(expected):
            raise Broken(
                f"the light particles carry {light:.0f} copies' worth, expected {expected:.0f}: "
                "cumulated in single precision, or biased as said above?"
            )
