"""Components of numbers with one fault each, at least one for every property of a contract, and correct ones.

`experiments/planted` has two hundred more, of kinds that are not here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from mstfilter import smc
from tests.mst.testing import Faults, of, plainly
from tests.smc.models import RHO, SD0, SIGMA, TAU, optimal, optimal_initial

FAULTS = Faults()
faulty, plant = FAULTS.faulty, FAULTS.plant

_VALID, _REPEATS, _SCALE = "result_is_valid", "depends_on_its_arguments_only", "scale_of_weights_is_irrelevant"
_INPUT, _ORDER = "does_not_change_input", "order_of_particles_is_irrelevant"
_EXACT, _SMALL = "distribution_is_exact", "small_populations_are_exact"


# --- resamplers ---------------------------------------------------------------------------------------------------
def selected(function, rng, log_weights, n):
    found = function(rng, log_weights, n)
    return found if isinstance(found, tuple) else (found, None)


#: A resampler of ``function(rng, log_weights, n)``, which returns ancestors, or also log weights.
selecting = of(smc.WeightResampler, select=selected)


def systematic(rng, weights, n):
    """A correct scheme, written as a user would."""
    points = (np.arange(n) + rng.random()) / n
    cumulative = np.cumsum(weights)
    last = np.flatnonzero(weights)[-1]
    return np.minimum(np.searchsorted(cumulative, points * cumulative[-1], side="right"), last)


def by_weight(rng, lw, n):
    return systematic(rng, smc.normalise(lw), n)


def multinomial(rng, weights, n):
    """Another correct scheme, with the largest variance."""
    return np.searchsorted(np.cumsum(weights)[:-1], rng.random(n) * weights.sum(), side="right")


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
def RareHeaps(rng, lw, n):
    """In a call of a thousand, all copies are of one particle drawn by weight."""
    weights = smc.normalise(lw)
    return np.repeat(multinomial(rng, weights, 1), n) if rng.random() < 0.001 else systematic(rng, weights, n)


@dataclass(frozen=True)
class RandomNumber(smc.WeightResampler):
    """Every position is filled with probability 0.9; the weight of the others is kept on average."""

    exact_size: ClassVar[bool] = False

    def select(self, rng, log_weights, n):
        filled = np.flatnonzero(rng.random(n) < 0.9)
        filled = filled if len(filled) else np.array([0])
        share = 0.9 + (0.1**n) / n  # expected number of filled positions / n
        ancestors = rng.permutation(multinomial(rng, smc.normalise(log_weights), n))[filled]
        return ancestors, np.full(len(filled), smc.log_mean_exp(log_weights) + np.log(len(filled) / n / share))


@selecting
def Alias(rng, lw, n):
    """Independent draws by Vose's alias method: which columns keep their particle depends on rounding."""
    m, share, alias = len(lw), len(lw) * smc.normalise(lw), np.arange(len(lw))
    small, large = list(np.flatnonzero(share < 1)), list(np.flatnonzero(share >= 1))
    while small and large:
        light, heavy = small.pop(), large.pop()
        alias[light] = heavy
        share[heavy] -= 1 - share[light]
        (small if share[heavy] < 1 else large).append(heavy)
    share[small + large] = 1.0
    column = rng.integers(m, size=n)
    return np.where(rng.random(n) < share[column], column, alias[column])


RESAMPLERS = (RareHeaps(), RandomNumber(), Alias())


@faulty("carried_weight", "copies are biased")
@selecting
def BiasedResidual(rng, lw, n):
    """The remainder is drawn from W - copies instead of n W - copies: light particles are selected too rarely."""
    W = smc.normalise(lw)
    copies = np.floor(n * W)
    rest = np.maximum(W - copies, 0) if (np.maximum(W - copies, 0) > 0).any() else W
    drawn = systematic(rng, rest, int(n - copies.sum())) if n > copies.sum() else np.array([], int)
    return np.concatenate([np.repeat(np.arange(len(W)), copies.astype(int)), drawn])


def rest_to_the_last(rng, lw, n):
    copies = np.floor(n * smc.normalise(lw)).astype(int)
    copies[-1] += n - copies.sum()
    return np.repeat(np.arange(len(lw)), copies)


def one_percent(rng, lw, n):
    """The largest weight is 1 % too large; independent draws hide it best."""
    W = smc.normalise(lw)
    return multinomial(rng, np.where(W.max() == W, 1.01, 1.0) * W, n)


def in_place_if_equal(rng, lw, n):
    if n == len(lw):
        lw -= lw.max()
    return by_weight(rng, lw, n)


