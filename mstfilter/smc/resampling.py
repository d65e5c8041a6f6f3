"""Resampling by weight: the classical schemes, and wrappers around a scheme.

W_i is the normalised weight of particle i, N_i its number of copies among the n selected particles, f = frac(n W_i).
The schemes with equal output weights are unbiased: E[N_i] = n W_i. `FearnheadClifford` is unbiased due to its output
weights. The schemes differ in the variance of N_i.

==================  =================================================  ====================================
scheme              N_i                                                variance of N_i
==================  =================================================  ====================================
Multinomial         n independent draws                                n W_i (1 - W_i)
Residual            floor(n W_i), the rest by another scheme           f (1 - f / R), R = sum of all f
Stratified          one draw in each of n equal strata of [0, 1)       sum over strata of p (1 - p)
Systematic          one draw, shifted to each stratum                  f (1 - f)
Ssp                 floor or ceil, fractions decided pair by pair      f (1 - f)
Killing             survive with w_i / max w, else multinomial         see `Killing`
FearnheadClifford   at most 1, with unequal weights                    least expected squared error
==================  =================================================  ====================================

>>> import numpy as np
>>> rng = np.random.default_rng(0)
>>> Systematic().select(rng, np.log([0.5, 0.25, 0.25]), 4)[0]
array([0, 0, 1, 2])

The variance of `Residual` is that of its default, the multinomial remainder. Weights need not sum to 1, may have any
float type, and may be zero (log weight -inf); n may differ from their number. A particle of weight zero is never
selected. `InputError` is raised if a log weight is NaN or +inf, or if all weights are zero.

Ties: the random schemes do not compare weights. Of particles with equal weights, `LargestWeights.select` (a stable
sort), `coalesce`, and the diverse schemes of `mstfilter.smc.diverse_resampling` take the first.

`Coalesced`, `Tempered`, `Shuffled` and `KeepWeights` wrap another resampler:

>>> doubled = Population(np.array([1.0, 2.0, 1.0, 3.0]), np.log([1.0, 1.0, 2.0, 4.0]))
>>> Coalesced(FearnheadClifford()).resample(rng, doubled, 3).particles
array([2., 1., 3.])

Residual-systematic resampling (Bolic, Djuric, Hong 2004) has no class: in exact arithmetic it selects the same
particles as `Systematic` and as ``Residual("systematic")`` if all use the same uniform number.

References: Douc, Cappe, Moulines (2005), "Comparison of resampling schemes for particle filtering"; Kitagawa (1996);
Liu and Chen (1998).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from mstfilter.errors import InputError, check_component, check_number
from mstfilter.smc.interfaces import Resampler, WeightResampler
from mstfilter.smc.population import Population
from mstfilter.smc.similarity import Equivalence, ExactEquality


def checked_weights(log_weights: np.ndarray, n: int) -> np.ndarray:
    """(m,) float64 weights with maximum 1, from log weights of any float type.

    Raises
    ------
    InputError
        If the log weights are not one-dimensional, hold NaN or +inf, or are all -inf, or if n < 1.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    if lw.ndim != 1 or len(lw) == 0:
        raise InputError(f"log weights have shape {lw.shape}, expected one number per particle")
    if not isinstance(n, (int, np.integer)) or n < 1:
        raise InputError(f"resampling to {n} particles, expected an integer of at least 1")
    top = lw.max()
    if not -np.inf < top < np.inf:
        at = int(np.flatnonzero(~np.isfinite(lw) & ~np.isneginf(lw))[0]) if not np.isneginf(top) else 0
        raise InputError(f"log weights cannot be resampled: entry {at} is {lw[at]}, the largest is {top}")
    weights = lw - top
    return np.exp(weights, out=weights)


def _cumulative(log_weights: np.ndarray, n: int) -> np.ndarray:
    """(m,) cumulative sums of the checked weights."""
    weights = checked_weights(log_weights, n)
    return np.cumsum(weights, out=weights)


