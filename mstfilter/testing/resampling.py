"""Properties of resamplers that must hold in every run (those of many runs: `mstfilter.testing.resampling_law`)."""

from __future__ import annotations

import numpy as np

from mstfilter.smc import Population, Resampler, WeightResampler
from mstfilter.testing.properties import (
    Broken,
    Example,
    Suite,
    Untouched,
    add_generator_properties,
    guarded,
    needs_proper_weights,
    only_in_place,
)

__all__ = ["RESAMPLER", "log_of", "population_of", "resampled"]

RESAMPLER = Suite("resampler")


def population_of(example: Example, log_weights: np.ndarray) -> Population:
    """Example particles with given weights, and parents that tell them apart."""
    n = len(log_weights)
    particles = example(np.random.default_rng(0), n)[0].realised().particles
    return Population(particles, log_weights, {"previous": np.arange(n)[::-1]})


def log_of(weights: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """Log weights, -inf for zero."""
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(weights, dtype=np.float64))


def resampled(resampler: Resampler, population: Population, n: int, rng: np.random.Generator) -> Population:
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
    lw = log_of((1.0, 2.0, 3.0, 4.0))
    population = population_of(example, lw.copy())
    before, mine = Untouched(population=population), lw.copy()
    with only_in_place():
        resampler.resample(np.random.default_rng(0), population, 3)
    if isinstance(resampler, WeightResampler):
        with only_in_place():
            resampler.select(np.random.default_rng(0), mine, 3)
    before.verify()
    if (mine != lw).any():
        raise Broken("it changes its input in place (log_weights): make a copy first")


@RESAMPLER.property("ancestors are indices of particles that exist", essential=True)
def ancestors_in_range(resampler: Resampler, example: Example) -> None:
    """Whole numbers in [0, m), for more and for fewer particles than before."""
    for m, n in ((5, 5), (5, 3), (5, 12), (2, 9)):
        for seed in range(40):
            rng = np.random.default_rng(seed)
            population = population_of(example, log_of(np.linspace(1, 2, m)))
            resampled(resampler, population, n, rng)
            if not isinstance(resampler, WeightResampler):
                continue
            with guarded(f"{m} particles to {n}"):
                ancestors = np.asarray(resampler.select(rng, population.log_weights.copy(), n)[0])
            if ancestors.ndim != 1 or not np.issubdtype(ancestors.dtype, np.integer):
                raise Broken(f"ancestors are {ancestors.dtype} of shape {ancestors.shape}, expected int ({n},)")


@RESAMPLER.property("it returns n particles, whatever n", essential=True)
def gives_n_particles(resampler: Resampler, example: Example) -> None:
    """Exactly n; at most n, and at least one, where the class says ``exact_size = False``."""
    for m in (1, 4, 7):
        for n in (1, 2, m, 2 * m + 3, 50):
            population = population_of(example, log_of(np.linspace(1, 3, m)))
            found = len(resampled(resampler, population, n, np.random.default_rng(n)))
            if found != n and (resampler.exact_size or not 1 <= found <= n):
                raise Broken(f"asked to make {n} particles of {m} it returns {found}")


@RESAMPLER.property("it works for a single particle")
def takes_one_particle(resampler: Resampler, example: Example) -> None:
    """One in, one out, with its weight."""
    population = population_of(example, np.array([-3.0]))
    chosen = resampled(resampler, population, 1, np.random.default_rng(0))
    if resampler.properly_weighted and abs(chosen.log_weights[0] + 3.0) > 1e-9:
        raise Broken(f"the only particle had log weight -3 and has {chosen.log_weights[0]:.4g} afterwards")


@RESAMPLER.property("a particle of weight zero is never chosen")
def zero_weights_are_never_chosen(resampler: Resampler, example: Example) -> None:
    """Zeros leading, trailing, interleaved, and all but one."""
    for weights in ((0, 0, 1, 2, 3), (1, 2, 3, 0, 0), (1, 0, 2, 0, 3), (0, 0, 0, 1, 0), (0, 1, 0, 0, 0)):
        lw = log_of(weights)
        population = population_of(example, lw)
        for seed in range(60):
            n = (1, 4, 11)[seed % 3]
            chosen = resampled(resampler, population, n, np.random.default_rng(seed))
            wrong = np.flatnonzero(np.isneginf(lw[chosen.parents["ancestor"]]))
            if len(wrong):
                raise Broken(
                    f"of weights {weights} it chose particle {chosen.parents['ancestor'][wrong[0]]}, weight 0"
                )


