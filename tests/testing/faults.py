"""Resamplers with one fault each, and two correct ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.smc import WeightResampler, log_mean_exp, normalise


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
}