def _certain_copies(weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, int]:
    """floor(n W_i) (m,) int64, the fractions frac(n W_i) (m,), and the sum of the fractions: the copies to draw."""
    expected = weights * (n / weights.sum())
    copies = np.floor(expected * (1 + 1e-13))  # an integer up to rounding counts as that integer
    return copies.astype(np.int64), np.clip(expected - copies, 0.0, None), n - int(copies.sum())


def ordered_uniforms(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n,) uniforms on [0, 1] in ascending order, in O(n): normalised exponential spacings."""
    spacings = np.cumsum(rng.standard_exponential(n + 1))
    return spacings[:-1] / spacings[-1]


def _from_points(cumulative: np.ndarray, points: np.ndarray) -> np.ndarray:
    """For each point of [0, total), the index of the interval of the cumulative weights that contains it."""
    index = np.searchsorted(cumulative, points, side="right")  # "right" skips weights of zero
    # A point rounded up to the total belongs to the last particle of positive weight.
    last = int(np.searchsorted(cumulative, cumulative[-1], side="left"))
    return np.minimum(index, last)


def systematic_ancestors(cumulative: np.ndarray, n: int, shift: float) -> np.ndarray:
    """Systematic selection: ancestors at the points (k + shift) / n, in O(m + n) without a search."""
    total = cumulative[-1]
    # Number of points below each cumulative weight; n at the total, whatever the rounding.
    points = cumulative * (n / total)
    points -= shift
    np.ceil(points, out=points)  # greater than -1 before, so not negative now
    np.minimum(points, n, out=points)
    points[cumulative.searchsorted(total, side="left") :] = n
    # The ancestor of position k is the number of particles that end at or before point k.
    ends = points[:-1].astype(np.int64)
    return np.bincount(ends, minlength=n)[:n].cumsum()


def _repeated(copies: np.ndarray) -> np.ndarray:
    return np.repeat(np.arange(len(copies)), copies)


@dataclass(frozen=True)
class Multinomial(WeightResampler):
    """Independent draws by weight (Gordon, Salmond, Smith 1993). It has the largest variance; used as a reference."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        cumulative = _cumulative(log_weights, n)
        return _from_points(cumulative, ordered_uniforms(rng, n) * cumulative[-1]), None


@dataclass(frozen=True)
class Stratified(WeightResampler):
    """One uniform in each of n equal strata (Kitagawa 1996)."""

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        cumulative = _cumulative(log_weights, n)
        points = (np.arange(n) + rng.random(n)) * (cumulative[-1] / n)
        return _from_points(cumulative, points), None


@dataclass(frozen=True)
class Systematic(WeightResampler):
    """One uniform for all strata (Carpenter, Clifford, Fearnhead 1999); N_i is floor or ceil of n W_i."""

    batched: ClassVar[bool] = True

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        if log_weights.ndim == 2:  # one row per run of a batch
            return _systematic_rows(log_weights, n, rng.random((len(log_weights), 1))), None
        cumulative = _cumulative(log_weights, n)
        return systematic_ancestors(cumulative, n, rng.random()), None


def _systematic_rows(log_weights: np.ndarray, n: int, shifts: np.ndarray) -> np.ndarray:
    """(R, n) ancestors for (R, m) log weights and (R, 1) shifts: `systematic_ancestors` of every row."""
    rows = len(log_weights)
    weights = log_weights - log_weights.max(axis=1, keepdims=True)
    np.exp(weights, out=weights)
    cumulative = np.cumsum(weights, axis=1, out=weights)
    total = cumulative[:, -1:]
    points = cumulative * (n / total)
    points -= shifts
    np.ceil(points, out=points)
    np.minimum(points, n, out=points)
    points[cumulative == total] = n
    ends = points[:, :-1].astype(np.int64) + (n + 1) * np.arange(rows)[:, None]
    counts = np.bincount(ends.ravel(), minlength=rows * (n + 1)).reshape(rows, n + 1)
    return counts[:, :n].cumsum(axis=1)


