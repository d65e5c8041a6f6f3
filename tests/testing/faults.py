"""Resamplers with one fault each, and correct ones."""

from __future__ import annotations

import copy
import random
import time
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy.optimize import brentq

from mstfilter.smc import Population, Resampler, WeightResampler, log_mean_exp, normalise


def systematic(rng, weights, n):
    """A correct scheme, written as a user would."""
    points = (np.arange(n) + rng.random()) / n
    cumulative = np.cumsum(weights)
    last = np.flatnonzero(weights)[-1]
    return np.minimum(np.searchsorted(cumulative, points * cumulative[-1], side="right"), last)


@dataclass(frozen=True)
class Correct(WeightResampler):
    def select(self, rng, log_weights, n):
        return systematic(rng, normalise(log_weights), n), None


@dataclass(frozen=True)
class CorrectWeighted(WeightResampler):
    """Select evenly among the positive ones and keep the weights: proper, with unequal output weights."""

    def select(self, rng, log_weights, n):
        even = (log_weights > -np.inf) / 1.0
        ancestors = systematic(rng, even, n)
        return ancestors, log_weights[ancestors] + np.log(even.mean())


def multinomial(rng, weights, n):
    """Another correct scheme, with the largest variance."""
    return np.searchsorted(np.cumsum(weights)[:-1], rng.random(n) * weights.sum(), side="right")


@dataclass(frozen=True)
class Rejection(WeightResampler):
    """Draws evenly and accepts with probability w / max w; the cost grows with max w / mean w."""

    def select(self, rng, log_weights, n):
        weights = np.exp(log_weights - log_weights.max())
        ancestors, waiting = np.empty(n, int), np.arange(n)
        while len(waiting):
            ancestors[waiting] = rng.integers(len(weights), size=len(waiting))
            waiting = waiting[rng.random(len(waiting)) >= weights[ancestors[waiting]]]
        return ancestors, None


@dataclass(frozen=True)
class Metropolis(WeightResampler):
    """Chains of so many steps that their total variation distance from the weights is at most `tolerance`."""

    tolerance: float = 0.01

    def select(self, rng, log_weights, n):
        weights = np.exp(log_weights - log_weights.max())
        chains = np.resize(np.flatnonzero(weights), n)
        # Tierney (1994): each step keeps at most 1 - mean w / max w of the distance.
        steps = int(np.ceil(np.log(self.tolerance) / np.log1p(-min(weights.mean(), 1 - 1e-9))))
        for _ in range(steps):
            proposed = rng.integers(len(weights), size=n)
            chains = np.where(rng.random(n) * weights[chains] < weights[proposed], proposed, chains)
        return chains, None


@dataclass(frozen=True)
class Chopthin(WeightResampler):
    """Light particles are thinned, heavy ones chopped: the output weights differ by a factor of at most `ratio`."""

    ratio: float = 6.0

    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)

        def copies(a):
            return np.where(weights < a, weights / a, np.maximum(1.0, 2 * weights / (self.ratio * a)))

        a = brentq(lambda a: copies(a).sum() - n, 0.01 / n, 1.0, xtol=1e-15, rtol=1e-12)
        expected = copies(a)
        ancestors = systematic(rng, expected, n)
        out = np.maximum(a, weights / np.maximum(np.bincount(ancestors, minlength=len(weights)), 1))
        lw = np.where(weights < a, np.log(a), np.log(out))[ancestors]
        return ancestors, lw + log_mean_exp(log_weights) + np.log(n)


@dataclass(frozen=True)
class MeansByOrder(Resampler):
    """New particles are means of the old ones by optimal transport, in one dimension: by order (Reich 2013)."""

    def resample(self, rng, population, n):
        x, W = population.particles, population.weights
        order = np.argsort(x)
        # Cumulative integral of the quantile function; new particle k is its mean over [k/n, (k+1)/n].
        ends = np.concatenate([[0.0], np.cumsum(W[order])])
        integral = np.concatenate([[0.0], np.cumsum(W[order] * x[order])])
        made = np.diff(np.interp(np.linspace(0, ends[-1], n + 1), ends, integral)) * n
        return Population(made, np.full(n, population.log_mean_weight))