class _Extreme(np.random.Generator):
    """A generator whose `random` gives one value only: the smallest or the largest that there is."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(np.random.SeedSequence(0)))
        self._value = value

    def random(self, size=None, dtype=np.float64, out=None):  # type: ignore[no-untyped-def]
        """The value."""
        return self._value if size is None else np.full(size, self._value)


@RESAMPLER.property("it copes with the smallest and the largest uniform, 0 and 1 - 2^-53")
def copes_with_extreme_uniforms(resampler: Resampler, example: Example) -> None:
    """They do come up, once in a long run: the index stays in range, and a weight of zero is not chosen even then."""
    for value in (0.0, 1 - 2.0**-53):
        for weights in ((0, 0, 1, 2, 3), (1, 2, 3, 0, 0), (1, 0, 2, 0, 3), (0.1, 0.2, 0.3)):
            lw = log_of(weights)
            for n in (1, 3, 10):
                chosen = resampled(resampler, population_of(example, lw), n, _Extreme(value))
                wrong = chosen.parents["ancestor"][np.isneginf(lw[chosen.parents["ancestor"]])]
                if len(wrong):
                    raise Broken(
                        f"where rng.random() gives {value:.17g}, of weights {weights} it chose particle {wrong[0]}, "
                        'weight 0: np.searchsorted wants side="right", and an end that has weight'
                    )


@RESAMPLER.property("chosen particles bring their parents along")
def parents_come_along(resampler: Resampler, example: Example) -> None:
    """Row k of the result is particle ``parents["ancestor"][k]``."""
    population = population_of(example, log_of((1.0, 2.0, 1.5, 0.5, 2.0)))
    chosen = resampled(resampler, population, 4, np.random.default_rng(1))
    expected = population.parents["previous"][chosen.parents["ancestor"]]
    if "previous" not in chosen.parents or not np.array_equal(chosen.parents["previous"], expected):
        raise Broken('parents "previous" of the result are not those of the ancestors')


def _run(resampler: Resampler, example: Example, rng: np.random.Generator) -> Population:
    return resampler.resample(rng, population_of(example, log_of(np.linspace(1, 2, 40))), 25)


add_generator_properties(RESAMPLER, _run)


@RESAMPLER.property("different generators give different results")
def listens_to_the_generator(resampler: Resampler, example: Example) -> None:
    """A proper scheme has to leave something to chance where n W_i are no whole numbers."""
    needs_proper_weights(resampler)
    population = population_of(example, log_of((0.41, 0.24, 0.2, 0.1, 0.05)))
    results = {
        tuple(resampled(resampler, population, 2, np.random.default_rng(seed)).parents["ancestor"].tolist())
        for seed in range(40)
    }
    if len(results) < 2:
        raise Broken("forty generators of different seeds give one and the same result: it ignores `rng`")


@RESAMPLER.property("the scale of the weights does not matter")
def scale_of_weights_is_irrelevant(resampler: Resampler, example: Example) -> None:
    """Log weights + c choose the same particles; nothing over- or underflows."""
    lw = log_of((0.11, 0.36, 0.15, 0.38))
    for seed in range(10):
        a = resampled(resampler, population_of(example, lw), 6, np.random.default_rng(seed))
        for shift in (0.5, 100.0, -100.0, 1e4, -1e4):
            with np.errstate(all="ignore"):
                try:
                    b = resampled(resampler, population_of(example, lw + shift), 6, np.random.default_rng(seed))
                except Broken as broken:
                    raise Broken(f"log weights + {shift:g} (overflow or underflow?): {broken}") from broken
            if not np.array_equal(a.parents["ancestor"], b.parents["ancestor"]):
                raise Broken(f"adding {shift:g} to all log weights chooses other particles (overflow or underflow?)")
            if resampler.properly_weighted and not np.allclose(b.log_weights - shift, a.log_weights, atol=1e-8):
                raise Broken(f"adding {shift:g} to all log weights does not add it to the output's")