plant(
    selecting,
    IgnoresN=(_VALID, "asked to make", lambda rng, lw, n: by_weight(rng, lw, len(lw))),
    PicksZeroWeights=("zero_weights_are_never_chosen", "weight 0", rest_to_the_last),
    OnePercent=("carried_weight", "copies are biased", one_percent),
    # Equal weights, but not those that keep the evidence.
    WeightsForgotten=(
        "carried_weight",
        "mean weight after selection",
        lambda rng, lw, n: (by_weight(rng, lw, n), np.full(n, -np.log(n))),
    ),
    # Cumulates in single precision: small weights are lost.
    SinglePrecisionSum=(
        "many_particles",
        "single precision",
        lambda rng, lw, n: systematic(rng, smc.normalise(lw).astype(np.float32), n),
    ),
    OwnGenerator=(_REPEATS, "come from `rng`", lambda rng, lw, n: by_weight(np.random.default_rng(), lw, n)),
    DroppedByAbsoluteWeight=(
        _SCALE,
        "log weights",
        lambda rng, lw, n: systematic(rng, np.where(lw > -50, np.exp(lw), 0.0), n),
    ),
    InPlaceIfEqual=(_INPUT, "in place", in_place_if_equal),
)
plant(
    of(smc.WeightResampler, {"draws": False}, select=selected),
    CallsItDrawless=(_REPEATS, "draws = False", lambda rng, lw, n: by_weight(rng, lw, n)),
)


@faulty(_REPEATS, "keeps state")
@dataclass(frozen=True)
class FirstCallCached(smc.WeightResampler):
    """The weights of the first call are used for ever, if there are as many."""

    cache: dict = field(default_factory=dict)

    def select(self, rng, log_weights, n):
        weights = self.cache.setdefault(len(log_weights), smc.normalise(log_weights))
        return systematic(rng, weights, n), None


def correctly_chosen(function, rng, population, n):
    ancestors = rng.permutation(systematic(rng, population.weights, n))
    return function(population.select(ancestors, np.full(n, population.log_mean_weight)))


plant(
    of(smc.Resampler, resample=correctly_chosen),
    LosesProposed=(
        "keeps_parents",
        '"proposed"',
        lambda chosen: chosen.labelled({k: v for k, v in chosen.parents.items() if k != "proposed"}),
    ),
)


@faulty("carried_weight_of_equal_particles", "of equal particles")
@dataclass(frozen=True)
class KeepsHeaviestOfEqual(smc.Resampler):
    """Merges equal particles and keeps the heaviest of them, which then carries the weight of all."""

    exact_size: ClassVar[bool] = False

    def resample(self, rng, population, n):
        x, weights = population.particles, population.weights
        names, classes = np.unique(x, return_inverse=True)
        kept = np.array([max(np.flatnonzero(classes == c), key=lambda i: weights[i]) for c in range(len(names))])
        mass = np.bincount(classes, weights)
        index = systematic(rng, mass / mass.sum(), n)
        return population.select(kept[index], np.full(n, population.log_mean_weight))


# --- exact draws --------------------------------------------------------------------------------------------------
def exact_ar1(rng, n):
    """x_{t-1}, draws of p(x_t | x_{t-1}, y_t), y_t."""
    previous = rng.normal(0.2, 1.0, n)
    return smc.Population(previous), smc.Population(optimal(previous, 0.7).sample(rng, n)), 0.7


def exact_walk(rng, n):
    """x_{t-1}, draws of x_t given them by the AR(1) model, y_t; the move does not use y_t."""
    previous = rng.normal(0.2, 1.0, n)
    return smc.Population(previous), smc.Population(rng.normal(RHO * previous, SIGMA)), 0.7


def exact_moves(rng, n):
    """x_{t-1}, draws of x_t given them, y_t, log p(y_t | x_t)."""
    return *exact_walk(rng, n), lambda x: smc.Normal(x, TAU).log_prob(0.7)


def exact_density(rng, n):
    previous = rng.standard_normal(n)
    return smc.Population(previous), smc.Population(rng.normal(previous, 1.0)), 0.5


def exact_posterior(rng, n):
    """Draws of p(x), of p(x | y), y."""
    prior, posterior = rng.normal(0.0, SD0, n), optimal_initial(0.7).sample(rng, n)
    return smc.Population(prior), smc.Population(posterior), 0.7


def exact_weights(rng, n):
    """Draws of p(x), the same with weights p(y | x), y."""
    prior = smc.Population(rng.normal(0.0, SD0, n))
    return prior, prior.reweighted(log_g(prior.particles, 0.7)), 0.7


