"""Resamplers with one fault each, and correct ones."""

from __future__ import annotations

from dataclasses import dataclass

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


CORRECT = (Metropolis(), Chopthin(), MeansByOrder())


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
}
