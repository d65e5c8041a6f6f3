"""Resamplers with one fault each, and correct ones.

`FAULTS` holds ``class: (a property that it breaks, words of the message)``.
"""

from __future__ import annotations

import copy
import random
import time
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from mstfilter.smc import Population, Resampler, WeightResampler, log_mean_exp, normalise

FAULTS: dict[type, tuple[str, str]] = {}


def selecting(function, **attributes):
    """A resampler class of ``function(rng, log_weights, n)``, which returns ancestors, or also log weights."""

    def select(self, rng, log_weights, n):
        found = function(rng, log_weights, n)
        return found if isinstance(found, tuple) else (found, None)

    body = {"select": select, "__doc__": function.__doc__, **attributes}
    return dataclass(frozen=True)(type(function.__name__, (WeightResampler,), body))


def faulty(broken, words, **attributes):
    """Add a class, or one of `selecting`, to the list."""

    def add(fault: Any) -> Any:
        cls = fault if isinstance(fault, type) else selecting(fault, **attributes)
        FAULTS[cls] = (broken, words)
        return cls

    return add


def add_faults(add, **functions):
    """Add the classes of functions whose messages have the same words."""
    for name, function in functions.items():
        function.__name__ = name
        add(function)


biased = faulty("carried_weight", "copies are biased")


def systematic(rng, weights, n):
    """A correct scheme, written as a user would."""
    points = (np.arange(n) + rng.random()) / n
    cumulative = np.cumsum(weights)
    last = np.flatnonzero(weights)[-1]
    return np.minimum(np.searchsorted(cumulative, points * cumulative[-1], side="right"), last)


def by_weight(rng, lw, n):
    return systematic(rng, normalise(lw), n)


def multinomial(rng, weights, n):
    """Another correct scheme, with the largest variance."""
    return np.searchsorted(np.cumsum(weights)[:-1], rng.random(n) * weights.sum(), side="right")


def weighing(broken, words, select=systematic, **changes):
    """Add schemes that select by changed weights, ``change(W, n)`` of the normalised ones."""

    def by(change):
        return lambda rng, lw, n: select(rng, change(normalise(lw), n), n)

    add_faults(faulty(broken, words), **{name: by(change) for name, change in changes.items()})


# --- correct schemes ----------------------------------------------------------------------------------------------


@selecting
def Correct(rng, lw, n):
    return by_weight(rng, lw, n)


@selecting
def CorrectWeighted(rng, lw, n):
    """Select evenly among the positive ones and keep the weights: proper, with unequal output weights."""
    even = (lw > -np.inf) / 1.0
    ancestors = systematic(rng, even, n)
    return ancestors, lw[ancestors] + np.log(even.mean())


@selecting
def Rejection(rng, lw, n):
    """Draws evenly and accepts with probability w / max w; the cost grows with max w / mean w."""
    weights = np.exp(lw - lw.max())
    ancestors, waiting = np.empty(n, int), np.arange(n)
    while len(waiting):
        ancestors[waiting] = rng.integers(len(weights), size=len(waiting))
        waiting = waiting[rng.random(len(waiting)) >= weights[ancestors[waiting]]]
    return ancestors


@dataclass(frozen=True)
class RareHeaps(WeightResampler):
    """In a call of a thousand, all copies are of one particle drawn by weight."""

    rate: float = 0.001

    def select(self, rng, log_weights, n):
        weights = normalise(log_weights)
        if rng.random() < self.rate:
            return np.repeat(multinomial(rng, weights, 1), n), None
        return systematic(rng, weights, n), None