def exact_evidence(rng, n):
    """Draws of p(x), of p(x | y), y, log p(y)."""
    return *exact_posterior(rng, n), float(smc.Normal(0.0, float(np.hypot(SD0, TAU))).log_prob(0.7))


def exact_prior(rng, n):
    """Draws of p(x_0), y."""
    return smc.Population(rng.normal(0.0, SD0, n)), 0.7


# --- transitions --------------------------------------------------------------------------------------------------
#: A transition that replaces the particles by ``function(rng, x, y)``.
move = of(
    smc.Transition,
    predict=lambda f, rng, population, observation: population.moved(f(rng, population.particles, observation)),
)


def walk(x, noise):
    return RHO * x + SIGMA * noise


def step(rng, x, size=1.0):
    """Moves by independent noise of a size."""
    return walk(x, size * rng.standard_normal(len(x)))


def in_blocks(rng, x, size):
    """One random number for every `size` particles."""
    return np.repeat(rng.standard_normal(-(-len(x) // size)), size)[: len(x)]


def of_few(rng, x, y):
    """The noise of n particles has the variance (n - 1) / n, which many particles do not show."""
    noise = rng.standard_normal(len(x))
    return walk(x, noise - noise.mean())


def first_is_special(rng, x, y):
    noise = rng.standard_normal(len(x))
    noise[0] *= 4
    return x + noise


def moves_in_place(rng, x, y):
    x += 1
    return x


plant(
    move,
    NeedsObservation=(_VALID, "observation=None", lambda rng, x, y: x + float(y)),
    Nan=(_VALID, "becomes nan", lambda rng, x, y: step(rng, x) * np.where(x > 0, 1, np.nan)),
    MovesInPlace=(_INPUT, "in place", moves_in_place),
    OwnSeed=(
        _REPEATS,
        "never uses its generator",
        lambda rng, x, y: x + np.random.default_rng(0).standard_normal(len(x)),
    ),
    WideStep=(_EXACT, "and sd", lambda rng, x, y: step(rng, x, 1.05), exact_walk),
    CutNoise=(_EXACT, "is below", lambda rng, x, y: walk(x, rng.standard_normal(len(x)).clip(-2.8, 2.8)), exact_walk),
    SharedByBlocks=(_EXACT, "of neighbours", lambda rng, x, y: walk(x, in_blocks(rng, x, 8)), exact_walk),
    OfFew=(_SMALL, "weighted distribution is wrong", of_few, exact_walk),
    MeanOfOthers=(
        "moves_do_not_depend_on_others",
        "mean or spread",
        lambda rng, x, y: 0.9 * x + 0.1 * x.mean() + rng.standard_normal(len(x)),
    ),
    FirstIsSpecial=(_ORDER, "moves differently", first_is_special),
    OneNoise=(_ORDER, "do not move independently", lambda rng, x, y: walk(x, rng.standard_normal())),
)
plant(
    of(smc.Transition, predict=plainly),
    NormalisesWeights=(
        _SCALE,
        "do not add it",
        lambda rng, population, y: replace(population, log_weights=np.log(population.weights)),
    ),
)


@dataclass(frozen=True)
class Guided(smc.Transition):
    """Draws from p(x_t | x_{t-1}, y_t) of the AR(1) model; the weights have a factor."""

    factor: float = 1.0
    size: float = 1.0

    def predict(self, rng, population, observation):
        x = population.particles
        if observation is None:
            return population.moved(step(rng, x, self.size))
        q = optimal(x, observation)
        new = q.sample(rng, len(x))
        change = smc.Normal(RHO * x, SIGMA).log_prob(new) - q.log_prob(new)
        return population.moved(new).reweighted(self.factor * change)


@faulty(_EXACT, "is below", exact_moves)
@dataclass(frozen=True)
class NoWeights(Guided):
    """Draws from the optimal proposal without weights."""

    factor: float = 0.0


@faulty("moves_without_observation_are_exact", "and sd", exact_moves)
@dataclass(frozen=True)
class WideWithoutObservation(Guided):
    size: float = 1.2


#: A random step of standard deviation 1 with the log density ``function(previous, new)``.
density = of(
    smc.DensityTransition,
    predict=lambda f, rng, population, y: population.moved(rng.normal(population.particles)),
    log_prob=lambda f, previous, new, y: f(previous, new),
)


@density
def CorrectDensity(previous, new):
    """The density without its constant factor."""
    return -0.5 * (new - previous) ** 2


plant(
    density,
    # The density of all moves together.
    OneDensity=("log_prob_is_of_each_move", "have shape ()", lambda x, new: -0.5 * np.sum((new - x) ** 2)),
    WiderDensity=(
        "log_prob_is_the_density_of_its_moves",
        "certain which is",
        lambda x, new: smc.Normal(x, 1.1).log_prob(new),
    ),
)


# --- updates ------------------------------------------------------------------------------------------------------
def log_g(x, y):
    return smc.Normal(x, TAU).log_prob(y)


def weighted(function, rng, predicted, proposed, observation):
    population = smc.union(predicted, proposed)
    return population.reweighted(function(population.particles, observation))


#: An update that adds ``function(x, y)`` to the log weights.
likelihood = of(smc.Update, update=weighted)
#: An update that weights by the likelihood and returns ``function(rng, weighted, predicted)``.
changed = of(
    smc.Update,
    update=lambda f, rng, predicted, proposed, observation: f(
        rng, weighted(log_g, rng, predicted, proposed, observation), predicted
    ),
)
_POSTERIOR = "weights_are_those_of_the_posterior"


@likelihood
def Posterior(x, y):
    return log_g(x, y)


@changed
def CorrectNoise(rng, out, predicted):
    """Random factors of mean 1."""
    return out.reweighted(np.log(rng.standard_exponential(len(out))))


plant(
    likelihood,
    TooWide=(_POSTERIOR, "is below", lambda x, y: smc.Normal(x, 1.1 * TAU).log_prob(y), exact_posterior),
    Twice=(_POSTERIOR, "constant factors", lambda x, y: log_g(x, y) + np.log(2), exact_evidence),
    TwiceByWeight=(_POSTERIOR, "constant factor", lambda x, y: log_g(x, y) + np.log(2), exact_weights),
    DividedByMean=(
        "weight_of_a_particle_does_not_depend_on_others",
        "not normalised or ranked",
        lambda x, y: log_g(x, y) - smc.log_mean_exp(log_g(x, y)),
    ),
    LaterRows=(_ORDER, "place in the array", lambda x, y: 0.1 * np.arange(len(x))),
    LogOfNegative=("weights_of_distant_particles_are_numbers", "nan", lambda x, y: np.log(9 - (x - y) ** 2)),
)
plant(
    of(smc.Update, update=plainly),
    NeedsPrediction=(
        _VALID,
        "proposed particles",
        lambda rng, predicted, proposed, observation: predicted.reweighted(np.zeros(len(predicted))),
    ),
)
plant(
    changed,
    PermutesUpdate=(
        "parents_belong_to_their_particles",
        "parent",
        lambda rng, out, predicted: smc.Population(out.particles[::-1], out.log_weights[::-1], out.parents),
    ),
)

# --- proposals and rejuvenations ----------------------------------------------------------------------------------
#: A proposal of ``function(rng, y, n)``: particles, or particles and log weights.
proposal = of(
    smc.Proposal,
    sample=lambda f, rng, y, n: (
        smc.Population(*found) if isinstance(found := f(rng, y, n), tuple) else smc.Population(found)
    ),
)


def weighed(rng, y, n, factor=1.0):
    q = smc.Normal(0.0, 1.2 * SD0)
    x = q.sample(rng, n)
    return x, smc.Normal(0.0, SD0).log_prob(x) - q.log_prob(x) + np.log(factor)


def antithetic(rng, y, n):
    """Less variance than independent draws, sorted."""
    half = rng.standard_normal(-(-n // 2))
    return SD0 * np.sort(rng.permutation(np.concatenate([half, -half]))[:n])


plant(
    proposal,
    OneTooFew=(_VALID, "asked for 2 particles it returns 1", lambda rng, y, n: rng.standard_normal(max(n - 1, 1))),
    FixedGrid=(_REPEATS, "never uses its generator", lambda rng, y, n: np.linspace(-2, 2, n)),
    Narrow=(_EXACT, "is below", lambda rng, y, n: 0.97 * SD0 * rng.standard_normal(n), exact_prior),
    WeightsOfMeanTwo=(_EXACT, "the mean weight is", lambda rng, y, n: weighed(rng, y, n, 2.0), exact_prior),
    Pairs=(
        "draws_vary_like_independent_ones",
        "times the variance",
        lambda rng, y, n: SD0 * in_blocks(rng, range(n), 2),
        exact_prior,
    ),
)


def moved_by(function, rng, population, previous, observation):
    if previous is None or observation is None:
        return population
    return population.moved(function(rng, population.particles, previous.particles, observation))


#: A rejuvenation ``function(rng, x, x_{t-1}, y)``; nothing moves if one of the last two is missing.
kernel = of(smc.Rejuvenation, move=moved_by)


def metropolis(rng, x, previous, y, temperature=1.0):
    """A Metropolis step for p(x_t | x_{t-1}, y_t), at a temperature."""

    def log_p(v):
        return (smc.Normal(RHO * previous, SIGMA).log_prob(v) + log_g(v, y)) / temperature

    new = x + 0.5 * rng.standard_normal(len(x))
    return np.where(np.log1p(-rng.random(len(x))) < log_p(new) - log_p(x), new, x)


plant(
    kernel,
    Hot=(
        _EXACT,
        "after five moves of exact draws",
        lambda rng, x, previous, y: metropolis(rng, x, previous, y, 1.1),
        exact_ar1,
    ),
    # Draws from p(x_t | y_t): the marginal is right, the joint distribution with x_{t-1} is wrong.
    ForgetsTheParent=(
        _EXACT,
        "coordinate 1 of (x_t, x_t - x_{t-1})",
        lambda rng, x, previous, y: optimal(rng.normal(0.2, 1.0, len(x)), y).sample(rng, len(x)),
        exact_ar1,
    ),
)
plant(
    of(smc.Rejuvenation, move=plainly),
    WeighsMoves=(
        _VALID,
        "changes log weights",
        lambda rng, p, previous, y: p.reweighted(rng.standard_normal(len(p))),
    ),
)

# --- triggers, sizes, similarities, equivalences, lookaheads, codecs ----------------------------------------------
plant(
    of(smc.Trigger, wants=plainly),
    AbsoluteWeight=(_SCALE, "change its answer", lambda p, t: p.log_weights.max() < 0),
    MaybeTrigger=(_VALID, "True or False", lambda p, t: p.ess),
    EntropyOfZero=(
        "weights_of_zero_count_like_tiny_ones",
        "is 0 log 0 NaN?",
        lambda p, t: bool(-(p.weights * np.log(p.weights)).sum() < 0.5 * np.log(len(p))),
    ),
)
plant(of(smc.Size, choose=plainly), HalfSize=(_VALID, "at least 1", lambda population: len(population) // 2))


def distances(particles):
    return np.abs(particles[:, None] - particles[None, :])


def cosine(x):
    rows = x.reshape(len(x), -1)
    length = np.linalg.norm(rows, axis=1)
    return np.abs(rows @ rows.T / np.outer(length, length)).clip(0, 1)


plant(
    of(smc.Similarity, matrix=plainly),
    Distance=(_VALID, "expected finite ones in [0, 1]", distances),
    RelativeSimilarity=(_ORDER, "if only these", lambda x: 1 - distances(x) / max(distances(x).max(), 1e-12)),
    Cosine=("works_for_vectors_anywhere", "if a particle is 0", cosine),
)
plant(
    of(smc.Equivalence, classes=plainly),
    CountsFromOne=(_VALID, "classes are", lambda particles: np.arange(1, len(particles) + 1)),
    AllDifferent=(_ORDER, "if there are copies", lambda particles: np.arange(len(particles))),
)
plant(
    of(smc.Lookahead, log_priority=plainly),
    LooksAtWeights=("ignores_weights", "change the priorities", lambda p, y: p.log_weights + p.particles),
    RulesOut=(_VALID, "-inf", lambda p, y: np.where(p.particles > 0.5, -np.inf, 0.0)),
)
#: A codec that stores ``{"x": function(particles)}`` and returns it as double precision.
encodes = of(
    smc.Codec,
    encode=lambda f, particles: {"x": f(particles)},
    decode=lambda f, arrays: arrays["x"].astype(np.float64),
)
plant(
    encodes,
    "decoded_particles_are_equal",
    SinglePrecision=("not the same", lambda particles: particles.astype(np.float32)),
    Pickles=("Python objects", lambda particles: np.array(list(particles), dtype=object)),
)

#: Correct components and their exact draws.
CORRECT = [
    (CorrectDensity(), exact_density),
    (Guided(), exact_moves),
    (Posterior(), exact_posterior),
    (Posterior(), exact_weights),
    (Posterior(), exact_evidence),
    (CorrectNoise(), exact_weights),
    *((proposal(draw)(), exact_prior) for draw in (weighed, antithetic)),
    (kernel(metropolis)(), exact_ar1),
]
