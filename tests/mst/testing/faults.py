"""Resamplers with one fault each, and correct ones."""

from __future__ import annotations

import copy
import random
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.smc import Population, Resampler, WeightResampler, log_mean_exp, normalise
from tests.mst.testing import Faults, of

FAULTS = Faults()
faulty, plant = FAULTS.faulty, FAULTS.plant


def selected(function, rng, log_weights, n):
    found = function(rng, log_weights, n)
    return found if isinstance(found, tuple) else (found, None)


#: A resampler of ``function(rng, log_weights, n)``, which returns ancestors, or also log weights.
selecting = of(WeightResampler, select=selected)


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


@selecting
def ZeroAtTheEdge(rng, lw, n):
    """Picks a leading weight of zero where the uniform number is exactly 0, and none where it rounds to the end."""
    return np.searchsorted(np.cumsum(normalise(lw)), (np.arange(n) + rng.random()) / n)


def alias_table(weights):
    """Vose's alias method: which columns keep their particle depends on rounding."""
    m, share, alias = len(weights), len(weights) * weights, np.arange(len(weights))
    small, large = list(np.flatnonzero(share < 1)), list(np.flatnonzero(share >= 1))
    while small and large:
        light, heavy = small.pop(), large.pop()
        alias[light] = heavy
        share[heavy] -= 1 - share[light]
        (small if share[heavy] < 1 else large).append(heavy)
    share[small + large] = 1.0
    return m, share, alias


@selecting
def Alias(rng, lw, n):
    """Independent draws by the alias method."""
    m, share, alias = alias_table(normalise(lw))
    column = rng.integers(m, size=n)
    return np.where(rng.random(n) < share[column], column, alias[column])


CORRECT = (RareHeaps(), RareBlocks(), RandomNumber(), SizeChanging(), Alias(), ZeroAtTheEdge())

_CARRIED, _VALID, _ZERO = "carried_weight", "result_is_valid", "zero_weights_are_never_chosen"
_SCALE, _PARENTS = "scale_of_weights_is_irrelevant", "keeps_parents"


# --- wrong numbers of copies --------------------------------------------------------------------------------------
def biased_residual(rng, lw, n):
    """The remainder is drawn from W - copies instead of n W - copies: light particles are selected too rarely."""
    W = normalise(lw)
    copies = np.floor(n * W)
    rest = np.maximum(W - copies, 0) if (np.maximum(W - copies, 0) > 0).any() else W
    drawn = systematic(rng, rest, int(n - copies.sum())) if n > copies.sum() else np.array([], int)
    return np.concatenate([np.repeat(np.arange(len(W)), copies.astype(int)), drawn])


def rest_to_the_last(rng, lw, n):
    copies = np.floor(n * normalise(lw)).astype(int)
    copies[-1] += n - copies.sum()
    return np.repeat(np.arange(len(lw)), copies)


def first_always_stays(rng, lw, n):
    drawn = systematic(rng, normalise(lw), max(n - 1, 1))
    return np.concatenate([[np.flatnonzero(lw > -np.inf)[0]], drawn])[:n]


def ties_to_the_first(rng, lw, n):
    """Finds particles by their weight."""
    _, first, index = np.unique(lw, return_index=True, return_inverse=True)
    return first[index[by_weight(rng, lw, n)]]


def one_position(rng, lw, n):
    """The first position always goes to the heaviest particle, if n = m."""
    ancestors = by_weight(rng, lw, n)
    if n == len(lw) > 1:
        ancestors[0] = np.argmax(lw)
    return ancestors


def halves(rng, lw, n):
    """The halves of a population are resampled apart, if n = m is even."""
    weights, half = normalise(lw), n // 2
    if n != len(weights) or n % 2 or min(weights[:half].sum(), weights[half:].sum()) == 0:
        return systematic(rng, weights, n)
    return np.concatenate([systematic(rng, weights[:half], half), half + systematic(rng, weights[half:], half)])


def odd_is_special(rng, lw, n):
    found = by_weight(rng, lw, n)
    if n % 2 and n > 1:
        found[-1] = found[0]
    return found


def more_than_there_are(rng, lw, n):
    """If n > m every particle is kept once, and the rest is drawn."""
    weights, m = normalise(lw), len(lw)
    if n <= m or (weights == 0).any():
        return systematic(rng, weights, n)
    return np.concatenate([np.arange(m), systematic(rng, weights, n - m)])


def winner_takes_all(rng, lw, n):
    weights = normalise(lw)
    return np.full(n, np.argmax(weights)) if weights.max() > 0.9 else systematic(rng, weights, n)


_CACHE: dict = {}