@selecting
def RareBlocks(rng, lw, n):
    """In a call of 500, blocks of a third of the positions get one draw."""
    weights = normalise(lw)
    if rng.random() < 0.002 and n >= 3:
        return np.resize(np.repeat(multinomial(rng, weights, 3), -(-n // 3)), n)
    return multinomial(rng, weights, n)


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


@selecting
def SizeChanging(rng, lw, n):
    """Even draws that carry their weight: the total weight is kept on average only."""
    ancestors = rng.choice(np.flatnonzero(lw > -np.inf), n)
    return ancestors, lw[ancestors] + np.log((lw > -np.inf).mean())


CORRECT = (RareHeaps(), RareBlocks(), RandomNumber(), SizeChanging())

# --- wrong numbers of copies --------------------------------------------------------------------------------------


@biased
def BiasedResidual(rng, lw, n):
    """The remainder is drawn from W - copies instead of n W - copies: light particles are selected too rarely."""
    W = normalise(lw)
    copies = np.floor(n * W)
    rest = np.maximum(W - copies, 0) if (np.maximum(W - copies, 0) > 0).any() else W
    drawn = systematic(rng, rest, int(n - copies.sum())) if n > copies.sum() else np.array([], int)
    return np.concatenate([np.repeat(np.arange(len(W)), copies.astype(int)), drawn])


add_faults(
    faulty("gives_n_particles", "asked to make"),
    IgnoresN=lambda rng, lw, n: systematic(rng, normalise(lw), len(lw)),
    # Returns fewer than n without saying so.
    NoDuplicates=lambda rng, lw, n: np.unique(by_weight(rng, lw, n)),
)


@faulty("zero_weights_are_never_chosen", "weight 0")
def PicksZeroWeights(rng, lw, n):
    """Gives the remainder to the last particle, for any weight."""
    copies = np.floor(n * normalise(lw)).astype(int)
    copies[-1] += n - copies.sum()
    return np.repeat(np.arange(len(lw)), copies)


@faulty("zero_weights_are_never_chosen", "gives 0, of weights (0, 0, 1, 2, 3) it selects particle 0, weight 0")
def ZeroAtTheEdge(rng, lw, n):
    """Picks a leading weight of zero where the uniform is exactly 0."""
    points = (np.arange(n) + rng.random()) / n
    return np.searchsorted(np.cumsum(normalise(lw)), points, side="left")


@biased
def FirstAlwaysStays(rng, lw, n):
    """Always selects the first particle with weight."""
    drawn = systematic(rng, normalise(lw), max(n - 1, 1))
    return np.concatenate([[np.flatnonzero(lw > -np.inf)[0]], drawn])[:n]


@biased
def GreedyCalledProper(rng, lw, n):
    best = np.argsort(-lw)[: np.isfinite(lw).sum()]
    return best[np.arange(n) % len(best)]


# Counts particles from 1; and the same inside the range.
add_faults(faulty("gives_n_particles", "expected 0 to"), OffByOne=lambda rng, lw, n: by_weight(rng, lw, n) + 1)
add_faults(
    faulty("carried_weight", "off by one"),
    OffByOneClipped=lambda rng, lw, n: (by_weight(rng, lw, n) + 1) % len(lw),
)
add_faults(
    faulty("carried_weight", "n = m must be resampled"),
    KeepsAll=lambda rng, lw, n: np.arange(n) if n == len(lw) else by_weight(rng, lw, n),
)
add_faults(
    faulty("carried_weight", "5 particles to 1"),
    single_is_heaviest=lambda rng, lw, n: np.array([np.argmax(lw)]) if n == 1 else by_weight(rng, lw, n),
)
add_faults(
    faulty("many_particles", "too few bits"),
    sixteen_bits=lambda rng, lw, n: by_weight(rng, lw, n).astype(np.int16).astype(int),
)
add_faults(
    faulty("gives_n_particles", "float64, expected integers"),
    as_floats=lambda rng, lw, n: by_weight(rng, lw, n).astype(float),
)
add_faults(
    faulty("gives_n_particles", "asked to make", exact_size=False),
    MoreThanAsked=lambda rng, lw, n: by_weight(rng, lw, n + 1),
)
add_faults(
    faulty("repeats_with_the_same_generator", "draws = False", draws=False),
    CallsItDrawless=lambda rng, lw, n: by_weight(rng, lw, n),
)
add_faults(
    faulty("depends_on_the_generator", "ignores `rng`"),
    SeedIgnored=lambda rng, lw, n: by_weight(np.random.default_rng(0), lw, n),
)


@faulty("carried_weight", "equal weight go to the first")
def TiesToTheFirst(rng, lw, n):
    """Finds particles by their weight."""
    _, first, index = np.unique(lw, return_index=True, return_inverse=True)
    return first[index[by_weight(rng, lw, n)]]


@faulty("carried_weight", "positions always goes to particle")
def OnePosition(rng, lw, n):
    """The first position always goes to the heaviest particle, if n = m."""
    ancestors = by_weight(rng, lw, n)
    if n == len(lw) > 1:
        ancestors[0] = np.argmax(lw)
    return ancestors


@faulty("carried_weight", "resampled apart")
def Halves(rng, lw, n):
    """The halves of a population are resampled apart, if n = m is even."""
    weights, half = normalise(lw), n // 2
    if n != len(weights) or n % 2 or min(weights[:half].sum(), weights[half:].sum()) == 0:
        return systematic(rng, weights, n)
    return np.concatenate([systematic(rng, weights[:half], half), half + systematic(rng, weights[half:], half)])


# --- faults at some sizes -----------------------------------------------------------------------------------------


@biased
def odd_is_special(rng, lw, n):
    found = by_weight(rng, lw, n)
    if n % 2 and n > 1:
        found[-1] = found[0]
    return found


@biased
def more_than_there_are(rng, lw, n):
    """If n > m every particle is kept once, and the rest is drawn."""
    weights, m = normalise(lw), len(lw)
    if n <= m or (weights == 0).any():
        return systematic(rng, weights, n)
    return np.concatenate([np.arange(m), systematic(rng, weights, n - m)])


add_faults(
    faulty("carried_weight", "300 particles to 300"),
    eight_bits=lambda rng, lw, n: by_weight(rng, lw, n).astype(np.uint8).astype(int),
    # Particles from number 256 on are never selected.
    block_of_256=lambda rng, lw, n: systematic(rng, normalise(lw)[:256], n),
)


@biased
def last_is_forgotten(rng, lw, n):
    found = by_weight(rng, lw, n)
    return np.where((found == n - 1) & (lw[0] > -np.inf), 0, found) if n == len(lw) else found


# --- faults at some weights ---------------------------------------------------------------------------------------


@faulty("carried_weight", "particles to 3")
def winner_takes_all(rng, lw, n):
    weights = normalise(lw)
    return np.full(n, np.argmax(weights)) if weights.max() > 0.9 else systematic(rng, weights, n)


weighing("carried_weight", "heaviest particle gets -11 %", at_most_half=lambda W, n: np.minimum(W, 0.5))
weighing(
    "carried_weight", "copies are biased", floor_of_weights=lambda W, n: np.where(W > 0, np.maximum(W, 0.02), 0.0)
)
# Particles below a thousandth of the largest weight are dropped, if n = m.
weighing("carried_weight", "dropped", DropsLight=lambda W, n: W * ((1e-3 if n == len(W) else 0.0) * W.max() <= W))
# A power of the weights, if n = m, or if there are more than a hundred.
weighing("carried_weight", "flattened", Flattens=lambda W, n: W ** (0.9 if n == len(W) else 1.0))
weighing("carried_weight", "125 particles to 5", sharpens_many=lambda W, n: W ** (1.1 if len(W) > 100 else 1.0))
# If there are more than twenty times as many as are selected, the light ones are left out.
weighing(
    "carried_weight",
    "100 particles to 2",
    heaviest_of_many=lambda W, n: np.where(np.sort(W)[-20 * n] <= W, W, 0.0) if len(W) > 20 * n else W,
)
# Sorts by weight and forgets to sort back.
weighing(
    "carried_weight",
    "are the particles sorted, and not the ancestors?",
    OrderMatters=lambda W, n: np.sort(W)[::-1],
)
# Cumulates in single precision: small weights are lost.
weighing("many_particles", "single precision", SinglePrecisionSum=lambda W, n: W.astype(np.float32))
# Independent draws hide a small bias best: the largest weight is 1 % too large, or 5 % if it is above 0.6.
weighing(
    "largest_weight",
    "heaviest particle gets +",
    multinomial,
    OnePercent=lambda W, n: np.where(W.max() == W, 1.01, 1.0) * W,
)
weighing(
    "carried_weight",
    "heaviest particle gets +",
    multinomial,
    heavy_gains=lambda W, n: np.where(W > 0.6, 1.05, 1.0) * W,
)


@faulty("scale_of_weights_is_irrelevant", "log weights")
def dropped_by_absolute_weight(rng, lw, n):
    return systematic(rng, np.where(lw > -50, np.exp(lw), 0.0), n)


@faulty("scale_of_weights_is_irrelevant", "overflow")
def SinglePrecisionOverflow(rng, lw, n):
    """exp in single precision overflows at 88."""
    weights = np.exp(lw.astype(np.float32))
    return systematic(rng, weights / weights.sum(), n)


@biased
def rounds_up(rng, lw, n):
    """Residual resampling that rounds instead of taking the floor."""
    copies = np.rint(n * normalise(lw)).astype(int)
    kept = np.repeat(np.arange(len(lw)), copies)
    return kept[:n] if len(kept) >= n else np.concatenate([kept, systematic(rng, normalise(lw), n - len(kept))])


def selected_at(points, lw):
    """The particles at points of the cumulated weights."""
    weights = normalise(lw)
    return np.minimum(np.searchsorted(np.cumsum(weights), points, side="right"), np.flatnonzero(weights)[-1])


add_faults(
    biased,
    # The systematic offset lies in the first half of a stratum.
    offset_of_half=lambda rng, lw, n: selected_at((np.arange(n) + 0.5 * rng.random()) / n, lw),
    # Strata of width 1 / (n - 1).
    last_stratum=lambda rng, lw, n: selected_at(
        np.minimum((np.arange(n) + rng.random(n)) / max(n - 1, 1), 1 - 1e-12), lw
    ),
)


# --- random numbers and state -------------------------------------------------------------------------------------


@faulty("does_not_use_global_generators", "numpy's global generator")
def global_if_more(rng, lw, n):
    return by_weight(np.random if n > len(lw) else rng, lw, n)


@faulty("does_not_use_global_generators", "Python's global generator")
def python_generator(rng, lw, n):
    found = by_weight(rng, lw, n)
    random.shuffle(found)
    return found


_other_generator = faulty("repeats_with_the_same_generator", "does not come from `rng`")


add_faults(
    _other_generator,
    # A new generator of unknown seed at each call.
    OwnGenerator=lambda rng, lw, n: systematic(np.random.default_rng(), normalise(lw), n),
    module_generator=lambda rng, lw, n: systematic(_OWN, normalise(lw), n),
    seeded_by_time=lambda rng, lw, n: systematic(np.random.default_rng(time.time_ns()), normalise(lw), n),
)


_OWN = np.random.default_rng(5)


@faulty("depends_on_the_generator", "does not advance")
def copies_the_generator(rng, lw, n):
    """Draws from a copy of the generator, which is not advanced."""
    return systematic(copy.deepcopy(rng), normalise(lw), n)


@faulty("keeps_no_state", "keeps state")
@dataclass(frozen=True)
class FirstCallCached(WeightResampler):
    """The weights of the first call are used for ever, if there are as many."""

    cache: dict = field(default_factory=dict)

    def select(self, rng, log_weights, n):
        weights = self.cache.setdefault(len(log_weights), normalise(log_weights))
        return systematic(rng, weights, n), None


@faulty("keeps_no_state", "keeps state")
class EverySecondCall(FirstCallCached):
    def select(self, rng, log_weights, n):
        self.cache["calls"] = self.cache.get("calls", 0) + 1
        weights = normalise(log_weights if self.cache["calls"] % 2 else 0.5 * log_weights)
        return systematic(rng, weights, n), None


_CACHE: dict = {}


@biased
def module_cache(rng, lw, n):
    """Cached by the sizes, beside the class."""
    return systematic(rng, _CACHE.setdefault((len(lw), n), normalise(lw)), n)


@faulty("does_not_change_input", "in place")
def in_place_if_equal(rng, lw, n):
    if n == len(lw):
        lw -= lw.max()
    return by_weight(rng, lw, n)


# --- output -------------------------------------------------------------------------------------------------------


@faulty("carried_weight", "output weights are wrong")
def OldWeightsKept(rng, lw, n):
    """Selects by weight and keeps the weight, so the weight counts twice."""
    ancestors = by_weight(rng, lw, n)
    return ancestors, lw[ancestors]


add_faults(
    faulty("carried_weight", "mean weight after selection"),
    # Equal weights, but not those that keep the evidence.
    WeightsForgotten=lambda rng, lw, n: (by_weight(rng, lw, n), np.full(n, -np.log(n))),
    sum_for_mean=lambda rng, lw, n: (by_weight(rng, lw, n), np.full(n, np.logaddexp.reduce(lw))),
)


@faulty("carried_weight", "positive weights only")
def MeanOfPositive(rng, lw, n):
    """The evidence is the mean of the positive weights."""
    return by_weight(rng, lw, n), np.full(n, log_mean_exp(lw[lw > -np.inf]))


@faulty("scale_of_weights_is_irrelevant", "do not add it")
def single_precision_output(rng, lw, n):
    return by_weight(rng, lw, n), np.full(n, log_mean_exp(lw)).astype(np.float32)


@faulty("carried_weight", "output weights are wrong")
def weights_of_neighbours(rng, lw, n):
    """Even draws that carry the weight of another particle."""
    even = (lw > -np.inf) / 1.0
    ancestors = systematic(rng, even, n)
    return ancestors, lw[np.sort(ancestors)[::-1]] + np.log(even.mean())


@faulty("batched_runs_equal_single_runs", "are runs mixed", batched=True)
def MixesRuns(rng, lw, n):
    if lw.ndim == 1:
        return by_weight(rng, lw, n)
    return np.array([systematic(g, normalise(lw.mean(axis=0)), n) for g in rng.generators()]), None


# --- particles and parents ----------------------------------------------------------------------------------------


def changing(broken, words):
    """Add a resampler whose correct selection a function ``(chosen, population, rng, n)`` changes."""

    def add(function):
        def resample(self, rng, population, n):
            ancestors = rng.permutation(systematic(rng, population.weights, n))
            chosen = population.select(ancestors, np.full(n, population.log_mean_weight))
            return function(chosen, population, rng, n)

        cls = type(function.__name__, (Resampler,), {"resample": resample})
        FAULTS[cls] = (broken, words)

    return add


@changing("gives_n_particles", 'no parents "ancestor"')
def ForgetsAncestors(chosen, population, rng, n):
    return Population(chosen.particles, chosen.log_weights)


@changing("keeps_parents", '"mate"')
def LosesMates(chosen, population, rng, n):
    return chosen.labelled({k: v for k, v in chosen.parents.items() if k != "mate"})


@changing("keeps_parents", '"previous"')
def OldParents(chosen, population, rng, n):
    """The parents "previous" are those of the first n particles."""
    previous = np.resize(population.parents.get("previous", np.arange(len(population))), n)
    return chosen.labelled({**chosen.parents, "previous": previous})


@changing("keeps_parents", "not those of the ancestors")
def MovesSelected(chosen, population, rng, n):
    return chosen.moved(chosen.particles + 0.01 * rng.standard_normal(n))


@changing("keeps_parents", "not those of the ancestors")
def SortsAncestors(chosen, population, rng, n):
    """The ancestors are sorted after the particles were taken."""
    return chosen.with_ancestors(np.sort(chosen.parents["ancestor"]))