@dataclass(frozen=True)
class Residual(WeightResampler):
    """floor(n W_i) copies of each particle; the rest is drawn by another scheme (Liu and Chen 1998).

    Parameters
    ----------
    remainder : {"multinomial", "stratified", "systematic"}
        Scheme for the fractions frac(n W_i). Systematic has the least variance, f (1 - f).
    """

    remainder: Literal["multinomial", "stratified", "systematic"] = "multinomial"

    def __post_init__(self) -> None:
        if self.remainder not in ("multinomial", "stratified", "systematic"):
            raise InputError(f"remainder is {self.remainder!r}, expected multinomial, stratified or systematic")

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        copies, fractions, rest = _certain_copies(checked_weights(log_weights, n), n)
        if rest > 0:
            cumulative = np.cumsum(fractions)
            if self.remainder == "systematic":
                drawn = systematic_ancestors(cumulative, rest, rng.random())
            elif self.remainder == "stratified":
                drawn = _from_points(cumulative, (np.arange(rest) + rng.random(rest)) * (cumulative[-1] / rest))
            else:
                drawn = _from_points(cumulative, ordered_uniforms(rng, rest) * cumulative[-1])
            copies += np.bincount(drawn, minlength=len(copies))
        return _repeated(copies), None


_SETTLED = 1e-12  # a fraction this close to 0 or 1 is 0 or 1 up to rounding


@dataclass(frozen=True)
class Ssp(WeightResampler):
    """Srinivasan sampling process: N_i is floor or ceil of n W_i, for any order of the particles.

    Two fractions a and b form a pair, with up = min(1 - a, b) and down = min(a, 1 - b). With probability
    down / (up + down), a grows and b shrinks by `up`; otherwise a shrinks and b grows by `down`. Then one of the two
    is 0 or 1, which is final; the other one is paired again. Here all pairs of a round are
    processed together, so log2(n) rounds replace n steps (Gerber, Chopin, Whiteley 2019,
    "Negative association, ordering and convergence of resampling methods").
    """

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = checked_weights(log_weights, n)
        copies, fractions, rest = _certain_copies(weights, n)
        index = np.flatnonzero(fractions > _SETTLED)
        value = fractions[index]
        while len(index) > 1:
            pairs = len(index) // 2
            a, b = value[: 2 * pairs : 2], value[1 : 2 * pairs : 2]
            up, down = np.minimum(1 - a, b), np.minimum(a, 1 - b)
            lift = rng.random(pairs) * (up + down) < down
            value[: 2 * pairs : 2] = np.where(lift, a + up, a - down)
            value[1 : 2 * pairs : 2] = np.where(lift, b - up, b + down)
            full = value >= 1 - _SETTLED
            copies[index[full]] += 1
            rest -= int(full.sum())
            alive = ~full & (value > _SETTLED)
            index, value = index[alive], value[alive]
        if rest > 0 and len(index):  # the fractions sum to an integer, so the last one is 0 or 1 up to rounding
            copies[index[0]] += 1
            rest -= 1
        if rest > 0:  # a copy lost by rounding, probability of order 1e-12
            copies[np.argmax(weights)] += rest
        return _repeated(copies), None