def module_cache(rng, lw, n):
    """Cached by the sizes, beside the class."""
    return systematic(rng, _CACHE.setdefault((len(lw), n), normalise(lw)), n)


plant(
    selecting,
    IgnoresN=(_VALID, "asked to make", lambda rng, lw, n: by_weight(rng, lw, len(lw))),
    NoDuplicates=(_VALID, "asked to make", lambda rng, lw, n: np.unique(by_weight(rng, lw, n))),
    PicksZeroWeights=(_ZERO, "weight 0", rest_to_the_last),
    # Counts particles from 1.
    OffByOne=(_VALID, "expected 0 to", lambda rng, lw, n: by_weight(rng, lw, n) + 1),
    AsFloats=(_VALID, "float64, expected integers", lambda rng, lw, n: by_weight(rng, lw, n).astype(float)),
)
plant(
    selecting,
    _CARRIED,
    "copies are biased",
    BiasedResidual=biased_residual,
    FirstAlwaysStays=first_always_stays,
    # Counts particles from 1, inside the range.
    OffByOneClipped=lambda rng, lw, n: (by_weight(rng, lw, n) + 1) % len(lw),
    KeepsAll=lambda rng, lw, n: np.arange(n) if n == len(lw) else by_weight(rng, lw, n),
    TiesToTheFirst=ties_to_the_first,
    OnePosition=one_position,
    Halves=halves,
    OddIsSpecial=odd_is_special,
    MoreThanThereAre=more_than_there_are,
    ModuleCache=module_cache,
    SeedIgnored=lambda rng, lw, n: by_weight(np.random.default_rng(0), lw, n),
    CopiesTheGenerator=lambda rng, lw, n: by_weight(copy.deepcopy(rng), lw, n),
    # Selects by weight and keeps the weight, so the weight counts twice.
    OldWeightsKept=lambda rng, lw, n: (ancestors := by_weight(rng, lw, n), lw[ancestors]),
    EightBits=lambda rng, lw, n: by_weight(rng, lw, n).astype(np.uint8).astype(int),
    WinnerTakesAll=winner_takes_all,
    SingleIsHeaviest=lambda rng, lw, n: np.array([np.argmax(lw)]) if n == 1 else by_weight(rng, lw, n),
)
plant(
    selecting,
    "many_particles",
    SixteenBits=("expected 0 to 100000", lambda rng, lw, n: by_weight(rng, lw, n).astype(np.int16).astype(int)),
)
plant(
    of(WeightResampler, {"exact_size": False}, select=selected),
    MoreThanAsked=(_VALID, "asked to make", lambda rng, lw, n: by_weight(rng, lw, n + 1)),
)
#: Schemes that select by changed weights, ``function(W, n)`` of the normalised ones.
weighing = of(WeightResampler, select=lambda f, rng, lw, n: (systematic(rng, f(normalise(lw), n), n), None))
plant(
    weighing,
    _CARRIED,
    "copies are biased",
    AtMostHalf=lambda W, n: np.minimum(W, 0.5),
    FloorOfWeights=lambda W, n: np.where(W > 0, np.maximum(W, 0.02), 0.0),
    # Particles below a thousandth of the largest weight are dropped, if n = m.
    DropsLight=lambda W, n: W * ((1e-3 if n == len(W) else 0.0) * W.max() <= W),
    # A power of the weights, if n = m, or if there are more than a hundred.
    Flattens=lambda W, n: W ** (0.9 if n == len(W) else 1.0),
    SharpensMany=lambda W, n: W ** (1.1 if len(W) > 100 else 1.0),
    # If there are more than twenty times as many as are selected, the light ones are left out.
    HeaviestOfMany=lambda W, n: np.where(np.sort(W)[-20 * n] <= W, W, 0.0) if len(W) > 20 * n else W,
    # Sorts by weight and forgets to sort back.
    OrderMatters=lambda W, n: np.sort(W)[::-1],
)
# Cumulates in single precision: small weights are lost.
plant(weighing, "many_particles", SinglePrecisionSum=("single precision", lambda W, n: W.astype(np.float32)))
# Independent draws hide a small bias best: the largest weight is 1 % too large, or 5 % if it is above 0.6.
plant(
    of(WeightResampler, select=lambda f, rng, lw, n: (multinomial(rng, f(normalise(lw)), n), None)),
    _CARRIED,
    "copies are biased",
    OnePercent=lambda W: np.where(W.max() == W, 1.01, 1.0) * W,
    HeavyGains=lambda W: np.where(W > 0.6, 1.05, 1.0) * W,
)


# --- scale, generators and state ----------------------------------------------------------------------------------
def dropped_by_absolute_weight(rng, lw, n):
    return systematic(rng, np.where(lw > -50, np.exp(lw), 0.0), n)


