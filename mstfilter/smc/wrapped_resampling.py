"""Resamplers that wrap another resampler (`scheme`).

What a scheme does depends on what it is given. `Sorted` puts similar particles side by side, so that a scheme that
draws one particle per stretch of weight (`Stratified`) draws one per region of space; `Shuffled` destroys an unlucky
order. `Coalesced` merges equal particles first, and so pays for each value once:

>>> import numpy as np
>>> from mstfilter.smc import Coalesced, FearnheadClifford, Population, Sorted, Stratified
>>> rng = np.random.default_rng(0)
>>> doubled = Population(np.array([1.0, 2.0, 1.0, 3.0]), np.log([1.0, 1.0, 2.0, 4.0]))
>>> Coalesced(FearnheadClifford()).resample(rng, doubled, 3).particles
array([2., 1., 3.])

Sorting takes most of the noise from the mean of particles on a line (Li, Wang, Deng, Liu 2022):

>>> x = rng.standard_normal(200)
>>> population = Population(x, -((x - 0.5) ** 2))
>>> def noise(scheme):
...     return np.std([scheme.resample(rng, population, 50).particles.mean() for _ in range(200)])
>>> bool(noise(Sorted(Stratified())) < 0.2 * noise(Stratified()))
True

`Tempered` selects by w^a and multiplies the output weights by w^(1 - a), so light particles are kept more often.
`Sized` lets a `Size` choose the number of particles. All of these are properly weighted if their scheme is;
`KeepWeights` is not, because its weights count twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mstfilter.base.errors import InputError, check_integer
from mstfilter.base.fields import Share
from mstfilter.smc.components import ExactEquality, Kld
from mstfilter.smc.diverse_resampling import FearnheadClifford
from mstfilter.smc.interfaces import Equivalence, Resampler, Size
from mstfilter.smc.population import Population, as_matrix
from mstfilter.smc.resampling import Multinomial, Stratified, Systematic, checked_weights, search


@dataclass(frozen=True)
class ResamplerWrapper(Resampler):
    """Base class of resamplers that change the input or the result of another resampler, `scheme`.

    The wrapper is properly weighted if `scheme` is properly weighted.
    """

    scheme: Resampler = Systematic()  # noqa: RUF009 (frozen)

    @property
    def properly_weighted(self) -> bool:
        return self.scheme.properly_weighted

    @property
    def exact_size(self) -> bool:
        return self.scheme.exact_size

    @property
    def chooses_n(self) -> bool:
        return self.scheme.chooses_n


@dataclass(frozen=True)
class Sorted(ResamplerWrapper):
    """Sorts the particles before the selection, for schemes that depend on the order.

    Scalar particles are sorted by value, and vectors along a Hilbert curve. In one dimension, `Systematic` and
    `Stratified` change the weighted distribution function by at most 1 / n. Gerber, Chopin, Whiteley (2019),
    "Negative association, ordering and convergence of resampling methods"; Li, Wang, Deng, Liu (2022),
    "Stratification and optimal resampling for sequential Monte Carlo".
    """

    scheme: Resampler = Stratified()  # noqa: RUF009 (frozen)

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        order = np.argsort(_line(as_matrix(population.particles)), kind="stable")
        chosen = self.scheme.resample(rng, population.take(order), n)
        return chosen.with_ancestors(order[chosen.parents["ancestor"]])


def _line(x: np.ndarray) -> np.ndarray:
    """(n,) sort keys of rows (n, d): the value if d = 1, otherwise the position along a Hilbert curve."""
    d = x.shape[1]
    if d == 1:
        return x[:, 0]
    bits = 62 // d
    if bits < 1:
        raise InputError(f"particles have {d} dimensions, at most 62 are ordered along a Hilbert curve")
    # The logistic function maps all values into (0, 1): Gerber and Chopin (2015), section 3.
    spread = x.std(axis=0)
    z = (x - x.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    cells = (2.0 ** (bits - 1) * (1 + np.tanh(z / 2))).astype(np.int64)
    return hilbert_position(np.minimum(cells, (1 << bits) - 1), bits)


def hilbert_position(cells: np.ndarray, bits: int) -> np.ndarray:
    """(n,) int64 positions on the Hilbert curve of cells (n, d) with coordinates 0 .. 2^bits - 1; d * bits < 63.

    Neighbours on the curve are neighbours in space. Skilling (2004), "Programming the Hilbert curve".
    """
    x = np.array(cells.T, np.int64)
    d = len(x)
    for bit in range(bits - 1, 0, -1):  # undo the reflections and exchanges of axes, from the largest cubes
        lower = (1 << bit) - 1
        for i in range(d):
            upper = (x[i] >> bit & 1).astype(bool)
            exchange = np.where(upper, 0, (x[0] ^ x[i]) & lower)
            x[0] ^= np.where(upper, lower, exchange)
            x[i] ^= exchange
    for i in range(1, d):  # Gray code
        x[i] ^= x[i - 1]
    flips = np.zeros_like(x[0])
    for bit in range(bits - 1, 0, -1):
        flips ^= np.where(x[d - 1] >> bit & 1, (1 << bit) - 1, 0)
    x ^= flips
    position = np.zeros_like(flips)
    for bit in range(bits - 1, -1, -1):
        for i in range(d):
            position = position << 1 | x[i] >> bit & 1
    return position


@dataclass(frozen=True)
class Shuffled(ResamplerWrapper):
    """Permutes the particles at random before the selection.

    Systematic and stratified schemes then do not depend on the order of the particles.
    """

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        order = rng.permutation(len(population))
        chosen = self.scheme.resample(rng, population.take(order), n)
        return chosen.with_ancestors(order[chosen.parents["ancestor"]])


@dataclass(frozen=True)
class Coalesced(ResamplerWrapper):
    """Merges particles that are equal by `equivalence`, and sums their weights, before the selection.

    One particle of each class is kept, drawn by weight, so the paths of the particles and functions of unequal
    particles have no bias. The number of particles grows again only if a transition or update makes more candidates.
    ``notes["distinct"]`` is the number of classes of positive weight.
    """

    scheme: Resampler = FearnheadClifford()  # noqa: RUF009 (frozen)
    equivalence: Equivalence = ExactEquality()  # noqa: RUF009 (frozen)

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        population = population.realised()
        classes = self.equivalence.classes(population.particles)
        representatives, log_weights = coalesce(rng, population.log_weights, classes)
        chosen = self.scheme.resample(rng, population.take(representatives, log_weights), n)
        ancestors = representatives[chosen.parents["ancestor"]]
        return chosen.with_ancestors(ancestors, distinct=len(representatives))


def coalesce(rng: np.random.Generator, log_weights: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw one particle of each class by weight, with the total weight of the class.

    Returns the representatives (k,) in ascending order and their log weights (k,). With m particles and k classes,
    the output log weight of a class of total weight w is ``log(w k / m)``, so the mean weight does not change.
    Classes of weight zero are omitted. Classes of one particle need no random number.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    classes, weights = np.asarray(classes), np.exp(lw - lw.max())
    positive = np.flatnonzero(weights)
    order = positive[np.argsort(classes[positive], kind="stable")]
    first = np.flatnonzero(np.append(True, np.diff(classes[order]) > 0))
    drawn, sizes = order[first], np.diff(np.append(first, len(order)))
    for k in np.flatnonzero(sizes > 1):
        members = order[first[k] : first[k] + sizes[k]]
        drawn[k] = members[search(weights[members], rng.random(1))[0]]
    representatives = np.sort(drawn)
    total = np.log(np.bincount(classes, weights)[classes[representatives]]) + lw.max()
    return representatives, total + np.log(len(representatives) / len(lw))


@dataclass(frozen=True)
class Sized(ResamplerWrapper):
    """Selects as many particles as `size` chooses. The number `n` of the filter is then only that at the start."""

    size: Size = Kld()  # noqa: RUF009 (frozen)

    exact_size: ClassVar[bool] = False
    chooses_n: ClassVar[bool] = True

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        chosen = self.size.choose(population)
        check_integer(f"number of particles that {type(self.size).__name__} chose", chosen)
        return self.scheme.resample(rng, population, int(chosen))


@dataclass(frozen=True)
class Tempered(ResamplerWrapper):
    """Selects by w^power and multiplies output weights by w^(1 - power), so light particles are kept more often.

    `power` is in [0, 1]. A power of 1 leaves the wrapped scheme unchanged. With a power of 0 all particles of
    positive weight are equally likely.
    """

    power: Share = 0.5

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        lw = population.log_weights
        positive = checked_weights(lw, n) > 0
        tempered = np.full(len(lw), -np.inf)
        tempered[positive] = self.power * lw[positive]
        rest = np.zeros(len(lw))
        rest[positive] = (1 - self.power) * lw[positive]
        chosen = self.scheme.resample(rng, replace(population, log_weights=tempered), n)
        return chosen.reweighted(rest[chosen.parents["ancestor"]])


@dataclass(frozen=True)
class KeepWeights(ResamplerWrapper):
    """The selected particles keep their weights, as in the program of the MST authors.

    The weights count twice, in the selection and in the output weights, so the scheme is not properly weighted.
    """

    scheme: Resampler = Multinomial()  # noqa: RUF009 (frozen)

    properly_weighted: ClassVar[bool] = False

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        chosen = self.scheme.resample(rng, population, n)
        return replace(chosen, log_weights=population.log_weights[chosen.parents["ancestor"]])