@dataclass(frozen=True)
class Killing(WeightResampler):
    """A particle keeps its position with probability w_i / max w; the others are replaced by draws by weight.

    Most particles keep their positions if the weights are nearly equal. Del Moral (2004), "Feynman-Kac formulae",
    section 5.6, for n = m. For n != m each of n positions belongs to one particle: floor(n / m) positions each, and
    one more for a random subset. Each position then survives or is replaced. E[N_i] = n W_i for any n. For n = m,
    with p = w / max w, var N_i = p_i (1 - p_i) (1 - 2 W_i) + W_i^2 sum p (1 - p) + (m - sum p) W_i (1 - W_i).
    """

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        weights = checked_weights(log_weights, n)
        m = len(weights)
        ancestors = np.tile(np.arange(m), n // m)
        if n % m:
            ancestors = np.concatenate([ancestors, np.sort(rng.choice(m, n % m, replace=False, shuffle=False))])
        killed = np.flatnonzero(rng.random(n) >= weights[ancestors])
        cumulative = np.cumsum(weights)
        if len(killed):
            ancestors[killed] = _from_points(cumulative, ordered_uniforms(rng, len(killed)) * cumulative[-1])
        return ancestors, None


@dataclass(frozen=True)
class FearnheadClifford(WeightResampler):
    """Optimal resampling: keeps particles with w_i >= c, and others with probability w_i / c and weight c.

    c solves sum min(1, w_i / c) = n. The light particles are selected systematically, so there are no duplicates. The
    total weight is kept exactly. Of all unbiased random weights with at most n positive ones, these have the least
    expected squared error. If n or fewer particles have positive weight, all of these are kept, so fewer than n may
    be returned. A filter that selects n of n particles therefore degenerates: use more candidates than particles
    (`Branching`).

    >>> log_weights = np.log([4.0, 3.0, 1.0, 1.0, 1.0])
    >>> ancestors, log_weights = FearnheadClifford().select(np.random.default_rng(1), log_weights, 4)
    >>> ancestors
    array([0, 1, 2, 4])

    Reference: Fearnhead and Clifford (2003), "On-line inference for hidden Markov models via particle filters",
    Journal of the Royal Statistical Society B 65.
    """

    exact_size: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        weights = checked_weights(log_weights, n)
        lw = np.asarray(log_weights, dtype=np.float64)
        positive = np.flatnonzero(weights > 0)
        if len(positive) <= n:
            return positive, lw[positive] + np.log(len(positive) / len(lw))
        w = weights[positive]
        c, heavy = optimal_threshold(w, n)
        light = np.flatnonzero(~heavy)
        log_out = np.where(heavy, lw[positive], lw.max() + np.log(c))
        chosen = heavy
        scaled = w[light] / w[light].max()  # avoids underflow
        chosen[light[systematic_ancestors(np.cumsum(scaled), n - int(heavy.sum()), rng.random())]] = True
        # Adding log(n / m) keeps the log mean of the weights.
        return positive[chosen], log_out[chosen] + np.log(n / len(lw))


def optimal_threshold(weights: np.ndarray, n: int) -> tuple[float, np.ndarray]:
    """c with sum min(1, w_i / c) = n, and the (m,) bool mask of the fewer than n weights with w_i >= c.

    Parameters
    ----------
    weights : (m,) float64
        Positive, m > n.
    n : int
        Number of particles to select.
    """
    heavy, kept, c = np.zeros(len(weights), bool), 0, float(weights.sum()) / n
    while True:  # c decreases until all light weights are below c; takes a few rounds
        # Light weights are below c by more than rounding errors, so no light interval contains two points.
        heavy |= weights >= c * (1 - 1e-9)
        if int(heavy.sum()) == kept:
            return c, heavy
        kept = int(heavy.sum())
        if kept >= n:  # only by rounding: the sum of the light weights is negligible
            heavy = np.zeros(len(weights), bool)
            heavy[np.argsort(-weights, kind="stable")[: n - 1]] = True
            return float(weights[~heavy].sum()), heavy
        c = float(weights[~heavy].sum()) / (n - kept)


@dataclass(frozen=True)
class LargestWeights(WeightResampler):
    """Selects the n particles of largest weight, with equal weights; draws nothing. Not properly weighted.

    Of particles with equal weights the first is selected: the sort in `select` is stable. If fewer than n particles
    have positive weight, they are repeated in turn.
    """

    properly_weighted: ClassVar[bool] = False

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, None]:
        checked_weights(log_weights, n)
        # Sorted by log weight, because different weights may all underflow to zero.
        largest = np.argsort(-log_weights, kind="stable")[: np.isfinite(log_weights).sum()]
        return largest[np.arange(n) % len(largest)], None