def single_precision_overflow(rng, lw, n):
    """exp in single precision overflows at 88."""
    weights = np.exp(lw.astype(np.float32))
    return systematic(rng, weights / weights.sum(), n)


def python_generator(rng, lw, n):
    found = by_weight(rng, lw, n)
    random.shuffle(found)
    return found


def in_place_if_equal(rng, lw, n):
    if n == len(lw):
        lw -= lw.max()
    return by_weight(rng, lw, n)


_OWN = np.random.default_rng(5)
_REPEATS = "depends_on_its_arguments_only"
plant(
    selecting,
    _REPEATS,
    "come from `rng`",
    GlobalIfMore=lambda rng, lw, n: multinomial(np.random if n > len(lw) else rng, normalise(lw), n),
    PythonGenerator=python_generator,
    OwnGenerator=lambda rng, lw, n: by_weight(np.random.default_rng(), lw, n),
    ModuleGenerator=lambda rng, lw, n: by_weight(_OWN, lw, n),
)
plant(
    selecting,
    DroppedByAbsoluteWeight=(_SCALE, "log weights", dropped_by_absolute_weight),
    SinglePrecisionOverflow=(_SCALE, "overflow", single_precision_overflow),
    SinglePrecisionOutput=(
        _SCALE,
        "do not add it",
        lambda rng, lw, n: (by_weight(rng, lw, n), np.full(n, log_mean_exp(lw)).astype(np.float32)),
    ),
    InPlaceIfEqual=("does_not_change_input", "in place", in_place_if_equal),
)
plant(
    of(WeightResampler, {"draws": False}, select=selected),
    CallsItDrawless=(_REPEATS, "draws = False", lambda rng, lw, n: by_weight(rng, lw, n)),
)


@faulty(_REPEATS, "keeps state")
@dataclass(frozen=True)
class FirstCallCached(WeightResampler):
    """The weights of the first call are used for ever, if there are as many."""

    cache: dict = field(default_factory=dict)

    def select(self, rng, log_weights, n):
        weights = self.cache.setdefault(len(log_weights), normalise(log_weights))
        return systematic(rng, weights, n), None


# --- output, particles and parents --------------------------------------------------------------------------------
plant(
    selecting,
    _CARRIED,
    # Equal weights, but not those that keep the evidence.
    WeightsForgotten=(
        "mean weight after selection",
        lambda rng, lw, n: (by_weight(rng, lw, n), np.full(n, -np.log(n))),
    ),
    # The evidence is the mean of the positive weights.
    MeanOfPositive=(
        "by the number of all particles",
        lambda rng, lw, n: (by_weight(rng, lw, n), np.full(n, log_mean_exp(lw[lw > -np.inf]))),
    ),
)


def correctly_chosen(function, rng, population, n):
    ancestors = rng.permutation(systematic(rng, population.weights, n))
    return function(population.select(ancestors, np.full(n, population.log_mean_weight)), rng)


def without_proposed(chosen, rng):
    return chosen.labelled({k: v for k, v in chosen.parents.items() if k != "proposed"})


#: Resamplers whose correct selection ``function(chosen, rng)`` changes.
plant(
    of(Resampler, resample=correctly_chosen),
    ForgetsAncestors=(
        _VALID,
        'no parents "ancestor"',
        lambda chosen, rng: Population(chosen.particles, chosen.log_weights),
    ),
    LosesProposed=(_PARENTS, '"proposed"', without_proposed),
    MovesSelected=(
        _PARENTS,
        "not those of the ancestors",
        lambda chosen, rng: chosen.moved(chosen.particles + 0.01 * rng.standard_normal(len(chosen))),
    ),
    # The ancestors are sorted after the particles were taken.
    SortsAncestors=(
        _PARENTS,
        "not those of the ancestors",
        lambda chosen, rng: chosen.with_ancestors(np.sort(chosen.parents["ancestor"])),
    ),
)


@FAULTS.faulty("carried_weight_of_equal_particles", "of equal particles")
@dataclass(frozen=True)
class KeepsHeaviestOfEqual(Resampler):
    """Merges equal particles and keeps the heaviest of them, which then carries the weight of all."""

    exact_size: ClassVar[bool] = False

    def resample(self, rng, population, n):
        x, weights = population.particles, population.weights
        names, classes = np.unique(x, return_inverse=True)
        kept = np.array([max(np.flatnonzero(classes == c), key=lambda i: weights[i]) for c in range(len(names))])
        mass = np.bincount(classes, weights)
        index = systematic(rng, mass / mass.sum(), n)
        return population.select(kept[index], np.full(n, population.log_mean_weight))


BiasedResidual = next(fault for fault, *_ in FAULTS if fault.__name__ == "BiasedResidual")
