"""Properties of resamplers: what must hold in every run, and the law of proper weighting.

A resampler is properly weighted if the mean over its output of w f(x) has, for every f, the expectation of the
mean over its input. In terms of what is counted here: particle i of m carries on average w_i / m of the weight,
where it "carries" the sum of the output weights of its copies, divided by their number n. With equal output
weights this says that it gets n W_i copies on average.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.population import Population, log_mean_exp
from mstfilter.testing.properties import (
    FALSE_ALARM,
    Broken,
    Example,
    NotApplicable,
    Suite,
    Untouched,
    add_generator_properties,
    guarded,
    needs_proper_weights,
    only_in_place,
)

__all__ = ["RESAMPLER"]

RESAMPLER = Suite("resampler")

_REPEATS = 3000
#: Weights and numbers of particles for the law; none is so light that it is hardly ever chosen.
_LAWS: tuple[tuple[tuple[float, ...], int], ...] = (
    ((0.11, 0.36, 0.15, 0.38), 3),
    ((0.41, 0.24, 0.2, 0.1, 0.05), 7),
    ((0.05, 0.1, 0.2, 0.24, 0.41), 2),
)
_OTHER_ORDER = (2, 0, 4, 1, 3)


def _population(example: Example, log_weights: np.ndarray) -> Population:
    """Example particles with given weights, and parents that tell them apart."""
    n = len(log_weights)
    particles = example(np.random.default_rng(0), n)[0].realised().particles
    return Population(particles, log_weights, {"previous": np.arange(n)[::-1]})


def _log(weights: tuple[float, ...] | np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(weights, dtype=np.float64))


def _resample(resampler: Resampler, population: Population, n: int, rng: np.random.Generator) -> Population:
    """Resample, with everything that can go wrong in words."""
    m = len(population)
    with guarded(f"{m} particles to {n}"):
        chosen = resampler.resample(rng, population, n)
    if not isinstance(chosen, Population):
        raise Broken(f"resample returns {type(chosen).__name__}, expected a Population")
    ancestors = chosen.parents.get("ancestor")
    if ancestors is None:
        raise Broken('the result has no parents "ancestor"')
    if ((ancestors < 0) | (ancestors >= m)).any():
        wrong = ancestors[(ancestors < 0) | (ancestors >= m)][0]
        raise Broken(f"ancestor {wrong} is out of range: there are {m} particles, counted from 0; off by one?")
    return chosen


@RESAMPLER.property("it leaves its input alone", essential=True)
def leaves_input_alone(resampler: Resampler, example: Example) -> None:
    """Neither the population nor an array of log weights is changed."""
    lw = _log((1.0, 2.0, 3.0, 4.0))
    population = _population(example, lw.copy())
    before, mine = Untouched(population=population), lw.copy()
    for attempt in (
        lambda: resampler.resample(np.random.default_rng(0), population, 3),
        lambda: resampler.select(np.random.default_rng(0), mine, 3),
    ):
        with only_in_place():
            attempt()
    before.verify()
    if (mine != lw).any():
        raise Broken("it changes its input in place (log_weights): make a copy first")


@RESAMPLER.property("ancestors are indices of particles that exist", essential=True)
def ancestors_in_range(resampler: Resampler, example: Example) -> None:
    """Whole numbers in [0, m), for more and for fewer particles than before."""
    for m, n in ((5, 5), (5, 3), (5, 12), (2, 9)):
        for seed in range(40):
            rng = np.random.default_rng(seed)
            population = _population(example, _log(np.linspace(1, 2, m)))
            _resample(resampler, population, n, rng)
            with guarded(f"{m} particles to {n}"):
                try:
                    ancestors = np.asarray(resampler.select(rng, population.log_weights.copy(), n)[0])
                except InputError:  # a scheme that sees the particles has no select
                    continue
            if ancestors.ndim != 1 or not np.issubdtype(ancestors.dtype, np.integer):
                raise Broken(f"ancestors are {ancestors.dtype} of shape {ancestors.shape}, expected int ({n},)")


@RESAMPLER.property("it returns n particles, whatever n", essential=True)
def gives_n_particles(resampler: Resampler, example: Example) -> None:
    """Exactly n; at most n, and at least one, where the class says ``exact_size = False``."""
    for m in (1, 4, 7):
        for n in (1, 2, m, 2 * m + 3, 50):
            population = _population(example, _log(np.linspace(1, 3, m)))
            found = len(_resample(resampler, population, n, np.random.default_rng(n)))
            if found != n and (resampler.exact_size or not 1 <= found <= n):
                raise Broken(f"asked to make {n} particles of {m} it returns {found}")


@RESAMPLER.property("it works for a single particle")
def takes_one_particle(resampler: Resampler, example: Example) -> None:
    """One in, one out, with its weight."""
    population = _population(example, np.array([-3.0]))
    chosen = _resample(resampler, population, 1, np.random.default_rng(0))
    if resampler.properly_weighted and abs(chosen.log_weights[0] + 3.0) > 1e-9:
        raise Broken(f"the only particle had log weight -3 and has {chosen.log_weights[0]:.4g} afterwards")


@RESAMPLER.property("a particle of weight zero is never chosen")
def zero_weights_are_never_chosen(resampler: Resampler, example: Example) -> None:
    """Zeros leading, trailing, interleaved, and all but one."""
    for weights in ((0, 0, 1, 2, 3), (1, 2, 3, 0, 0), (1, 0, 2, 0, 3), (0, 0, 0, 1, 0), (0, 1, 0, 0, 0)):
        lw = _log(weights)
        population = _population(example, lw)
        for seed in range(60):
            n = (1, 4, 11)[seed % 3]
            chosen = _resample(resampler, population, n, np.random.default_rng(seed))
            wrong = np.flatnonzero(np.isneginf(lw[chosen.parents["ancestor"]]))
            if len(wrong):
                raise Broken(
                    f"of weights {weights} it chose particle {chosen.parents['ancestor'][wrong[0]]}, weight 0"
                )


@RESAMPLER.property("chosen particles bring their parents along")
def parents_come_along(resampler: Resampler, example: Example) -> None:
    """Row k of the result is particle ``parents["ancestor"][k]``."""
    population = _population(example, _log((1.0, 2.0, 1.5, 0.5, 2.0)))
    chosen = _resample(resampler, population, 4, np.random.default_rng(1))
    expected = population.parents["previous"][chosen.parents["ancestor"]]
    if "previous" not in chosen.parents or not np.array_equal(chosen.parents["previous"], expected):
        raise Broken('parents "previous" of the result are not those of the ancestors')


def _run(resampler: Resampler, example: Example, rng: np.random.Generator) -> Population:
    return resampler.resample(rng, _population(example, _log(np.linspace(1, 2, 40))), 25)


add_generator_properties(RESAMPLER, _run)


@RESAMPLER.property("different generators give different results")
def listens_to_the_generator(resampler: Resampler, example: Example) -> None:
    """A proper scheme has to leave something to chance where n W_i are no whole numbers."""
    needs_proper_weights(resampler)
    population = _population(example, _log((0.41, 0.24, 0.2, 0.1, 0.05)))
    results = {
        tuple(_resample(resampler, population, 2, np.random.default_rng(seed)).parents["ancestor"].tolist())
        for seed in range(40)
    }
    if len(results) < 2:
        raise Broken("forty generators of different seeds give one and the same result: it ignores `rng`")


@RESAMPLER.property("the scale of the weights does not matter")
def scale_of_weights_is_irrelevant(resampler: Resampler, example: Example) -> None:
    """Log weights + c choose the same particles; nothing over- or underflows."""
    lw = _log((0.11, 0.36, 0.15, 0.38))
    for seed in range(10):
        a = _resample(resampler, _population(example, lw), 6, np.random.default_rng(seed))
        for shift in (0.5, 100.0, -100.0, 1e4, -1e4):
            with np.errstate(all="ignore"):
                try:
                    b = _resample(resampler, _population(example, lw + shift), 6, np.random.default_rng(seed))
                except Broken as broken:
                    raise Broken(f"log weights + {shift:g} (overflow or underflow?): {broken}") from broken
            if not np.array_equal(a.parents["ancestor"], b.parents["ancestor"]):
                raise Broken(f"adding {shift:g} to all log weights chooses other particles (overflow or underflow?)")
            if resampler.properly_weighted and not np.allclose(b.log_weights - shift, a.log_weights, atol=1e-8):
                raise Broken(f"adding {shift:g} to all log weights does not add it to the output's")


@RESAMPLER.property("light particles are not lost in rounding among 100 000")
def many_particles(resampler: Resampler, example: Example) -> None:
    """One heavy particle, then 100 000 light ones that share a thousandth of its weight: 100 copies on average."""
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
                try:
                    ancestors, out = resampler.select(rng, lw.copy(), 100_000)
                    chosen = population.take(ancestors, out)
                    ancestors = np.asarray(ancestors)
                except InputError as error:
                    raise NotApplicable("it sees the particles, and there are no similarities of so many") from error
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
                "cumulated in single precision?"
            )


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
    population = _population(example, _log(weights) + 3.0)
    given = population.take(order)
    rng = np.random.default_rng(seed)
    carried, copies, equal = np.zeros((_REPEATS, m)), np.zeros((_REPEATS, m), np.int64), True
    mean = log_mean_exp(population.log_weights)
    for r in range(_REPEATS):
        chosen = _resample(resampler, given, n, rng)
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