@dataclass(frozen=True)
class RareHeaps(WeightResampler):
    """In a call of a thousand, all copies are of one particle drawn by weight."""

    rate: float = 0.001

    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        if rng.random() < self.rate:
            return np.repeat(multinomial(rng, weights, 1), n), None
        return systematic(rng, weights, n), None


@dataclass(frozen=True)
class RareBlocks(WeightResampler):
    """In a call of 500, blocks of a third of the positions get one draw."""

    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        if rng.random() < 0.002 and n >= 3:
            return np.resize(np.repeat(multinomial(rng, weights, 3), -(-n // 3)), n), None
        return multinomial(rng, weights, n), None


@dataclass(frozen=True)
class RandomNumber(WeightResampler):
    """Every position is filled with probability 0.9; the weight of the others is kept on average."""

    exact_size: ClassVar[bool] = False

    def select(self, rng, log_weights, n):
        filled = np.flatnonzero(rng.random(n) < 0.9)
        filled = filled if len(filled) else np.array([0])
        share = 0.9 + (0.1**n) / n  # expected number of filled positions / n
        ancestors = rng.permutation(multinomial(rng, normalise(log_weights), n))[filled]
        return ancestors, np.full(len(filled), log_mean_exp(log_weights) + np.log(len(filled) / n / share))


@dataclass(frozen=True)
class SizeChanging(WeightResampler):
    """Even draws that carry their weight: the total weight is kept on average only."""

    def select(self, rng, log_weights, n):
        ancestors = rng.choice(np.flatnonzero(log_weights > -np.inf), n)
        return ancestors, log_weights[ancestors] + np.log((log_weights > -np.inf).mean())


CORRECT = (
    Metropolis(),
    Chopthin(),
    MeansByOrder(),
    RareHeaps(),
    RareBlocks(),
    RandomNumber(),
    SizeChanging(),
)


class ForgetsAncestors(Resampler):
    """A selection that sets no ancestors."""

    def resample(self, rng, population, n):
        ancestors = systematic(rng, population.weights, n)
        return Population(population.particles[ancestors], np.full(n, population.log_mean_weight))


@dataclass(frozen=True)
class BiasedResidual(WeightResampler):
    """The remainder is drawn from W - copies instead of n W - copies: light particles are selected too rarely."""

    def select(self, rng, log_weights, n):
        W = normalise(log_weights)
        copies = np.floor(n * W)
        rest = np.maximum(W - copies, 0) if (np.maximum(W - copies, 0) > 0).any() else W
        drawn = systematic(rng, rest, int(n - copies.sum())) if n > copies.sum() else np.array([], int)
        return np.concatenate([np.repeat(np.arange(len(W)), copies.astype(int)), drawn]), None


@dataclass(frozen=True)
class IgnoresN(WeightResampler):
    def select(self, rng, log_weights, n):
        return systematic(rng, normalise(log_weights), len(log_weights)), None


@dataclass(frozen=True)
class PicksZeroWeights(WeightResampler):
    """Gives the remainder to the last particle, for any weight."""

    def select(self, rng, log_weights, n):
        W = normalise(log_weights)
        copies = np.floor(n * W).astype(int)
        copies[-1] += n - copies.sum()
        return np.repeat(np.arange(len(W)), copies), None


@dataclass(frozen=True)
class ZeroAtTheEdge(WeightResampler):
    """Picks a leading weight of zero where the uniform is exactly 0."""

    def select(self, rng, log_weights, n):
        points = (np.arange(n) + rng.random()) / n
        return np.searchsorted(np.cumsum(normalise(log_weights)), points, side="left"), None


@dataclass(frozen=True)
class RemainderFromWeights(WeightResampler):
    """The remainder is W - copies, which may be negative (a fault of a published library)."""

    def select(self, rng, log_weights, n):
        W = normalise(log_weights)
        copies = np.floor(n * W).astype(int)
        rest = W - copies
        with np.errstate(all="ignore"):
            cumulative = np.cumsum(rest / rest.sum())
        cumulative[-1] = 1.0
        drawn = np.searchsorted(cumulative, rng.random(n - copies.sum()))
        return np.concatenate([np.repeat(np.arange(len(W)), copies), drawn]), None


@dataclass(frozen=True)
class FirstAlwaysStays(WeightResampler):
    """Always selects the first particle with weight."""

    def select(self, rng, log_weights, n):
        drawn = systematic(rng, normalise(log_weights), max(n - 1, 1))
        return np.concatenate([[np.flatnonzero(log_weights > -np.inf)[0]], drawn])[:n], None


@dataclass(frozen=True)
class GreedyCalledProper(WeightResampler):
    def select(self, rng, log_weights, n):
        best = np.argsort(-log_weights)[: np.isfinite(log_weights).sum()]
        return best[np.arange(n) % len(best)], None


@dataclass(frozen=True)
class GlobalGenerator(WeightResampler):
    def select(self, rng, log_weights, n):
        return systematic(np.random, normalise(log_weights), n), None


@dataclass(frozen=True)
class OldWeightsKept(WeightResampler):
    """Selects by weight and keeps the weight, so the weight counts twice."""

    def select(self, rng, log_weights, n):
        ancestors = systematic(rng, normalise(log_weights), n)
        return ancestors, log_weights[ancestors]


@dataclass(frozen=True)
class WeightsForgotten(WeightResampler):
    """Equal weights, but not those that keep the evidence."""

    def select(self, rng, log_weights, n):
        return systematic(rng, normalise(log_weights), n), np.full(n, -np.log(n))


@dataclass(frozen=True)
class OffByOne(WeightResampler):
    """Counts particles from 1."""

    def select(self, rng, log_weights, n):
        return systematic(rng, normalise(log_weights), n) + 1, None


@dataclass(frozen=True)
class OffByOneClipped(WeightResampler):
    """Selects the next particle, inside the range."""

    def select(self, rng, log_weights, n):
        return (systematic(rng, normalise(log_weights), n) + 1) % len(log_weights), None


@dataclass(frozen=True)
class OrderMatters(WeightResampler):
    """Sorts by weight and forgets to sort back."""

    def select(self, rng, log_weights, n):
        return systematic(rng, np.sort(normalise(log_weights))[::-1], n), None


@dataclass(frozen=True)
class ChangesInput(WeightResampler):
    def select(self, rng, log_weights, n):
        log_weights -= log_mean_exp(log_weights)
        return systematic(rng, np.exp(log_weights), n), None


@dataclass(frozen=True)
class SinglePrecisionOverflow(WeightResampler):
    """exp in single precision overflows at 88."""

    def select(self, rng, log_weights, n):
        weights = np.exp(log_weights.astype(np.float32))
        return systematic(rng, weights / weights.sum(), n), None


@dataclass(frozen=True)
class SinglePrecisionSum(WeightResampler):
    """Cumulates in single precision: small weights are lost."""

    def select(self, rng, log_weights, n):
        return systematic(rng, normalise(log_weights).astype(np.float32), n), None


@dataclass(frozen=True)
class SeedIgnored(WeightResampler):
    def select(self, rng, log_weights, n):
        return systematic(np.random.default_rng(0), normalise(log_weights), n), None


@dataclass(frozen=True)
class OwnGenerator(WeightResampler):
    """A new generator of unknown seed at each call."""

    def select(self, rng, log_weights, n):
        return systematic(np.random.default_rng(), normalise(log_weights), n), None


@dataclass(frozen=True)
class KeepsAll(WeightResampler):
    """Returns all particles if as many are wanted."""

    def select(self, rng, log_weights, n):
        if n == len(log_weights):
            return np.arange(n), None
        return systematic(rng, normalise(log_weights), n), None


@dataclass(frozen=True)
class Flattens(WeightResampler):
    """Selects by a power of the weights if n = m."""

    power: float = 0.9

    def select(self, rng, log_weights, n):
        power = self.power if n == len(log_weights) else 1.0
        weights = np.where(log_weights > -np.inf, np.exp(power * (log_weights - log_weights.max())), 0.0)
        return systematic(rng, weights, n), None


@dataclass(frozen=True)
class TiesToTheFirst(WeightResampler):
    """Finds particles by their weight."""

    def select(self, rng, log_weights, n):
        _, first, index = np.unique(log_weights, return_index=True, return_inverse=True)
        return first[index[systematic(rng, normalise(log_weights), n)]], None


@dataclass(frozen=True)
class MeanOfPositive(WeightResampler):
    """The evidence is the mean of the positive weights."""

    def select(self, rng, log_weights, n):
        positive = log_weights[log_weights > -np.inf]
        return systematic(rng, normalise(log_weights), n), np.full(n, log_mean_exp(positive))


@dataclass(frozen=True)
class OnePosition(WeightResampler):
    """The last position always goes to the heaviest particle, if n = m."""

    def select(self, rng, log_weights, n):
        ancestors = systematic(rng, normalise(log_weights), n)
        if n == len(log_weights) > 1:
            ancestors[0] = np.argmax(log_weights)
        return ancestors, None


@dataclass(frozen=True)
class DropsLight(WeightResampler):
    """Particles below a thousandth of the largest weight are dropped, if n = m."""

    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        if n == len(weights):
            weights = np.where(weights < 1e-3 * weights.max(), 0.0, weights)
        return systematic(rng, weights, n), None


@dataclass(frozen=True)
class Halves(WeightResampler):
    """The halves of a population are resampled apart, if n = m is even."""

    def select(self, rng, log_weights, n):
        weights, half = normalise(log_weights), n // 2
        if n != len(weights) or n % 2 or min(weights[:half].sum(), weights[half:].sum()) == 0:
            return systematic(rng, weights, n), None
        parts = systematic(rng, weights[:half], half), half + systematic(rng, weights[half:], half)
        return np.concatenate(parts), None


@dataclass(frozen=True)
class OnePercent(WeightResampler):
    """The largest weight is 1 % too large; independent draws hide a small bias best."""

    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        weights[np.argmax(weights)] *= 1.01
        return multinomial(rng, weights, n), None


def faulty(function):
    """A resampler class ``function(rng, log_weights, n) -> ancestors, log_weights``."""

    def select(self, rng, log_weights, n):
        found = function(rng, log_weights, n)
        return found if isinstance(found, tuple) else (found, None)

    return type(function.__name__, (WeightResampler,), {"select": select, "__doc__": function.__doc__})


# --- faults at some sizes ---


@faulty
def single_is_heaviest(rng, lw, n):
    return np.array([np.argmax(lw)]) if n == 1 else systematic(rng, normalise(lw), n)


@faulty
def thins_first(rng, lw, n):
    """From many particles to few, the lightest half is dropped first."""
    weights = normalise(lw)
    if len(lw) > 20 * n:
        weights[weights < np.median(weights)] = 0.0
    return multinomial(rng, weights, n)


@faulty
def odd_is_special(rng, lw, n):
    found = systematic(rng, normalise(lw), n)
    if n % 2 and n > 1:
        found[-1] = found[0]
    return found


@faulty
def more_than_there_are(rng, lw, n):
    """If n > m every particle is kept once, and the rest is drawn."""
    weights, m = normalise(lw), len(lw)
    if n <= m or (weights == 0).any():
        return systematic(rng, weights, n)
    return np.concatenate([np.arange(m), systematic(rng, weights, n - m)])


@faulty
def eight_bits(rng, lw, n):
    return systematic(rng, normalise(lw), n).astype(np.uint8).astype(int)


@faulty
def sixteen_bits(rng, lw, n):
    return systematic(rng, normalise(lw), n).astype(np.int16).astype(int)


@faulty
def block_of_256(rng, lw, n):
    """Particles from number 256 on are never selected."""
    return systematic(rng, normalise(lw)[:256], n)


@faulty
def last_is_forgotten(rng, lw, n):
    weights = normalise(lw)
    found = systematic(rng, weights, n)
    return np.where((found == len(lw) - 1) & (weights[0] > 0), 0, found) if n == len(lw) else found


# --- faults at some weights ---


@faulty
def at_most_half(rng, lw, n):
    return systematic(rng, np.minimum(normalise(lw), 0.5), n)


@faulty
def winner_takes_all(rng, lw, n):
    weights = normalise(lw)
    return np.full(n, np.argmax(weights)) if weights.max() > 0.9 else systematic(rng, weights, n)


@faulty
def heavy_gains(rng, lw, n):
    """A particle of more than 0.6 of the weight gets 5 % too much."""
    weights = normalise(lw)
    return multinomial(rng, np.where(weights > 0.6, 1.05, 1.0) * weights, n)


@faulty
def heaviest_of_many(rng, lw, n):
    """If there are more than twenty times as many as are selected, the light ones are left out."""
    w = normalise(lw)
    if len(w) > 20 * n:
        w = np.where(w >= np.sort(w)[-20 * n], w, 0.0)
    return systematic(rng, w / w.sum(), n)


@faulty
def floor_of_weights(rng, lw, n):
    weights = normalise(lw)
    return systematic(rng, np.where(weights > 0, np.maximum(weights, 0.02), 0), n)


@faulty
def dropped_by_absolute_weight(rng, lw, n):
    return systematic(rng, np.where(lw > -50, np.exp(lw), 0.0), n)


@faulty
def zero_is_small(rng, lw, n):
    return systematic(rng, normalise(np.nan_to_num(lw, neginf=-3.0)), n)


@faulty
def rounds_up(rng, lw, n):
    """Residual resampling that rounds instead of taking the floor."""
    copies = np.rint(n * normalise(lw)).astype(int)
    kept = np.repeat(np.arange(len(lw)), copies)
    return kept[:n] if len(kept) >= n else np.concatenate([kept, systematic(rng, normalise(lw), n - len(kept))])


@faulty
def offset_of_half(rng, lw, n):
    """The systematic offset lies in the first half of a stratum."""
    points = (np.arange(n) + 0.5 * rng.random()) / n
    weights = normalise(lw)
    return np.minimum(np.searchsorted(np.cumsum(weights), points, side="right"), np.flatnonzero(weights)[-1])


@faulty
def last_stratum(rng, lw, n):
    """Strata of width 1 / (n - 1)."""
    points = np.minimum((np.arange(n) + rng.random(n)) / max(n - 1, 1), 1 - 1e-12)
    weights = normalise(lw)
    return np.minimum(np.searchsorted(np.cumsum(weights), points, side="right"), np.flatnonzero(weights)[-1])


@faulty
def sharpens_many(rng, lw, n):
    """A power of the weights, if there are more than a hundred."""
    power = 1.1 if len(lw) > 100 else 1.0
    return systematic(rng, normalise(power * lw), n)


# --- random numbers and state ---


@faulty
def global_if_more(rng, lw, n):
    source = np.random if n > len(lw) else rng
    return systematic(source, normalise(lw), n)


@faulty
def python_generator(rng, lw, n):
    found = systematic(rng, normalise(lw), n)
    random.shuffle(found)
    return found


@faulty
def reseeds_the_global(rng, lw, n):
    np.random.seed(int(rng.integers(1000)))  # noqa: NPY002
    return systematic(rng, normalise(lw), n)


_OWN = np.random.default_rng(5)


@faulty
def module_generator(rng, lw, n):
    return systematic(_OWN, normalise(lw), n)


@faulty
def seeded_by_time(rng, lw, n):
    return systematic(np.random.default_rng(time.time_ns()), normalise(lw), n)


@faulty
def copies_the_generator(rng, lw, n):
    """Draws from a copy of the generator, which is not advanced."""
    return systematic(copy.deepcopy(rng), normalise(lw), n)


@dataclass(frozen=True)
class FirstCallCached(WeightResampler):
    """The weights of the first call are used for ever, if there are as many."""

    cache: dict = field(default_factory=dict)

    def select(self, rng, log_weights, n):
        weights = self.cache.setdefault(len(log_weights), normalise(log_weights))
        return systematic(rng, weights, n), None


@dataclass(frozen=True)
class ResultCached(FirstCallCached):
    """The result of a call of the same sizes is returned again."""

    def select(self, rng, log_weights, n):
        key = (len(log_weights), n)
        if key not in self.cache:
            self.cache[key] = systematic(rng, normalise(log_weights), n)
        return self.cache[key], None


_CACHE: dict = {}


@faulty
def module_cache(rng, lw, n):
    """Cached by the sizes, beside the class."""
    return systematic(rng, _CACHE.setdefault((len(lw), n), normalise(lw)), n)


@dataclass(frozen=True)
class EverySecondCall(FirstCallCached):
    def select(self, rng, log_weights, n):
        self.cache["calls"] = self.cache.get("calls", 0) + 1
        weights = normalise(log_weights if self.cache["calls"] % 2 else 0.5 * log_weights)
        return systematic(rng, weights, n), None


@faulty
def in_place_if_equal(rng, lw, n):
    if n == len(lw):
        lw -= lw.max()
    return systematic(rng, normalise(lw), n)


# --- output ---


@faulty
def sum_for_mean(rng, lw, n):
    return systematic(rng, normalise(lw), n), np.full(n, np.logaddexp.reduce(lw))


@faulty
def single_precision_output(rng, lw, n):
    return systematic(rng, normalise(lw), n), np.full(n, log_mean_exp(lw)).astype(np.float32)


@faulty
def weights_of_neighbours(rng, lw, n):
    """Even draws that carry the weight of another particle."""
    even = (lw > -np.inf) / 1.0
    ancestors = systematic(rng, even, n)
    return ancestors, lw[np.sort(ancestors)[::-1]] + np.log(even.mean())


@faulty
def as_floats(rng, lw, n):
    return systematic(rng, normalise(lw), n).astype(float)


@dataclass(frozen=True)
class StatesALargeBias(GreedyCalledProper):
    tolerance: ClassVar[float] = 0.9


@dataclass(frozen=True)
class NoDuplicates(WeightResampler):
    """Returns fewer than n without saying so."""

    def select(self, rng, log_weights, n):
        return np.unique(systematic(rng, normalise(log_weights), n)), None


@dataclass(frozen=True)
class MoreThanAsked(WeightResampler):
    exact_size: ClassVar[bool] = False

    def select(self, rng, log_weights, n):
        return systematic(rng, normalise(log_weights), n + 1), None


@dataclass(frozen=True)
class CallsItDrawless(WeightResampler):
    draws: ClassVar[bool] = False

    def select(self, rng, log_weights, n):
        return systematic(rng, normalise(log_weights), n), None


@dataclass(frozen=True)
class MixesRuns(WeightResampler):
    batched: ClassVar[bool] = True

    def select(self, rng, log_weights, n):
        if log_weights.ndim == 1:
            return systematic(rng, normalise(log_weights), n), None
        generators = rng.generators()
        return np.array([systematic(g, normalise(log_weights.mean(axis=0)), n) for g in generators]), None


@dataclass(frozen=True)
class LosesMates(Resampler):
    def resample(self, rng, population, n):
        ancestors = systematic(rng, population.weights, n)
        chosen = population.select(ancestors, np.full(n, population.log_mean_weight))
        return chosen.labelled({k: v for k, v in chosen.parents.items() if k != "mate"})


@dataclass(frozen=True)
class OldParents(Resampler):
    """The parents "previous" are those of the first n particles."""

    def resample(self, rng, population, n):
        ancestors = systematic(rng, population.weights, n)
        chosen = population.select(ancestors, np.full(n, population.log_mean_weight))
        previous = np.resize(population.parents.get("previous", np.arange(len(population))), n)
        return chosen.labelled({**chosen.parents, "previous": previous})


@dataclass(frozen=True)
class MovesSelected(Resampler):
    """Jitters what it selects."""

    def resample(self, rng, population, n):
        ancestors = systematic(rng, population.weights, n)
        chosen = population.select(ancestors, np.full(n, population.log_mean_weight))
        return chosen.moved(chosen.particles + 0.01 * rng.standard_normal(n))


@dataclass(frozen=True)
class SortsAncestors(Resampler):
    """The ancestors are sorted after the particles were taken."""

    def resample(self, rng, population, n):
        ancestors = rng.permutation(systematic(rng, population.weights, n))
        chosen = population.select(ancestors, np.full(n, population.log_mean_weight))
        return chosen.with_ancestors(np.sort(ancestors))


#: Fault -> a property that it breaks, and words that the message says.
FAULTS = {
    BiasedResidual: ("carried_weight", "copies are biased"),
    IgnoresN: ("gives_n_particles", "asked to make"),
    PicksZeroWeights: ("zero_weights_are_never_chosen", "weight 0"),
    ZeroAtTheEdge: ("handles_extreme_uniforms", 'side="right"'),
    RemainderFromWeights: ("carried_weight", "copies are biased"),
    FirstAlwaysStays: ("order_of_particles_is_irrelevant", "depends on the order"),
    GreedyCalledProper: ("carried_weight", "copies are biased"),
    GlobalGenerator: ("does_not_use_global_generators", "global generator"),
    OldWeightsKept: ("carried_weight", "output weights are wrong"),
    WeightsForgotten: ("carried_weight", "mean weight after selection"),
    OffByOne: ("ancestors_in_range", "is 5, expected 0 to 4"),
    OffByOneClipped: ("carried_weight", "off by one"),
    OrderMatters: ("order_of_particles_is_irrelevant", "depends on the order"),
    ChangesInput: ("does_not_change_input", "in place"),
    SinglePrecisionOverflow: ("scale_of_weights_is_irrelevant", "overflow"),
    SinglePrecisionSum: ("many_particles", "single precision"),
    SeedIgnored: ("depends_on_the_generator", "ignores `rng`"),
    OwnGenerator: ("repeats_with_the_same_generator", "does not come from `rng`"),
    KeepsAll: ("carried_weight", "n = m must be resampled"),
    Flattens: ("carried_weight", "flattened"),
    TiesToTheFirst: ("carried_weight", "equal weight go to the first"),
    MeanOfPositive: ("carried_weight", "positive weights only"),
    OnePosition: ("carried_weight", "positions always goes to particle"),
    DropsLight: ("carried_weight", "dropped"),
    Halves: ("carried_weight", "resampled apart"),
    OnePercent: ("largest_weight", "heaviest particle gets +"),
    ForgetsAncestors: ("ancestors_in_range", 'no parents "ancestor"'),
    single_is_heaviest: ("carried_weight", "5 particles to 1"),
    thins_first: ("carried_weight", "125 particles to 5"),
    odd_is_special: ("carried_weight", "copies are biased"),
    more_than_there_are: ("carried_weight", "copies are biased"),
    eight_bits: ("carried_weight", "300 particles to 300"),
    sixteen_bits: ("many_particles", "too few bits"),
    block_of_256: ("carried_weight", "300 particles to 300"),
    last_is_forgotten: ("carried_weight", "copies are biased"),
    at_most_half: ("carried_weight", "heaviest particle gets -11 %"),
    winner_takes_all: ("carried_weight", "particles to 3"),
    heavy_gains: ("carried_weight", "heaviest particle gets +"),
    heaviest_of_many: ("carried_weight", "100 particles to 2"),
    floor_of_weights: ("carried_weight", "copies are biased"),
    dropped_by_absolute_weight: ("scale_of_weights_is_irrelevant", "log weights"),
    zero_is_small: ("zero_weights_are_never_chosen", "weight 0"),
    rounds_up: ("carried_weight", "copies are biased"),
    offset_of_half: ("carried_weight", "copies are biased"),
    last_stratum: ("carried_weight", "copies are biased"),
    sharpens_many: ("carried_weight", "125 particles to 5"),
    global_if_more: ("does_not_use_global_generators", "numpy's global generator"),
    python_generator: ("does_not_use_global_generators", "Python's global generator"),
    reseeds_the_global: ("does_not_use_global_generators", "numpy's global generator"),
    module_generator: ("repeats_with_the_same_generator", "does not come from `rng`"),
    seeded_by_time: ("repeats_with_the_same_generator", "does not come from `rng`"),
    copies_the_generator: ("depends_on_the_generator", "does not advance"),
    FirstCallCached: ("keeps_no_state", "keeps state"),
    ResultCached: ("keeps_no_state", "keeps state"),
    module_cache: ("carried_weight", "copies are biased"),
    EverySecondCall: ("keeps_no_state", "keeps state"),
    in_place_if_equal: ("does_not_change_input", "in place"),
    sum_for_mean: ("carried_weight", "mean weight after selection"),
    single_precision_output: ("scale_of_weights_is_irrelevant", "does not add"),
    weights_of_neighbours: ("carried_weight", "output weights are wrong"),
    as_floats: ("ancestors_in_range", "float64, expected integers"),
    StatesALargeBias: ("states_a_small_tolerance", "tolerance is 0.9"),
    NoDuplicates: ("gives_n_particles", "asked to make"),
    MoreThanAsked: ("gives_n_particles", "asked to make"),
    CallsItDrawless: ("draws_only_if_declared", "draws = False"),
    MixesRuns: ("batched_runs_equal_single_runs", "are runs mixed"),
    LosesMates: ("keeps_parents", '"mate"'),
    OldParents: ("keeps_parents", '"previous"'),
    MovesSelected: ("keeps_parents", "not those of the ancestors"),
    SortsAncestors: ("keeps_parents", "not those of the ancestors"),
}
