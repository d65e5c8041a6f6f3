"""Components other than resamplers with one fault each, and correct ones.

`FAULTS` is a list of (class, a property that it breaks, words of the message, a function that draws exactly or None).
"""

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
from tests.smc.models import RHO, SD0, SIGMA, TAU, optimal, optimal_initial

FAULTS: list = []


def faulty(broken, words, exact=None, make=lambda cls: cls):
    """Add a class to the list; of a function, the class that `make` gives. The broken property comes first."""

    def add(fault):
        cls = fault if isinstance(fault, type) else make(fault)
        FAULTS.append((cls, broken, words, exact))
        return cls

    return add


def add_faults(broken, words, exact, make, **functions):
    """Add classes of functions whose messages have the same words."""
    for name, function in functions.items():
        function.__name__ = name
        faulty(broken, words, exact, make)(function)


def of(interface, method):
    """A class of an interface whose method is a function without ``self``."""

    def make(function):
        called = {method: lambda self, *args, **named: function(*args, **named), "__doc__": function.__doc__}
        return type(function.__name__, (interface,), called)

    return make


def add_methods(interface, method, **faults):
    """Add components whose method is a function: ``name=(broken property, words, function)``."""
    for name, (broken, words, function) in faults.items():
        add_faults(broken, words, None, of(interface, method), **{name: function})


def move(function):
    """A transition that replaces the particles by ``function(rng, x, y)``."""

    def predict(self, rng, population, observation):
        return population.moved(function(rng, population.particles, observation))

    return type(function.__name__, (Transition,), {"predict": predict, "__doc__": function.__doc__})


def likelihood(function):
    """An update that adds ``function(x, y)`` to the log weights."""

    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.reweighted(function(population.particles, observation))

    return type(function.__name__, (Update,), {"update": update, "__doc__": function.__doc__})


def proposal(function):
    """A proposal of ``function(rng, y, n)``: particles, or particles and log weights."""

    def sample(self, rng, observation, n):
        found = function(rng, observation, n)
        return Population(*found) if isinstance(found, tuple) else Population(found)

    return type(function.__name__, (Proposal,), {"sample": sample, "__doc__": function.__doc__})


def kernel(function):
    """A rejuvenation ``function(rng, x, x_{t-1}, y)``; nothing moves if one of the last two is missing."""

    def move(self, rng, population, previous, observation):
        if previous is None or observation is None:
            return population
        return population.moved(function(rng, population.particles, previous.particles, observation))

    return type(function.__name__, (Rejuvenation,), {"move": move, "__doc__": function.__doc__})


# --- exact draws --------------------------------------------------------------------------------------------------


def exact_ar1(rng, n):
    """x_{t-1}, draws of p(x_t | x_{t-1}, y_t), y_t."""
    previous = rng.normal(0.2, 1.0, n)
    return Population(previous), Population(optimal(previous, 0.7).sample(rng, n)), 0.7


def exact_walk(rng, n):
    """x_{t-1}, draws of x_t given them by the AR(1) model, y_t; the move does not use y_t."""
    previous = rng.normal(0.2, 1.0, n)
    return Population(previous), Population(rng.normal(RHO * previous, SIGMA)), 0.7


def exact_moves(rng, n):
    """x_{t-1}, draws of x_t given them, y_t, log p(y_t | x_t)."""
    return *exact_walk(rng, n), lambda x: Normal(x, TAU).log_prob(0.7)


def exact_plane(rng, n):
    """x_{t-1} in the plane, draws of x_t given them, y_t."""
    previous = rng.normal(0.2, 1.0, (n, 2))
    return Population(previous), Population(rng.normal(RHO * previous, SIGMA)), 0.7


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
    return prior, prior.reweighted(Normal(prior.particles, TAU).log_prob(0.7)), 0.7


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


def walk(x, noise):
    return RHO * x + SIGMA * noise