@dataclass(frozen=True)
class ResamplerWrapper(Resampler):
    """Base class of resamplers that change the input or the result of another resampler.

    It is properly weighted if the wrapped resampler is.

    Parameters
    ----------
    scheme : Resampler
        The wrapped resampler.
    """

    scheme: Resampler = Systematic()

    def __post_init__(self) -> None:
        check_component("scheme", self.scheme, Resampler)

    @property
    def properly_weighted(self) -> bool:
        return self.scheme.properly_weighted

    @property
    def exact_size(self) -> bool:
        return self.scheme.exact_size


@dataclass(frozen=True)
class Coalesced(ResamplerWrapper):
    """Merges equal particles, with the sum of their weights, before the selection.

    The result represents the same distribution with fewer particles. The population grows again only if a transition
    or update makes more candidates. ``notes["distinct"]`` is the number of different particles of positive weight.

    Parameters
    ----------
    equivalence : Equivalence
        Decides which particles are equal. The heaviest particle of a class is kept, the first of several.
    """

    scheme: Resampler = FearnheadClifford()
    equivalence: Equivalence = ExactEquality()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_component("equivalence", self.equivalence, Equivalence)

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        population = population.realised()
        classes = self.equivalence.classes(population.particles)
        representatives, log_weights = coalesce(population.log_weights, classes)
        chosen = self.scheme.resample(rng, population.take(representatives, log_weights), n)
        ancestors = representatives[chosen.parents["ancestor"]]
        return chosen.with_ancestors(ancestors, distinct=len(representatives))


def coalesce(log_weights: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Select one particle for each class: the heaviest, with the weight of the class.

    Returns
    -------
    representatives : (k,) int
        The heaviest particle of each class (the first, if several have equal weights), ascending. Classes of weight
        zero are left out.
    log_weights : (k,) float64
        Log of the summed weights times k / m, which keeps the log mean of the weights.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    classes = np.asarray(classes)
    mass = np.bincount(classes, np.exp(lw - lw.max()))
    heaviest = np.lexsort((np.arange(len(lw)), -lw, classes))
    first = np.concatenate([[True], np.diff(classes[heaviest]) > 0])
    representatives = heaviest[first]
    representatives = np.sort(representatives[mass[classes[representatives]] > 0])
    total = np.log(mass[classes[representatives]]) + lw.max()
    return representatives, total + np.log(len(representatives) / len(lw))


@dataclass(frozen=True)
class Tempered(ResamplerWrapper):
    """Selects by w^power and multiplies the selected weights by w^(1 - power): light particles survive longer.

    Parameters
    ----------
    power : float
        In [0, 1]. 1: same as the wrapped scheme. 0: all particles of positive weight are equally likely.
    """

    power: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("power", self.power, at_least=0, at_most=1)

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
class Shuffled(ResamplerWrapper):
    """Permutes the particles at random before the selection.

    Systematic and stratified schemes then do not depend on the order of the particles.
    """

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        order = rng.permutation(len(population))
        chosen = self.scheme.resample(rng, population.take(order), n)
        return chosen.with_ancestors(order[chosen.parents["ancestor"]])


@dataclass(frozen=True)
class KeepWeights(ResamplerWrapper):
    """Selected particles keep their weights, as in the program of the MST authors.

    Selecting by weight and keeping the weight counts the same evidence twice, so this is not properly weighted.
    """

    scheme: Resampler = Multinomial()

    properly_weighted: ClassVar[bool] = False

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        chosen = self.scheme.resample(rng, population, n)
        return replace(chosen, log_weights=population.log_weights[chosen.parents["ancestor"]])
