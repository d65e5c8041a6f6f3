"""Components other than resamplers with one fault each, and correct ones."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mstfilter.scene import Evidence
from mstfilter.smc import (
    Codec,
    DensityTransition,
    Equivalence,
    Lookahead,
    Normal,
    Population,
    Proposal,
    Rejuvenation,
    Similarity,
    Size,
    Transition,
    Trigger,
    Update,
    log_mean_exp,
    union,
)
from tests.mst.testing import Faults, of, plainly
from tests.smc.models import RHO, SD0, SIGMA, TAU, optimal, optimal_initial

FAULTS = Faults()
faulty, plant = FAULTS.faulty, FAULTS.plant

# --- components of functions --------------------------------------------------------------------------------------
#: A transition that replaces the particles by ``function(rng, x, y)``.
move = of(
    Transition,
    predict=lambda f, rng, population, observation: population.moved(f(rng, population.particles, observation)),
)
predict = of(Transition, predict=plainly)


def weighted(function, rng, predicted, proposed, observation):
    population = union(predicted, proposed)
    return population.reweighted(function(population.particles, observation))


#: An update that adds ``function(x, y)`` to the log weights.
likelihood = of(Update, update=weighted)
update = of(Update, update=plainly)
#: A proposal of ``function(rng, y, n)``: particles, or particles and log weights.
proposal = of(
    Proposal,
    sample=lambda f, rng, y, n: Population(*found) if isinstance(found := f(rng, y, n), tuple) else Population(found),
)


def moved_by(function, rng, population, previous, observation):
    if previous is None or observation is None:
        return population
    return population.moved(function(rng, population.particles, previous.particles, observation))


#: A rejuvenation ``function(rng, x, x_{t-1}, y)``; nothing moves if one of the last two is missing.
kernel = of(Rejuvenation, move=moved_by)
rejuvenation = of(Rejuvenation, move=plainly)


# --- exact draws --------------------------------------------------------------------------------------------------


def exact_ar1(rng, n):
    """x_{t-1}, draws of p(x_t | x_{t-1}, y_t), y_t."""
    previous = rng.normal(0.2, 1.0, n)
    return Population(previous), Population(optimal(previous, 0.7).sample(rng, n)), 0.7


def exact_walk(rng, n, shape=()):
    """x_{t-1}, draws of x_t given them by the AR(1) model, y_t; the move does not use y_t."""
    previous = rng.normal(0.2, 1.0, (n, *shape))
    return Population(previous), Population(rng.normal(RHO * previous, SIGMA)), 0.7


def exact_moves(rng, n):
    """x_{t-1}, draws of x_t given them, y_t, log p(y_t | x_t)."""
    return *exact_walk(rng, n), lambda x: Normal(x, TAU).log_prob(0.7)


def exact_plane(rng, n):
    """x_{t-1} in the plane, draws of x_t given them, y_t."""
    return exact_walk(rng, n, (2,))


def exact_density(rng, n):
    previous = rng.standard_normal(n)
    return Population(previous), Population(rng.normal(previous, 1.0)), 0.5


def exact_posterior(rng, n):
    """Draws of p(x), of p(x | y), y."""
    prior, posterior = rng.normal(0.0, SD0, n), optimal_initial(0.7).sample(rng, n)
    return Population(prior), Population(posterior), 0.7


def exact_weights(rng, n):
    """Draws of p(x), the same with weights p(y | x), y."""
    prior = Population(rng.normal(0.0, SD0, n))
    return prior, prior.reweighted(log_g(prior.particles, 0.7)), 0.7


def exact_evidence(rng, n):
    """Draws of p(x), of p(x | y), y, log p(y)."""
    return *exact_posterior(rng, n), float(Normal(0.0, float(np.hypot(SD0, TAU))).log_prob(0.7))


def exact_prior(rng, n):
    """Draws of p(x_0), y."""
    return Population(rng.normal(0.0, SD0, n)), 0.7


def exact_prior_in_plane(rng, n):
    """Draws of p(x_0) in the plane, y."""
    return Population(rng.normal(0.0, SD0, (n, 2))), 0.7


# --- transitions --------------------------------------------------------------------------------------------------
_MOVES = "weighted_moves_are_those_of_the_model"
_ORDER = "order_of_particles_is_irrelevant"
_VALID = "result_is_valid"


def walk(x, noise):
    return RHO * x + SIGMA * noise


def step(rng, x, size=1.0):
    """Moves by independent noise of a size."""
    return walk(x, size * rng.standard_normal(len(x)))


def in_blocks(rng, x, size):
    """One random number for every `size` particles."""
    return np.repeat(rng.standard_normal(-(-len(x) // size)), size)[: len(x)]


def first_is_special(rng, x, y):
    noise = rng.standard_normal(len(x))
    noise[0] *= 4
    return x + noise


def mirrored(rng, x, y):
    """Antithetic pairs of the first and the last particle, if there are many."""
    noise = rng.standard_normal(len(x))
    if len(x) > 100:
        noise[len(x) // 2 :] = -noise[: len(x) - len(x) // 2][::-1]
    return walk(x, noise)


def after_a_thousand(rng, x, y):
    """Wider steps from the thousandth particle on."""
    noise = rng.standard_normal(len(x))
    noise[1000:] = noise[1000:] * 1.1
    return walk(x, noise)


def shared_by_axes(rng, x, y):
    noise = rng.standard_normal(len(x))
    return walk(x, noise if x.ndim == 1 else noise[:, None])


plant(
    move,
    NeedsObservation=(_VALID, "observation=None", lambda rng, x, y: x + float(y)),
    FirstIsSpecial=(_ORDER, "moves differently", first_is_special),
    OneNoise=(_ORDER, "do not move independently", lambda rng, x, y: walk(x, rng.standard_normal())),
    OneNoiseOfMany=(_MOVES, "is below", lambda rng, x, y: walk(x, rng.standard_normal()), exact_moves),
    # Returns the moved particles in another order, without their weights.
    Permutes=(
        _MOVES,
        "coordinate 1 of (x_t, x_t - x_{t-1})",
        lambda rng, x, y: rng.permutation(step(rng, x)),
        exact_moves,
    ),
    SharedByAxes=(_MOVES, "coordinate 0 of (x_t, x_t - x_{t-1}) + coordinate 1 of", shared_by_axes, exact_plane),
    SharedByPairs=(_ORDER, "do not move independently", lambda rng, x, y: walk(x, in_blocks(rng, x, 2))),
    Mirrored=(_MOVES, "mirrored positions", mirrored, exact_walk),
    SharedByBlocks=(_MOVES, "of neighbours", lambda rng, x, y: walk(x, in_blocks(rng, x, 8)), exact_walk),
    WideStep=(_MOVES, "and sd", lambda rng, x, y: step(rng, x, 1.05), exact_walk),
    UniformNoise=(_MOVES, "is below", lambda rng, x, y: walk(x, rng.uniform(-(3**0.5), 3**0.5, len(x))), exact_walk),
    CutNoise=(_MOVES, "is below", lambda rng, x, y: walk(x, rng.standard_normal(len(x)).clip(-2.8, 2.8)), exact_walk),
    SmallDrift=(_MOVES, "is below", lambda rng, x, y: step(rng, x) + 0.02, exact_walk),
    AfterAThousand=(_MOVES, "is below", after_a_thousand, exact_walk),
)


def noisy_if_heavy(rng, population, observation):
    """The steps of heavy particles are larger; on average they have the right spread if the weights are equal."""
    noise = np.sqrt(len(population) * population.weights) * rng.standard_normal(len(population))
    return population.moved(walk(population.particles, noise))


def permuted(rng, population, observation):
    """The moved particles with their weights in another order."""
    order = rng.permutation(len(population))
    return Population(step(rng, population.particles)[order], population.log_weights[order])


plant(
    predict,
    DropsParticles=(
        _VALID,
        'parents "previous"',
        lambda rng, population, y: population.take(np.arange(len(population) // 2 + 1), None).labelled({}),
    ),
    NormalisesWeights=(
        "scale_of_weights_is_irrelevant",
        "do not add it",
        lambda rng, population, y: replace(population, log_weights=np.log(population.weights)),
    ),
    PermutesAll=(_VALID, "another order", permuted),
    NoisyIfHeavy=(_MOVES, "is below", noisy_if_heavy, exact_walk),
)


@faulty("does_not_change_input", "in place")
class MovesInPlace(Transition):
    def predict(self, rng, population, observation):
        population.particles.setflags(write=True) if population.particles.flags.owndata else None
        particles = population.particles
        particles += 1
        return Population(particles, population.log_weights)


@dataclass(frozen=True)
class Guided(Transition):
    """Draws from p(x_t | x_{t-1}, y_t) of the AR(1) model; the weights have a sign."""

    sign: float = 1.0

    def predict(self, rng, population, observation):
        x = population.particles
        if observation is None:
            return population.moved(Normal(RHO * x, SIGMA).sample(rng, len(x)))
        q = optimal(x, observation)
        new = q.sample(rng, len(x))
        change = Normal(RHO * x, SIGMA).log_prob(new) - q.log_prob(new)
        return population.moved(new).reweighted(self.sign * change)


@faulty(_MOVES, "is below", exact_moves)
@dataclass(frozen=True)
class WrongSign(Guided):
    sign: float = -1.0


@faulty(_MOVES, "is below", exact_moves)
@dataclass(frozen=True)
class NoWeights(Guided):
    """Draws from the optimal proposal without weights."""

    sign: float = 0.0


@faulty(_MOVES, "and sd", exact_moves)
class WideWithoutObservation(Guided):
    """A guided move whose steps are too wide without an observation."""

    def predict(self, rng, population, observation):
        if observation is not None:
            return super().predict(rng, population, observation)
        return population.moved(step(rng, population.particles, 1.2))


# --- densities of transitions -------------------------------------------------------------------------------------
_DENSITY = "log_prob_is_the_density_of_its_moves"
#: A random step of standard deviation 1 with the log density ``function(previous, new)``.
density = of(
    DensityTransition,
    predict=lambda f, rng, population, y: population.moved(rng.normal(population.particles)),
    log_prob=lambda f, previous, new, y: f(previous, new),
)


@density
def CorrectDensity(previous, new):
    """The density without its constant factor."""
    return -0.5 * (new - previous) ** 2


def normalised(previous, new):
    log_f = -0.5 * (new - previous) ** 2
    return log_f - np.logaddexp.reduce(log_f)


plant(
    density,
    # The density of all moves together.
    OneDensity=("log_prob_is_of_each_move", "have shape ()", lambda x, new: -0.5 * np.sum((new - x) ** 2)),
    NormalisedDensity=("log_prob_is_of_each_move", "three of six", normalised),
    WiderDensity=(_DENSITY, "certain which is", lambda x, new: Normal(x, 1.1).log_prob(new)),
    DensityOfAnotherMove=(_DENSITY, "certain which is", lambda x, new: Normal(RHO * x, 1.0).log_prob(new)),
)


# --- updates ------------------------------------------------------------------------------------------------------
_POSTERIOR = "weights_are_those_of_the_posterior"
_OTHERS = "weight_of_a_particle_does_not_depend_on_others"


def log_g(x, y):
    return Normal(x, TAU).log_prob(y)


@likelihood
def Posterior(x, y):
    return log_g(x, y)


plant(
    likelihood,
    Squared=(_POSTERIOR, "is below", lambda x, y: 2 * log_g(x, y), exact_posterior),
    CutTails=(
        _POSTERIOR,
        "is below",
        lambda x, y: np.where(np.abs(x - y) > 2.5 * TAU, -700.0, log_g(x, y)),
        exact_posterior,
    ),
    FlatTails=(_POSTERIOR, "is below", lambda x, y: np.maximum(log_g(x, y), -3.0), exact_posterior),
    Tempered=(_POSTERIOR, "is below", lambda x, y: 0.95 * log_g(x, y), exact_posterior),
    Shifted=(_POSTERIOR, "is below", lambda x, y: log_g(x + 0.02, y), exact_posterior),
    Cauchy=(_POSTERIOR, "is below", lambda x, y: -np.log1p(((x - y) / TAU) ** 2), exact_posterior),
    TooWide=(_POSTERIOR, "is below", lambda x, y: Normal(x, 1.1 * TAU).log_prob(y), exact_posterior),
    TooWideByWeight=(_POSTERIOR, "of a particle is", lambda x, y: Normal(x, 1.1 * TAU).log_prob(y), exact_weights),
    Twice=(_POSTERIOR, "constant factors", lambda x, y: log_g(x, y) + np.log(2), exact_evidence),
    TwiceByWeight=(_POSTERIOR, "constant factor", lambda x, y: log_g(x, y) + np.log(2), exact_weights),
    DividedByMean=(_OTHERS, "not normalised or ranked", lambda x, y: log_g(x, y) - log_mean_exp(log_g(x, y))),
    Ranks=(_OTHERS, "not normalised or ranked", lambda x, y: np.log1p(np.argsort(np.argsort(log_g(x, y))))),
)


def strange_parents(rng, predicted, proposed, observation):
    population = predicted if predicted is not None else proposed
    return replace(population, parents={"proposed": np.full(len(population), 99)})


plant(
    update,
    _VALID,
    NeedsPrediction=(
        "proposed particles",
        lambda rng, predicted, proposed, observation: predicted.reweighted(np.zeros(len(predicted))),
    ),
    StrangeParents=("99", strange_parents),
)
#: An update that weights by the likelihood and returns ``function(rng, weighted, predicted)``.
changed = of(
    Update,
    update=lambda f, rng, predicted, proposed, observation: f(
        rng, weighted(log_g, rng, predicted, proposed, observation), predicted
    ),
)


def forgets_old_weights(rng, out, predicted):
    return out if predicted is None or len(out) > len(predicted) else out.reweighted(-predicted.log_weights)


plant(
    changed,
    PermutesUpdate=(
        "parents_belong_to_their_particles",
        "parent",
        lambda rng, out, predicted: Population(out.particles[::-1], out.log_weights[::-1], out.parents),
    ),
    ForgetsOldWeights=("scale_of_weights_is_irrelevant", "do not add it", forgets_old_weights),
    # Random factors of mean 1 would be correct; these have mean exp(0.02).
    NoisyWeights=(
        _POSTERIOR,
        "constant factors",
        lambda rng, out, predicted: out.reweighted(0.2 * rng.standard_normal(len(out))),
        exact_evidence,
    ),
)


@changed
def CorrectNoise(rng, out, predicted):
    """Random factors of mean 1."""
    return out.reweighted(np.log(rng.standard_exponential(len(out))))


# --- proposals ----------------------------------------------------------------------------------------------------
_DRAWN = "draws_have_their_distribution"


def inverted_weights(rng, y, n):
    x = 1.5 * SD0 * rng.standard_normal(n)
    return x, Normal(0.0, 1.5 * SD0).log_prob(x) - Normal(0.0, SD0).log_prob(x)


def weighed(rng, y, n, factor=1.0):
    q = Normal(0.0, 1.2 * SD0)
    x = q.sample(rng, n)
    return x, Normal(0.0, SD0).log_prob(x) - q.log_prob(x) + np.log(factor)


def antithetic(rng, y, n):
    """Less variance than independent draws, sorted."""
    half = rng.standard_normal(-(-n // 2))
    return SD0 * np.sort(rng.permutation(np.concatenate([half, -half]))[:n])


plant(
    proposal,
    OneTooFew=(_VALID, "asked for 2 particles it returns 1", lambda rng, y, n: rng.standard_normal(max(n - 1, 1))),
    OneNumberForTwoAxes=(
        _DRAWN,
        "coordinate 0 of x +",
        lambda rng, y, n: SD0 * np.broadcast_to(rng.standard_normal((n, 1)), (n, 2)),
        exact_prior_in_plane,
    ),
    InvertedWeights=(_DRAWN, "is below", inverted_weights, exact_prior),
    Narrow=(_DRAWN, "is below", lambda rng, y, n: 0.97 * SD0 * rng.standard_normal(n), exact_prior),
    OffCentre=(_DRAWN, "is below", lambda rng, y, n: 0.05 + SD0 * rng.standard_normal(n), exact_prior),
    OneDraw=(_DRAWN, "is below", lambda rng, y, n: np.full(n, SD0 * rng.standard_normal()), exact_prior),
    CutDraws=(_DRAWN, "is below", lambda rng, y, n: SD0 * rng.standard_normal(n).clip(-2.9, 2.9), exact_prior),
    Unweighted=(_DRAWN, "is below", lambda rng, y, n: optimal_initial(y).sample(rng, n), exact_prior),
    Pairs=(
        "draws_vary_like_independent_ones",
        "times the variance",
        lambda rng, y, n: SD0 * in_blocks(rng, range(n), 2),
        exact_prior,
    ),
    WeightsOfMeanTwo=(_DRAWN, "the mean weight is", lambda rng, y, n: weighed(rng, y, n, 2.0), exact_prior),
)
correct_draws, correct_weighed, correct_antithetic = map(
    proposal, (lambda rng, y, n: SD0 * rng.standard_normal(n), weighed, antithetic)
)

# --- rejuvenations ------------------------------------------------------------------------------------------------
_KEPT = "keeps_the_distribution"


def _metropolis(rng, x, previous, y, shift=0.0, temperature=1.0):
    """A Metropolis step for p(x_t | x_{t-1}, y_t), at a temperature; one with a shift is not symmetric."""

    def log_p(v):
        return (Normal(RHO * previous, SIGMA).log_prob(v) + log_g(v, y)) / temperature

    new = x + 0.5 * rng.standard_normal(len(x)) + shift
    return np.where(np.log1p(-rng.random(len(x))) < log_p(new) - log_p(x), new, x)


def pairs_of_steps(rng, x, previous, y):
    p = optimal(previous, y)
    return np.asarray(p.mean) + float(np.asarray(p.scale).flat[0]) * in_blocks(rng, x, 2)


@kernel
def nothing(rng, x, previous, y):
    return x


@kernel
def gibbs(rng, x, previous, y):
    return optimal(previous, y).sample(rng, len(x))


correct_kernel = kernel(_metropolis)
plant(
    kernel,
    _KEPT,
    Hot=("no longer exact", lambda rng, x, previous, y: _metropolis(rng, x, previous, y, temperature=1.1)),
    Asymmetric=("no longer exact", lambda rng, x, previous, y: _metropolis(rng, x, previous, y, 0.1)),
    ForgetsTheObservation=("no longer exact", lambda rng, x, previous, y: step(rng, previous)),
    SwapsNeighbours=("no longer exact", lambda rng, x, previous, y: rng.permutation(x)),
    PairsOfSteps=("of neighbours", pairs_of_steps),
    # Draws from p(x_t | y_t): the marginal is right, the joint distribution with x_{t-1} is wrong.
    ForgetsTheParent=(
        "coordinate 1 of (x_t, x_t - x_{t-1})",
        lambda rng, x, previous, y: optimal(rng.normal(0.2, 1.0, len(x)), y).sample(rng, len(x)),
    ),
)
plant(
    rejuvenation,
    _VALID,
    WeighsMoves=("changes log weights", lambda rng, p, previous, y: p.reweighted(rng.standard_normal(len(p)))),
    NeedsAPast=("previous=None", lambda rng, p, previous, y: p.moved(p.particles + 0 * previous.particles)),
    LosesOne=("6 particles became 5", lambda rng, p, previous, y: p.take(np.arange(max(1, len(p) - 1)))),
)


# --- triggers, sizes, similarities, equivalences, lookaheads, evidence --------------------------------------------
def distances(particles):
    return np.abs(particles[:, None] - particles[None, :])


plant(
    of(Trigger, wants=plainly),
    AbsoluteWeight=("scale_of_weights_is_irrelevant", "change its answer", lambda p, t: p.log_weights.max() < 0),
    MaybeTrigger=(_VALID, "True or False", lambda p, t: p.ess),
)
plant(of(Size, choose=plainly), HalfSize=(_VALID, "at least 1", lambda population: len(population) // 2))
plant(
    of(Similarity, matrix=plainly),
    Distance=(_VALID, "expected finite ones in [0, 1]", distances),
    RelativeSimilarity=(_ORDER, "if only these", lambda x: 1 - distances(x) / max(distances(x).max(), 1e-12)),
    OneSided=(_VALID, "similarity of particles", lambda x: np.tril(np.ones((len(x), len(x))))),
)
plant(
    of(Equivalence, classes=plainly),
    CountsFromOne=(_VALID, "classes are", lambda particles: np.arange(1, len(particles) + 1)),
    AllDifferent=(_ORDER, "if there are copies", lambda particles: np.arange(len(particles))),
)
plant(
    of(Lookahead, log_priority=plainly),
    LooksAtWeights=("ignores_weights", "change the priorities", lambda p, y: p.log_weights + p.particles),
    RulesOut=(_VALID, "-inf", lambda p, y: np.where(p.particles > 0.5, -np.inf, 0.0)),
    OneForAll=(_VALID, "shape (1,)", lambda p, y: np.zeros(1)),
    ByPlace=(_ORDER, "in another order", lambda p, y: 0.1 * np.arange(len(p))),
)


def by_identity(hypotheses, clip):
    """Compares hypotheses by identity, not by content."""
    born = {id(h.objects): k for k, h in reversed(list(enumerate(hypotheses)))}
    return np.array([float(born[id(h.objects)]) for h in hypotheses])


plant(
    of(Evidence, log_score=plainly),
    "copies_score_the_same",
    HighNamesWin=("other numbers", lambda hypotheses, clip: np.array([float(h.labels.max()) for h in hypotheses])),
    ByIdentity=("its copy", by_identity),
)

# --- codecs -------------------------------------------------------------------------------------------------------
_DECODED = "decoded_particles_are_equal"
#: A codec that stores ``{"x": function(particles)}`` and returns it as double precision.
encodes = of(
    Codec, encode=lambda f, particles: {"x": f(particles)}, decode=lambda f, arrays: arrays["x"].astype(np.float64)
)
plant(
    encodes,
    _DECODED,
    SinglePrecision=("not the same", lambda particles: particles.astype(np.float32)),
    Sorts=("not the same", lambda particles: np.sort(particles)),
    Pickles=("Python objects", lambda particles: np.array(list(particles), dtype=object)),
    Lists=("a list as", lambda particles: particles.tolist()),
)


@faulty(_DECODED, "list index out of range")
@dataclass(frozen=True)
class Keeps(Codec):
    """Decodes what it has stored in itself, which a new process has not."""

    kept: list = field(default_factory=list)

    def encode(self, particles):
        self.kept.append(particles)
        return {"x": np.zeros(1)}

    def decode(self, arrays):
        return self.kept[-1]


#: Correct components and their exact draws.
CORRECT = [
    (CorrectDensity(), exact_density),
    (Guided(), exact_moves),
    (Posterior(), exact_posterior),
    (Posterior(), exact_weights),
    (Posterior(), exact_evidence),
    (correct_draws(), exact_prior),
    (correct_weighed(), exact_prior),
    (correct_antithetic(), exact_prior),
    *((component(), exact_ar1) for component in (correct_kernel, gibbs, nothing)),
]
#: Updates whose weights are random.
CORRECT_RANDOM = [(CorrectNoise(), exact_weights), (CorrectNoise(), exact_evidence)]