@faulty("parents_are_valid", 'parents "previous"', None, of(Transition, "predict"))
def DropsParticles(rng, population, observation):
    return population.take(np.arange(len(population) // 2 + 1), None).labelled({})


@faulty("parents_are_valid", "observation=None", None, move)
def NeedsObservation(rng, x, y):
    return x + float(y)


@faulty("does_not_change_input", "in place")
class MovesInPlace(Transition):
    def predict(self, rng, population, observation):
        population.particles.setflags(write=True) if population.particles.flags.owndata else None
        particles = population.particles
        particles += 1
        return Population(particles, population.log_weights)


@faulty(_ORDER, "moves differently", None, move)
def FirstIsSpecial(rng, x, y):
    step = rng.standard_normal(len(x))
    step[0] *= 4
    return x + step


@faulty("scale_of_weights_is_irrelevant", "log weights + 50", None, of(Transition, "predict"))
def NormalisesWeights(rng, population, observation):
    return replace(population, log_weights=np.log(population.weights))


@faulty("does_not_use_global_generators", "global generator", None, move)
def GlobalMove(rng, x, y):
    return x + np.random.randn()  # noqa: NPY002


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


@faulty(_MOVES, "opposite sign", exact_moves)
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
        return population.moved(Normal(RHO * population.particles, 1.2 * SIGMA).sample(rng, len(population)))


@faulty(_MOVES, "is below", exact_moves)
@faulty(_ORDER, "the same noise", None, move)
def OneNoise(rng, x, y):
    return walk(x, rng.standard_normal())


@faulty(_MOVES, "x_t - x_{t-1}", exact_moves, move)
def Permutes(rng, x, y):
    """Returns the moved particles in another order, without their weights."""
    return rng.permutation(walk(x, rng.standard_normal(len(x))))


@faulty("weights_stay_with_their_particles", "another order", None, of(Transition, "predict"))
def PermutesAll(rng, population, observation):
    """Returns the moved particles with their weights in another order."""
    order = rng.permutation(len(population))
    return Population(
        walk(population.particles, rng.standard_normal(len(order)))[order], population.log_weights[order]
    )


@faulty(_MOVES, "coordinate 0 of x_t + coordinate 1 of x_t", exact_plane, move)
def shared_by_axes(rng, x, y):
    noise = rng.standard_normal(len(x))
    return walk(x, noise if x.ndim == 1 else noise[:, None])


@faulty(_ORDER, "if the weights are others", None, of(Transition, "predict"))
def NoisyIfHeavy(rng, population, observation):
    """The steps of heavy particles are larger; on average they have the right spread if the weights are equal."""
    noise = np.sqrt(len(population) * population.weights) * rng.standard_normal(len(population))
    return population.moved(walk(population.particles, noise))


@faulty(_ORDER, "do not move independently", None, move)
def shared_by_pairs(rng, x, y):
    return walk(x, np.repeat(rng.standard_normal(-(-len(x) // 2)), 2)[: len(x)])


@faulty(_ORDER, "do not move independently", None, move)
def antithetic_halves(rng, x, y):
    noise = rng.standard_normal(-(-len(x) // 2))
    return walk(x, np.concatenate([noise, -noise])[: len(x)])


@faulty(_MOVES, "mirrored positions", exact_walk, move)
def mirrored(rng, x, y):
    """Antithetic pairs of the first and the last particle, if there are many."""
    noise = rng.standard_normal(len(x))
    if len(x) > 100:
        noise[len(x) // 2 :] = -noise[: len(x) - len(x) // 2][::-1]
    return walk(x, noise)


@faulty(_MOVES, "of neighbours", exact_walk, move)
def shared_by_blocks(rng, x, y):
    """One random number for every eight particles."""
    return walk(x, np.repeat(rng.standard_normal(-(-len(x) // 8)), 8)[: len(x)])


def step(rng, x, size=1.0):
    """Moves by independent noise of a size."""
    return walk(x, size * rng.standard_normal(len(x)))


add_faults(_ORDER, "alone (n = 1)", None, move, still_alone=lambda rng, x, y: step(rng, x, float(len(x) > 1)))
add_faults(
    _ORDER,
    "observation=None",
    None,
    move,
    still_without_observation=lambda rng, x, y: x if y is None else step(rng, x),
)
add_faults(_MOVES, "and sd", exact_walk, move, wide_step=lambda rng, x, y: step(rng, x, 1.05))
add_faults(
    _MOVES,
    "is below",
    exact_walk,
    move,
    uniform_noise=lambda rng, x, y: walk(x, rng.uniform(-np.sqrt(3), np.sqrt(3), len(x))),
    cut_noise=lambda rng, x, y: walk(x, np.clip(rng.standard_normal(len(x)), -2.8, 2.8)),
    small_drift=lambda rng, x, y: step(rng, x) + 0.02,
)


@faulty(_MOVES, "is below", exact_walk, move)
def after_a_thousand(rng, x, y):
    """Wider steps from the thousandth particle on."""
    noise = rng.standard_normal(len(x))
    noise[1000:] = noise[1000:] * 1.1
    return walk(x, noise)


# --- densities of transitions -------------------------------------------------------------------------------------
_DENSITY = "log_prob_is_the_density_of_its_moves"


def density(function, sd=1.0):
    """A random step of standard deviation `sd` with the log density ``function(previous, new)``."""

    def predict(self, rng, population, observation):
        return population.moved(population.particles + sd * rng.standard_normal(len(population)))

    def log_prob(self, previous, new, observation):
        return function(previous, new)

    return type(function.__name__, (DensityTransition,), {"predict": predict, "log_prob": log_prob})


@density
def CorrectDensity(previous, new):
    """The density without its constant factor."""
    return -0.5 * (new - previous) ** 2


@faulty("log_prob_is_of_each_move", "have shape ()", None, density)
def OneDensity(previous, new):
    """The density of all moves together."""
    return -0.5 * np.sum((new - previous) ** 2)


@faulty("log_prob_is_of_each_move", "three of six", None, density)
def NormalisedDensity(previous, new):
    log_f = -0.5 * (new - previous) ** 2
    return log_f - np.logaddexp.reduce(log_f)


add_faults(
    _DENSITY,
    "certain which is",
    None,
    density,
    WiderDensity=lambda previous, new: Normal(previous, 1.1).log_prob(new),
    DensityOfAnotherMove=lambda previous, new: Normal(RHO * previous, 1.0).log_prob(new),
)


@faulty(_DENSITY, "too certain", None, lambda function: density(function, SIGMA))
def VarianceForSd(previous, new):
    return Normal(previous, SIGMA**2).log_prob(new)


# --- updates ------------------------------------------------------------------------------------------------------
_POSTERIOR = "weights_are_those_of_the_posterior"
_OTHERS = "weight_of_a_particle_does_not_depend_on_others"


@faulty("takes_any_of_its_inputs", "proposed particles", None, of(Update, "update"))
def NeedsPrediction(rng, predicted, proposed, observation):
    return predicted.reweighted(np.zeros(len(predicted)))


@faulty("takes_any_of_its_inputs", "99", None, of(Update, "update"))
def StrangeParents(rng, predicted, proposed, observation):
    population = predicted if predicted is not None else proposed
    return replace(population, parents={"proposed": np.full(len(population), 99)})


@likelihood
def Posterior(x, y):
    return Normal(x, TAU).log_prob(y)


add_faults(
    _POSTERIOR,
    "is below",
    exact_posterior,
    likelihood,
    Squared=lambda x, y: 2 * Normal(x, TAU).log_prob(y),
    cut_tails=lambda x, y: np.where(np.abs(x - y) > 2.5 * TAU, -700.0, Normal(x, TAU).log_prob(y)),
    flat_tails=lambda x, y: np.maximum(Normal(x, TAU).log_prob(y), -3.0),
    tempered=lambda x, y: 0.95 * Normal(x, TAU).log_prob(y),
    shifted=lambda x, y: Normal(x + 0.02, TAU).log_prob(y),
    # Bounded at 3 nats below the best particle.
    bounded_relative=lambda x, y: np.maximum(Normal(x, TAU).log_prob(y), Normal(x, TAU).log_prob(y).max() - 3),
    cauchy=lambda x, y: -np.log1p(((x - y) / TAU) ** 2) - np.log(np.pi * TAU),
)


@faulty(_POSTERIOR, "is below", exact_posterior)
@faulty(_POSTERIOR, "the log weight of a particle is", exact_weights, likelihood)
def too_wide(x, y):
    return Normal(x, 1.1 * TAU).log_prob(y)


@faulty(_POSTERIOR, "2 times the exact ones", exact_weights)
@faulty(_POSTERIOR, "constant factors", exact_evidence, likelihood)
def twice(x, y):
    return Normal(x, TAU).log_prob(y) + np.log(2)


@faulty(_POSTERIOR, "constant factors", exact_weights, likelihood)
def without_constant(x, y):
    return -0.5 * ((x - y) / TAU) ** 2


def log_g(x, y):
    return Normal(x, TAU).log_prob(y)


add_faults(
    _OTHERS,
    "not normalised or ranked",
    None,
    likelihood,
    divided_by_mean=lambda x, y: log_g(x, y) - log_mean_exp(log_g(x, y)),
    divided_by_largest=lambda x, y: log_g(x, y) - log_g(x, y).max(),
    ranks=lambda x, y: np.log1p(np.argsort(np.argsort(log_g(x, y)))),
)


def changed(function):
    """An update that weights by the likelihood and returns ``function(rng, weighted, predicted)``."""

    def update(self, rng, predicted, proposed, observation):
        return function(rng, Posterior().update(rng, predicted, proposed, observation), predicted)

    return type(function.__name__, (Update,), {"update": update, "__doc__": function.__doc__})


@faulty("parents_belong_to_their_particles", "parent", None, changed)
def PermutesUpdate(rng, out, predicted):
    return Population(out.particles[::-1], out.log_weights[::-1], out.parents)


@faulty("scale_of_weights_is_irrelevant", "log weights + 50", None, changed)
def ForgetsOldWeights(rng, out, predicted):
    return out if predicted is None or len(out) > len(predicted) else out.reweighted(-predicted.log_weights)


@faulty(_POSTERIOR, "constant factors", exact_evidence, changed)
def NoisyWeights(rng, out, predicted):
    """Random factors of mean 1 would be correct; these have mean exp(0.02)."""
    return out.reweighted(0.2 * rng.standard_normal(len(out)))


@changed
def CorrectNoise(rng, out, predicted):
    """Random factors of mean 1."""
    return out.reweighted(np.log(rng.standard_exponential(len(out))))


@changed
def CorrectSelection(rng, out, predicted):
    """Resamples what it weighted."""
    return out.select(rng.choice(len(out), len(out), p=out.weights), np.full(len(out), out.log_mean_weight))


def thinned(rng, out):
    """Drops light particles at random; the others carry their weight. Also the share of those that are kept."""
    p = np.minimum(1.0, 2 * len(out) * out.weights)
    kept = np.flatnonzero(rng.random(len(out)) < p)
    return out.select(kept, out.log_weights[kept] - np.log(p[kept])), len(kept) / len(out)


@changed
def CorrectThinning(rng, out, predicted):
    """Keeps the mean weight."""
    kept, share = thinned(rng, out)
    return kept.reweighted(np.full(len(kept), np.log(share)))


@faulty(_POSTERIOR, "the mean weight is", exact_evidence, changed)
def ThinsBySum(rng, out, predicted):
    """Keeps the sum of the weights instead of their mean."""
    return thinned(rng, out)[0]


# --- proposals ----------------------------------------------------------------------------------------------------
_DRAWN = "draws_have_their_distribution"


@faulty("gives_n_particles", "asked for 2 particles it returns 1", None, proposal)
def OneTooFew(rng, y, n):
    return rng.standard_normal(max(n - 1, 1))


@faulty("keeps_no_state", "keeps state")
@dataclass(frozen=True)
class Remembers(Proposal):
    calls: list = field(default_factory=list)

    def sample(self, rng, observation, n):
        self.calls.append(n)
        return Population(rng.standard_normal(n) + len(self.calls))


@faulty(_DRAWN, "coordinate 0 of x +", exact_prior_in_plane, proposal)
def one_number_for_two_axes(rng, y, n):
    return SD0 * np.broadcast_to(rng.standard_normal((n, 1)), (n, 2))


@faulty(_DRAWN, "opposite sign", exact_prior, proposal)
def inverted_weights(rng, y, n):
    x = 1.5 * SD0 * rng.standard_normal(n)
    return x, Normal(0.0, 1.5 * SD0).log_prob(x) - Normal(0.0, SD0).log_prob(x)


add_faults(
    _DRAWN,
    "is below",
    exact_prior,
    proposal,
    narrow=lambda rng, y, n: 0.97 * SD0 * rng.standard_normal(n),
    off_centre=lambda rng, y, n: 0.05 + SD0 * rng.standard_normal(n),
    one_draw=lambda rng, y, n: np.full(n, SD0 * rng.standard_normal()),
    cut_draws=lambda rng, y, n: SD0 * np.clip(rng.standard_normal(n), -2.9, 2.9),
    guided_without_weights=lambda rng, y, n: np.asarray(optimal_initial(y).sample(rng, n)),
)


@faulty(_DRAWN, "times the variance", exact_prior, proposal)
def pairs(rng, y, n):
    return SD0 * np.repeat(rng.standard_normal(-(-n // 2)), 2)[:n]


@faulty(_DRAWN, "n = 1", exact_prior, proposal)
def mean_if_single(rng, y, n):
    return np.zeros(1) if n == 1 else SD0 * rng.standard_normal(n)


def _weighed(rng, y, n, factor):
    q = Normal(0.0, 1.2 * SD0)
    x = q.sample(rng, n)
    return x, Normal(0.0, SD0).log_prob(x) - q.log_prob(x) + np.log(factor)


@faulty(_DRAWN, "the mean weight is", exact_prior, proposal)
def weights_of_mean_two(rng, y, n):
    return _weighed(rng, y, n, 2.0)


@proposal
def correct_draws(rng, y, n):
    return SD0 * rng.standard_normal(n)


@proposal
def correct_weighed(rng, y, n):
    return _weighed(rng, y, n, 1.0)


@proposal
def correct_antithetic(rng, y, n):
    """Less variance than independent draws, sorted."""
    half = rng.standard_normal(-(-n // 2))
    return SD0 * np.sort(rng.permutation(np.concatenate([half, -half]))[:n])


# --- rejuvenations ------------------------------------------------------------------------------------------------
_KEPT = "keeps_the_distribution"
_NUMBER = "keeps_number_and_weights"


def _metropolis(rng, x, previous, y, step, temperature=1.0, n_uniforms=None):
    """A Metropolis step for p(x_t | x_{t-1}, y_t), at a temperature."""

    def log_p(v):
        return (Normal(RHO * previous, SIGMA).log_prob(v) + Normal(v, TAU).log_prob(y)) / temperature

    u = rng.random(len(x) if n_uniforms is None else n_uniforms)
    return np.where(np.log1p(-u) < log_p(x + step) - log_p(x), x + step, x)


@kernel
def nothing(rng, x, previous, y):
    return x


@kernel
def gibbs(rng, x, previous, y):
    return optimal(previous, y).sample(rng, len(x))


@kernel
def correct_kernel(rng, x, previous, y):
    return _metropolis(rng, x, previous, y, 0.5 * rng.standard_normal(len(x)))


add_faults(
    _KEPT,
    "no longer exact",
    None,
    kernel,
    hot=lambda rng, x, previous, y: _metropolis(
        rng, x, previous, y, 0.5 * rng.standard_normal(len(x)), temperature=1.1
    ),
    asymmetric=lambda rng, x, previous, y: _metropolis(rng, x, previous, y, 0.5 * rng.standard_normal(len(x)) + 0.1),
    forgets_the_observation=lambda rng, x, previous, y: walk(previous, rng.standard_normal(len(x))),
    swaps_neighbours=lambda rng, x, previous, y: rng.permutation(x),
)


@faulty(_KEPT, "of neighbours", None, kernel)
def pairs_of_steps(rng, x, previous, y):
    step = np.repeat(rng.standard_normal(-(-len(x) // 2)), 2)[: len(x)]
    return np.asarray(optimal(previous, y).mean) + float(np.asarray(optimal(0.0, y).scale)) * step


@faulty(_KEPT, "x_t - x_{t-1}", None, kernel)
def ForgetsTheParent(rng, x, previous, y):
    """Draws from p(x_t | y_t): the marginal is right, the joint distribution with x_{t-1} is wrong."""
    return optimal(rng.normal(0.2, 1.0, len(x)), y).sample(rng, len(x))


@faulty(_NUMBER, "changes log weights", None, of(Rejuvenation, "move"))
def WeighsMoves(rng, population, previous, observation):
    return population.reweighted(rng.standard_normal(len(population)))


@faulty(_NUMBER, "previous=None", None, of(Rejuvenation, "move"))
def NeedsAPast(rng, population, previous, observation):
    return population.moved(population.particles + 0 * previous.particles)


@faulty(_NUMBER, "2 particles became 1", None, of(Rejuvenation, "move"))
def LosesOne(rng, population, previous, observation):
    return population.take(np.arange(max(1, len(population) - 1)))


@faulty("does_not_use_global_generators", "global generator", None, of(Rejuvenation, "move"))
def GlobalRejuvenation(rng, population, previous, observation):
    return population.moved(population.particles + np.random.randn())  # noqa: NPY002


# --- triggers and sizes -------------------------------------------------------------------------------------------
add_methods(
    Trigger,
    "wants",
    AbsoluteWeight=("ignores_scale_and_order", "adding", lambda population, t: population.log_weights.max() < 0),
    MaybeTrigger=("answers", "True or False", lambda population, t: population.ess),
)
add_methods(Size, "choose", HalfSize=("answers", "at least 1", lambda population: len(population) // 2))


# --- similarities and equivalences --------------------------------------------------------------------------------
def distances(particles):
    return np.abs(particles[:, None] - particles[None, :])


_PAIRS = "pairs_do_not_depend_on_others"
add_methods(
    Similarity,
    "matrix",
    Distance=("similarities_are_shares", "to itself", distances),
    RelativeSimilarity=(_PAIRS, "if only these", lambda x: 1 - distances(x) / max(distances(x).max(), 1e-12)),
    OneSided=("similarities_are_shares", "similarity of particles", lambda x: np.tril(np.ones((len(x), len(x))))),
)
add_methods(
    Equivalence,
    "classes",
    CountsFromOne=("classes_are_numbered", "classes are", lambda particles: np.arange(1, len(particles) + 1)),
    AllDifferent=(_PAIRS, "if there are copies", lambda particles: np.arange(len(particles))),
)


# --- lookaheads ---------------------------------------------------------------------------------------------------
add_methods(
    Lookahead,
    "log_priority",
    LooksAtWeights=("ignores_weights", "changes the priorities", lambda p, y: p.log_weights + p.particles),
    RulesOut=("scores_are_finite", "-inf", lambda p, y: np.where(p.particles > 1, -np.inf, 0.0)),
    OneForAll=("scores_are_finite", "shape (1,)", lambda p, y: np.zeros(1)),
    ByPlace=(_ORDER, "in another order", lambda p, y: 0.1 * np.arange(len(p))),
)


@faulty("keeps_no_state", "keeps state")
@dataclass(frozen=True)
class Counts(Lookahead):
    calls: list = field(default_factory=list)

    def log_priority(self, population, observation):
        self.calls.append(1)
        return population.particles * len(self.calls)


@faulty("does_not_change_input", "in place", None, of(Lookahead, "log_priority"))
def PriorityInPlace(population, observation):
    particles = population.particles.base if population.particles.base is not None else population.particles
    particles *= 2
    return particles


# --- codecs -------------------------------------------------------------------------------------------------------
_DECODED = "decoded_particles_are_equal"


def encodes(function):
    """A codec that stores ``{"x": function(particles)}`` and returns it as double precision."""

    def encode(self, particles):
        return {"x": function(particles)}

    def decode(self, arrays):
        return arrays["x"].astype(np.float64)

    return type(function.__name__, (Codec,), {"encode": encode, "decode": decode})


add_faults(
    _DECODED,
    "not the same",
    None,
    encodes,
    SinglePrecision=lambda particles: particles.astype(np.float32),
    Sorts=lambda particles: np.sort(particles),
)


@faulty(_DECODED, "Python objects", None, encodes)
def Pickles(particles):
    return np.array(list(particles), dtype=object)


@faulty(_DECODED, "a list as", None, encodes)
def Lists(particles):
    return particles.tolist()


@faulty("decoded_particles_are_equal", "list index out of range")
@dataclass(frozen=True)
class Keeps(Codec):
    """Decodes what it has stored in itself, which a new process has not."""

    kept: list = field(default_factory=list)

    def encode(self, particles):
        self.kept.append(particles)
        return {"x": np.zeros(1)}

    def decode(self, arrays):
        return self.kept[-1]


# --- evidence -----------------------------------------------------------------------------------------------------
_COPIES = "copies_score_the_same"
add_methods(
    Evidence,
    "log_score",
    RulesOutOdd=("scores_are_finite", "-inf", lambda h, clip: np.where(np.arange(len(h)) % 2, -np.inf, 0.0)),
    FirstIsBest=(_ORDER, "another order", lambda h, clip: -np.arange(float(len(h)))),
    OneScore=("scores_are_finite", "shape (1,)", lambda h, clip: np.zeros(1)),
    HighNamesWin=(_COPIES, "other numbers", lambda h, clip: np.array([float(one.labels.max()) for one in h])),
)


@faulty(_COPIES, "its copy", None, of(Evidence, "log_score"))
def ByIdentity(hypotheses, clip):
    """Compares hypotheses by identity, not by content."""
    born = {id(h.objects): k for k, h in reversed(list(enumerate(hypotheses)))}
    return np.array([float(born[id(h.objects)]) for h in hypotheses])


@faulty("keeps_no_state", "keeps state")
@dataclass(frozen=True)
class GrowsTired(Evidence):
    asked: list = field(default_factory=list)

    def log_score(self, hypotheses, clip):
        self.asked.append(clip)
        return np.full(len(hypotheses), -float(len(self.asked)))


# --- faults that are not found, and correct components ------------------------------------------------------------


@kernel
def one_uniform(rng, x, previous, y):
    """One uniform number decides for all particles."""
    return _metropolis(rng, x, previous, y, 0.5 * rng.standard_normal(len(x)), n_uniforms=1)


#: Faults that are not found, and why.
NOT_FOUND = {
    one_uniform: "a random number that decides for all particles may also be a choice between two kernels, which is "
    "valid; the moves of a particle have the right distribution in any number of calls",
}
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
#: Updates that draw: their weights, or the particles that they keep, are random.
CORRECT_RANDOM = [
    (CorrectNoise(), exact_weights),
    (CorrectNoise(), exact_evidence),
    (CorrectSelection(), exact_evidence),
    (CorrectThinning(), exact_evidence),
]
