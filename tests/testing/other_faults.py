"""Components other than resamplers with one fault each, and the property that each violates."""

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
    union,
)
from tests.smc.models import RHO, SD0, SIGMA, TAU, optimal, optimal_initial


@dataclass(frozen=True)
class DropsParticles(Transition):
    def predict(self, rng, population, observation):
        return population.take(np.arange(len(population) // 2 + 1), None).labelled({})


@dataclass(frozen=True)
class NeedsObservation(Transition):
    def predict(self, rng, population, observation):
        return replace(population, particles=population.particles + float(observation))


@dataclass(frozen=True)
class MovesInPlace(Transition):
    def predict(self, rng, population, observation):
        population.particles.setflags(write=True) if population.particles.flags.owndata else None
        particles = population.particles
        particles += 1
        return Population(particles, population.log_weights)


@dataclass(frozen=True)
class FirstIsSpecial(Transition):
    def predict(self, rng, population, observation):
        step = rng.standard_normal(len(population))
        step[0] *= 4
        return replace(population, particles=population.particles + step)


@dataclass(frozen=True)
class NormalisesWeights(Transition):
    def predict(self, rng, population, observation):
        return replace(population, log_weights=np.log(population.weights))


@dataclass(frozen=True)
class GlobalMove(Transition):
    def predict(self, rng, population, observation):
        return replace(population, particles=population.particles + np.random.randn())  # noqa: NPY002


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


@dataclass(frozen=True)
class WrongSign(Guided):
    sign: float = -1.0


@dataclass(frozen=True)
class OneNoise(Transition):
    def predict(self, rng, population, observation):
        return population.moved(RHO * population.particles + SIGMA * rng.standard_normal())


@dataclass(frozen=True)
class Permutes(Transition):
    """Returns the moved particles in another order, without their weights."""

    def predict(self, rng, population, observation):
        moved = RHO * population.particles + SIGMA * rng.standard_normal(len(population))
        return population.moved(rng.permutation(moved))


@dataclass(frozen=True)
class PermutesAll(Transition):
    """Returns the moved particles with their weights in another order."""

    def predict(self, rng, population, observation):
        moved = RHO * population.particles + SIGMA * rng.standard_normal(len(population))
        order = rng.permutation(len(population))
        return Population(moved[order], population.log_weights[order])


@dataclass(frozen=True)
class Posterior(Update):
    """Weights by a power of the likelihood."""

    power: float = 1.0

    def update(self, rng, predicted, proposed, observation):
        population = union(predicted, proposed)
        return population.reweighted(self.power * Normal(population.particles, TAU).log_prob(observation))


@dataclass(frozen=True)
class Squared(Posterior):
    power: float = 2.0


@dataclass(frozen=True)
class PermutesUpdate(Posterior):
    def update(self, rng, predicted, proposed, observation):
        out = super().update(rng, predicted, proposed, observation)
        return Population(out.particles[::-1], out.log_weights[::-1], out.parents)


def exact_moves(rng, n):
    """x_{t-1}, draws of x_t given them, y_t, log p(y_t | x_t)."""
    previous = rng.normal(0.2, 1.0, n)
    moved = rng.normal(RHO * previous, SIGMA)
    return Population(previous), Population(moved), 0.7, lambda x: Normal(x, TAU).log_prob(0.7)


def exact_posterior(rng, n):
    """Draws of p(x), of p(x | y), y."""
    prior, posterior = rng.normal(0.0, SD0, n), optimal_initial(0.7).sample(rng, n)
    return Population(prior), Population(posterior), 0.7


def exact_walk(rng, n):
    """x_{t-1}, draws of x_t given them by the AR(1) model, y_t; the move does not use y_t."""
    previous = rng.normal(0.2, 1.0, n)
    return Population(previous), Population(rng.normal(RHO * previous, SIGMA)), 0.7


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


def exact_plane(rng, n):
    """x_{t-1} in the plane, draws of x_t given them, y_t."""
    previous = rng.normal(0.2, 1.0, (n, 2))
    return Population(previous), Population(rng.normal(RHO * previous, SIGMA)), 0.7


def exact_prior_in_plane(rng, n):
    """Draws of p(x_0) in the plane, y."""
    return Population(rng.normal(0.0, SD0, (n, 2))), 0.7


def move(function, base=Transition):
    """A transition that replaces the particles by ``function(rng, x, y)``."""

    def predict(self, rng, population, observation):
        return population.moved(function(rng, population.particles, observation))

    return type(function.__name__, (base,), {"predict": predict, "__doc__": function.__doc__})


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


def walk(x, noise):
    return RHO * x + SIGMA * noise


@move
def shared_by_pairs(rng, x, y):
    noise = rng.standard_normal(-(-len(x) // 2))
    return walk(x, np.repeat(noise, 2)[: len(x)])


@move
def antithetic_halves(rng, x, y):
    noise = rng.standard_normal(-(-len(x) // 2))
    return walk(x, np.concatenate([noise, -noise])[: len(x)])


@move
def mirrored(rng, x, y):
    """Antithetic pairs of the first and the last particle, if there are many."""
    noise = rng.standard_normal(len(x))
    if len(x) > 100:
        noise[len(x) // 2 :] = -noise[: len(x) - len(x) // 2][::-1]
    return walk(x, noise)


@move
def shared_by_blocks(rng, x, y):
    """One random number for every eight particles."""
    return walk(x, np.repeat(rng.standard_normal(-(-len(x) // 8)), 8)[: len(x)])


@move
def still_alone(rng, x, y):
    return walk(x, rng.standard_normal(len(x)) if len(x) > 1 else 0.0)


@move
def still_without_observation(rng, x, y):
    return x if y is None else walk(x, rng.standard_normal(len(x)))


@move
def wide_step(rng, x, y):
    return RHO * x + 1.05 * SIGMA * rng.standard_normal(len(x))


@move
def uniform_noise(rng, x, y):
    return walk(x, rng.uniform(-np.sqrt(3), np.sqrt(3), len(x)))


@move
def cut_noise(rng, x, y):
    return walk(x, np.clip(rng.standard_normal(len(x)), -2.8, 2.8))


@move
def small_drift(rng, x, y):
    return walk(x, rng.standard_normal(len(x))) + 0.02


@move
def last_is_still(rng, x, y):
    noise = rng.standard_normal(len(x))
    noise[-1] = 0.0 if len(x) > 1 else noise[-1]
    return walk(x, noise)


@move
def depends_on_first(rng, x, y):
    """The noise of the first particle is added to all."""
    noise = rng.standard_normal(len(x))
    return walk(x, np.where(np.arange(len(x)) > 0, np.sqrt(0.5) * (noise + noise[0]), noise))


@move
def after_a_thousand(rng, x, y):
    """Wider steps from the thousandth particle on."""
    noise = rng.standard_normal(len(x))
    noise[1000:] = noise[1000:] * 1.1
    return walk(x, noise)


class WideWithoutObservation(Guided):
    """A guided move whose steps are too wide without an observation."""

    def predict(self, rng, population, observation):
        if observation is not None:
            return super().predict(rng, population, observation)
        return population.moved(Normal(RHO * population.particles, 1.2 * SIGMA).sample(rng, len(population)))


class NoWeights(Guided):
    """Draws from the optimal proposal without weights."""

    sign: float = 0.0

    def predict(self, rng, population, observation):
        return replace(super().predict(rng, population, observation), log_weights=population.log_weights)


@move
def shared_by_axes(rng, x, y):
    noise = rng.standard_normal(len(x))
    return walk(x, noise if x.ndim == 1 else noise[:, None])


class NoisyIfHeavy(Transition):
    """The steps of heavy particles are larger; on average they have the right spread if the weights are equal."""

    def predict(self, rng, population, observation):
        noise = np.sqrt(len(population) * population.weights) * rng.standard_normal(len(population))
        return population.moved(walk(population.particles, noise))


@likelihood
def too_wide(x, y):
    return Normal(x, 1.1 * TAU).log_prob(y)


@likelihood
def twice(x, y):
    return Normal(x, TAU).log_prob(y) + np.log(2)


@likelihood
def without_constant(x, y):
    return -0.5 * ((x - y) / TAU) ** 2


@likelihood
def divided_by_mean(x, y):
    log_g = Normal(x, TAU).log_prob(y)
    return log_g - np.log(np.mean(np.exp(log_g)))


@likelihood
def divided_by_largest(x, y):
    log_g = Normal(x, TAU).log_prob(y)
    return log_g - log_g.max()


@likelihood
def bounded_relative(x, y):
    """Bounded at 8 nats below the best particle."""
    log_g = Normal(x, TAU).log_prob(y)
    return np.maximum(log_g, log_g.max() - 3)


@likelihood
def cut_tails(x, y):
    log_g = Normal(x, TAU).log_prob(y)
    return np.where(np.abs(x - y) > 2.5 * TAU, -700.0, log_g)


@likelihood
def flat_tails(x, y):
    return np.maximum(Normal(x, TAU).log_prob(y), -3.0)


@likelihood
def ranks(x, y):
    log_g = Normal(x, TAU).log_prob(y)
    return np.log1p(np.argsort(np.argsort(log_g)))


@likelihood
def tempered(x, y):
    return 0.95 * Normal(x, TAU).log_prob(y)


@likelihood
def shifted(x, y):
    return Normal(x + 0.02, TAU).log_prob(y)


@likelihood
def cauchy(x, y):
    return -np.log1p(((x - y) / TAU) ** 2) - np.log(np.pi * TAU)


class ForgetsOldWeights(Posterior):
    def update(self, rng, predicted, proposed, observation):
        out = super().update(rng, predicted, proposed, observation)
        return out if proposed is not None else out.reweighted(-predicted.log_weights)


class NoisyWeights(Posterior):
    """Random factors of mean 1 would be correct; these have mean exp(0.02)."""

    def update(self, rng, predicted, proposed, observation):
        out = super().update(rng, predicted, proposed, observation)
        return out.reweighted(0.2 * rng.standard_normal(len(out)))


class CorrectNoise(Posterior):
    """Random factors of mean 1."""

    def update(self, rng, predicted, proposed, observation):
        out = super().update(rng, predicted, proposed, observation)
        return out.reweighted(np.log(rng.standard_exponential(len(out))))


class CorrectSelection(Posterior):
    """Resamples what it weighted."""

    def update(self, rng, predicted, proposed, observation):
        out = super().update(rng, predicted, proposed, observation)
        return out.select(rng.choice(len(out), len(out), p=out.weights), np.full(len(out), out.log_mean_weight))


class CorrectThinning(Posterior):
    """Drops light particles at random; the others carry their weight, and the mean weight is kept."""

    def update(self, rng, predicted, proposed, observation):
        out = super().update(rng, predicted, proposed, observation)
        p = np.minimum(1.0, 2 * len(out) * out.weights)
        kept = np.flatnonzero(rng.random(len(out)) < p)
        return out.select(kept, out.log_weights[kept] - np.log(p[kept]) + self.log_factor(len(kept) / len(out)))

    def log_factor(self, share):
        return np.log(share)


class ThinsBySum(CorrectThinning):
    """Keeps the sum of the weights instead of their mean."""

    def log_factor(self, share):
        return 0.0


@proposal
def one_number_for_two_axes(rng, y, n):
    return SD0 * np.broadcast_to(rng.standard_normal((n, 1)), (n, 2))


@proposal
def inverted_weights(rng, y, n):
    x = 1.5 * SD0 * rng.standard_normal(n)
    return x, Normal(0.0, 1.5 * SD0).log_prob(x) - Normal(0.0, SD0).log_prob(x)


@proposal
def narrow(rng, y, n):
    return 0.97 * SD0 * rng.standard_normal(n)


@proposal
def off_centre(rng, y, n):
    return 0.05 + SD0 * rng.standard_normal(n)


@proposal
def pairs(rng, y, n):
    return SD0 * np.repeat(rng.standard_normal(-(-n // 2)), 2)[:n]


@proposal
def one_draw(rng, y, n):
    return np.full(n, SD0 * rng.standard_normal())


@proposal
def correct_antithetic(rng, y, n):
    """Less variance than independent draws, sorted."""
    half = rng.standard_normal(-(-n // 2))
    return SD0 * np.sort(rng.permutation(np.concatenate([half, -half]))[:n])


@proposal
def mean_if_single(rng, y, n):
    return np.zeros(1) if n == 1 else SD0 * rng.standard_normal(n)


@proposal
def cut_draws(rng, y, n):
    return SD0 * np.clip(rng.standard_normal(n), -2.9, 2.9)


@proposal
def guided_without_weights(rng, y, n):
    return np.asarray(optimal_initial(y).sample(rng, n))


def _weighed(rng, y, n, factor):
    q = Normal(0.0, 1.2 * SD0)
    x = q.sample(rng, n)
    return x, Normal(0.0, SD0).log_prob(x) - q.log_prob(x) + np.log(factor)


@proposal
def weights_of_mean_two(rng, y, n):
    return _weighed(rng, y, n, 2.0)


@proposal
def correct_draws(rng, y, n):
    return SD0 * rng.standard_normal(n)


@proposal
def correct_weighed(rng, y, n):
    return _weighed(rng, y, n, 1.0)


def _metropolis(rng, x, previous, y, step, scale=1.0):
    """A Metropolis step for p(x_t | x_{t-1}, y_t), at a temperature."""

    def log_p(v):
        return (Normal(RHO * previous, SIGMA).log_prob(v) + Normal(v, TAU).log_prob(y)) / scale

    new = x + step
    return np.where(np.log1p(-rng.random(len(x))) < log_p(new) - log_p(x), new, x)


@kernel
def correct_kernel(rng, x, previous, y):
    return _metropolis(rng, x, previous, y, 0.5 * rng.standard_normal(len(x)))


@kernel
def gibbs(rng, x, previous, y):
    return optimal(previous, y).sample(rng, len(x))


@kernel
def nothing(rng, x, previous, y):
    return x


@kernel
def hot(rng, x, previous, y):
    return _metropolis(rng, x, previous, y, 0.5 * rng.standard_normal(len(x)), 1.1)


@kernel
def asymmetric(rng, x, previous, y):
    return _metropolis(rng, x, previous, y, 0.5 * rng.standard_normal(len(x)) + 0.1)


@kernel
def one_uniform(rng, x, previous, y):
    """One uniform number decides for all particles."""
    new = x + 0.5 * rng.standard_normal(len(x))

    def log_p(v):
        return Normal(RHO * previous, SIGMA).log_prob(v) + Normal(v, TAU).log_prob(y)

    return np.where(np.log1p(-rng.random()) < log_p(new) - log_p(x), new, x)


@kernel
def pairs_of_steps(rng, x, previous, y):
    step = np.repeat(rng.standard_normal(-(-len(x) // 2)), 2)[: len(x)]
    return np.asarray(optimal(previous, y).mean) + float(np.asarray(optimal(0.0, y).sd)) * step


@kernel
def forgets_the_observation(rng, x, previous, y):
    return RHO * previous + SIGMA * rng.standard_normal(len(x))


@kernel
def swaps_neighbours(rng, x, previous, y):
    return rng.permutation(x)


@kernel
def greedy(rng, x, previous, y):
    new = x + 0.2 * rng.standard_normal(len(x))
    better = np.abs(new - y) < np.abs(x - y)
    return np.where(better, new, x)


@dataclass(frozen=True)
class RandomStep(DensityTransition):
    def predict(self, rng, population, observation):
        return replace(population, particles=population.particles + rng.standard_normal(len(population)))


def exact_density(rng, n):
    previous = rng.standard_normal(n)
    return Population(previous), Population(rng.normal(previous, 1.0)), 0.5


@dataclass(frozen=True)
class CorrectDensity(RandomStep):
    """The density without its constant factor."""

    def log_prob(self, previous, new, observation):
        return -0.5 * (new - previous) ** 2


@dataclass(frozen=True)
class OneDensity(RandomStep):
    """The density of all moves together."""

    def log_prob(self, previous, new, observation):
        return -0.5 * np.sum((new - previous) ** 2)


@dataclass(frozen=True)
class NormalisedDensity(RandomStep):
    def log_prob(self, previous, new, observation):
        log_f = -0.5 * (new - previous) ** 2
        return log_f - np.logaddexp.reduce(log_f)


@dataclass(frozen=True)
class WiderDensity(RandomStep):
    def log_prob(self, previous, new, observation):
        return Normal(previous, 1.1).log_prob(new)


@dataclass(frozen=True)
class DensityOfAnotherMove(RandomStep):
    def log_prob(self, previous, new, observation):
        return Normal(RHO * previous, 1.0).log_prob(new)


@dataclass(frozen=True)
class VarianceForSd(DensityTransition):
    def predict(self, rng, population, observation):
        return population.moved(Normal(population.particles, SIGMA).sample(rng, len(population)))

    def log_prob(self, previous, new, observation):
        return Normal(previous, SIGMA**2).log_prob(new)


_MOVES = "weighted_moves_are_those_of_the_model"
_ORDER = "order_of_particles_is_irrelevant"
_POSTERIOR = "weights_are_those_of_the_posterior"
_OTHERS = "weight_of_a_particle_does_not_depend_on_others"
_DRAWN = "draws_have_their_distribution"
_KEPT = "keeps_the_distribution"

#: Fault of weighted distributions, property that must be broken, words of its message, exact draws.
WEIGHTED_FAULTS = [
    (shared_by_axes, _MOVES, "coordinate 0 of x_t + coordinate 1 of x_t", exact_plane),
    (NoisyIfHeavy, _ORDER, "if the weights are others", None),
    (one_number_for_two_axes, "draws_have_their_distribution", "coordinate 0 of x +", exact_prior_in_plane),
    (inverted_weights, "draws_have_their_distribution", "opposite sign", exact_prior),
    (ThinsBySum, "weights_are_those_of_the_posterior", "the mean weight is", exact_evidence),
    (WrongSign, "weighted_moves_are_those_of_the_model", "opposite sign", exact_moves),
    (OneNoise, "weighted_moves_are_those_of_the_model", "is below", exact_moves),
    (OneNoise, "order_of_particles_is_irrelevant", "the same noise", None),
    (Permutes, "weighted_moves_are_those_of_the_model", "x_t - x_{t-1}", exact_moves),
    (PermutesAll, "weights_stay_with_their_particles", "another order", None),
    (Squared, "weights_are_those_of_the_posterior", "is below", exact_posterior),
    (PermutesUpdate, "parents_belong_to_their_particles", "parent", None),
    (shared_by_pairs, _ORDER, "do not move independently", None),
    (antithetic_halves, _ORDER, "do not move independently", None),
    (shared_by_blocks, _MOVES, "between neighbours", exact_walk),
    (mirrored, _MOVES, "mirrored positions", exact_walk),
    (still_alone, _ORDER, "alone (n = 1)", None),
    (still_without_observation, _ORDER, "observation=None", None),
    (wide_step, _MOVES, "and sd", exact_walk),
    (uniform_noise, _MOVES, "is below", exact_walk),
    (cut_noise, _MOVES, "is below", exact_walk),
    (small_drift, _MOVES, "is below", exact_walk),
    (last_is_still, _ORDER, "moves differently", None),
    (depends_on_first, _ORDER, "do not move independently", None),
    (after_a_thousand, _MOVES, "is below", exact_walk),
    (WideWithoutObservation, _MOVES, "and sd", exact_moves),
    (NoWeights, _MOVES, "is below", exact_moves),
    (too_wide, _POSTERIOR, "is below", exact_posterior),
    (too_wide, _POSTERIOR, "the log weight of a particle is", exact_weights),
    (twice, _POSTERIOR, "2 times the exact ones", exact_weights),
    (twice, _POSTERIOR, "constant factors", exact_evidence),
    (without_constant, _POSTERIOR, "constant factors", exact_weights),
    (divided_by_mean, _OTHERS, "not normalised or ranked", None),
    (divided_by_largest, _OTHERS, "not normalised or ranked", None),
    (bounded_relative, _POSTERIOR, "is below", exact_posterior),
    (cut_tails, _POSTERIOR, "is below", exact_posterior),
    (flat_tails, _POSTERIOR, "is below", exact_posterior),
    (ranks, _OTHERS, "not normalised or ranked", None),
    (tempered, _POSTERIOR, "is below", exact_posterior),
    (shifted, _POSTERIOR, "is below", exact_posterior),
    (cauchy, _POSTERIOR, "is below", exact_posterior),
    (ForgetsOldWeights, "scale_of_weights_is_irrelevant", "log weights + 50", None),
    (NoisyWeights, _POSTERIOR, "constant factors", exact_evidence),
    (narrow, _DRAWN, "is below", exact_prior),
    (off_centre, _DRAWN, "is below", exact_prior),
    (pairs, _DRAWN, "times the variance", exact_prior),
    (one_draw, _DRAWN, "is below", exact_prior),
    (mean_if_single, _DRAWN, "n = 1", exact_prior),
    (cut_draws, _DRAWN, "is below", exact_prior),
    (guided_without_weights, _DRAWN, "is below", exact_prior),
    (weights_of_mean_two, _DRAWN, "the mean weight is", exact_prior),
    (WiderDensity, "log_prob_is_the_density_of_its_moves", "certain which is", None),
    (DensityOfAnotherMove, "log_prob_is_the_density_of_its_moves", "certain which is", None),
    (VarianceForSd, "log_prob_is_the_density_of_its_moves", "too certain", None),
    (hot, _KEPT, "no longer exact", None),
    (asymmetric, _KEPT, "no longer exact", None),
    (pairs_of_steps, _KEPT, "between neighbours", None),
    (forgets_the_observation, _KEPT, "no longer exact", None),
    (swaps_neighbours, _KEPT, "no longer exact", None),
    (greedy, _KEPT, "no longer exact", None),
]
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
]
#: Updates that draw: their weights, or the particles that they keep, are random.
CORRECT_RANDOM = [
    (CorrectNoise(), exact_weights),
    (CorrectNoise(), exact_evidence),
    (CorrectSelection(), exact_evidence),
    (CorrectThinning(), exact_evidence),
]


@dataclass(frozen=True)
class OneTooFew(Proposal):
    def sample(self, rng, observation, n):
        return Population(rng.standard_normal(max(n - 1, 1)))


@dataclass(frozen=True)
class Remembers(Proposal):
    calls: list = field(default_factory=list)

    def sample(self, rng, observation, n):
        self.calls.append(n)
        return Population(rng.standard_normal(n) + len(self.calls))


@dataclass(frozen=True)
class NeedsPrediction(Update):
    def update(self, rng, predicted, proposed, observation):
        return predicted.reweighted(np.zeros(len(predicted)))


@dataclass(frozen=True)
class StrangeParents(Update):
    def update(self, rng, predicted, proposed, observation):
        population = predicted if predicted is not None else proposed
        return replace(population, parents={"proposed": np.full(len(population), 99)})


@dataclass(frozen=True)
class AbsoluteWeight(Trigger):
    def wants(self, population, t):
        return population.log_weights.max() < 0


@dataclass(frozen=True)
class MaybeTrigger(Trigger):
    def wants(self, population, t):
        return population.ess


@dataclass(frozen=True)
class HalfSize(Size):
    def choose(self, population):
        return len(population) // 2


@dataclass(frozen=True)
class Distance(Similarity):
    def matrix(self, particles):
        return np.abs(particles[:, None] - particles[None, :])


@dataclass(frozen=True)
class RelativeSimilarity(Similarity):
    def matrix(self, particles):
        d = np.abs(particles[:, None] - particles[None, :])
        return 1 - d / max(d.max(), 1e-12)


@dataclass(frozen=True)
class OneSided(Similarity):
    def matrix(self, particles):
        return np.tril(np.ones((len(particles), len(particles))))


@dataclass(frozen=True)
class CountsFromOne(Equivalence):
    def classes(self, particles):
        return np.arange(1, len(particles) + 1)


@dataclass(frozen=True)
class AllDifferent(Equivalence):
    def classes(self, particles):
        return np.arange(len(particles))


@dataclass(frozen=True)
class LooksAtWeights(Lookahead):
    def log_priority(self, population, observation):
        return population.log_weights + population.particles


@dataclass(frozen=True)
class RulesOut(Lookahead):
    def log_priority(self, population, observation):
        return np.where(population.particles > 1, -np.inf, 0.0)


@dataclass(frozen=True)
class OneForAll(Lookahead):
    def log_priority(self, population, observation):
        return np.zeros(1)


@dataclass(frozen=True)
class ByPlace(Lookahead):
    def log_priority(self, population, observation):
        return 0.1 * np.arange(len(population))


@dataclass(frozen=True)
class Counts(Lookahead):
    calls: list = field(default_factory=list)

    def log_priority(self, population, observation):
        self.calls.append(1)
        return population.particles * len(self.calls)


@dataclass(frozen=True)
class PriorityInPlace(Lookahead):
    def log_priority(self, population, observation):
        particles = population.particles.base if population.particles.base is not None else population.particles
        particles *= 2
        return particles


@dataclass(frozen=True)
class MovesAll(Rejuvenation):
    """Accepts every step."""

    def move(self, rng, population, previous, observation):
        return replace(population, particles=population.particles + 0.5 * rng.standard_normal(len(population)))


@dataclass(frozen=True)
class ForgetsTheParent(Rejuvenation):
    """Draws from p(x_t | y_t): the marginal is right, the joint distribution with x_{t-1} is wrong."""

    def move(self, rng, population, previous, observation):
        if previous is None or observation is None:
            return population
        parents = rng.normal(0.2, 1.0, len(population))
        return replace(population, particles=optimal(parents, observation).sample(rng, len(population)))


@dataclass(frozen=True)
class WeighsMoves(Rejuvenation):
    def move(self, rng, population, previous, observation):
        return population.reweighted(rng.standard_normal(len(population)))


@dataclass(frozen=True)
class NeedsAPast(Rejuvenation):
    def move(self, rng, population, previous, observation):
        return replace(population, particles=population.particles + 0 * previous.particles)


@dataclass(frozen=True)
class LosesOne(Rejuvenation):
    def move(self, rng, population, previous, observation):
        return population.take(np.arange(max(1, len(population) - 1)))


@dataclass(frozen=True)
class GlobalRejuvenation(Rejuvenation):
    def move(self, rng, population, previous, observation):
        return replace(population, particles=population.particles + np.random.randn())  # noqa: NPY002


@dataclass(frozen=True)
class SinglePrecision(Codec):
    def encode(self, particles):
        return {"x": particles.astype(np.float32)}

    def decode(self, arrays):
        return arrays["x"].astype(np.float64)


@dataclass(frozen=True)
class Pickles(Codec):
    def encode(self, particles):
        return {"x": np.array(list(particles), dtype=object)}

    def decode(self, arrays):
        return arrays["x"]


@dataclass(frozen=True)
class Keeps(Codec):
    """Decodes what it has stored in itself, which a new process has not."""

    kept: list = field(default_factory=list)

    def encode(self, particles):
        self.kept.append(particles)
        return {"x": np.zeros(1)}

    def decode(self, arrays):
        return self.kept[-1]


@dataclass(frozen=True)
class Sorts(Codec):
    def encode(self, particles):
        return {"x": np.sort(particles)}

    def decode(self, arrays):
        return arrays["x"]


@dataclass(frozen=True)
class Lists(Codec):
    def encode(self, particles):
        return {"x": particles.tolist()}

    def decode(self, arrays):
        return arrays["x"]


@dataclass(frozen=True)
class RulesOutOdd(Evidence):
    def log_score(self, hypotheses, clip):
        with np.errstate(divide="ignore"):
            return np.log([0.0 if k % 2 else 1.0 for k, _ in enumerate(hypotheses)])


@dataclass(frozen=True)
class FirstIsBest(Evidence):
    def log_score(self, hypotheses, clip):
        return -np.arange(float(len(hypotheses)))


@dataclass(frozen=True)
class OneScore(Evidence):
    def log_score(self, hypotheses, clip):
        return np.zeros(1)


@dataclass(frozen=True)
class HighNamesWin(Evidence):
    def log_score(self, hypotheses, clip):
        return np.array([float(h.labels.max()) for h in hypotheses])


@dataclass(frozen=True)
class ByIdentity(Evidence):
    """Compares hypotheses by identity, not by content."""

    def log_score(self, hypotheses, clip):
        born = {id(h.objects): k for k, h in reversed(list(enumerate(hypotheses)))}
        return np.array([float(born[id(h.objects)]) for h in hypotheses])


@dataclass(frozen=True)
class GrowsTired(Evidence):
    asked: list = field(default_factory=list)

    def log_score(self, hypotheses, clip):
        self.asked.append(clip)
        return np.full(len(hypotheses), -float(len(self.asked)))


#: Fault, property that must be broken, words of its message.
FAULTS = [
    (LooksAtWeights, "ignores_scale", "changes the priorities"),
    (RulesOut, "scores_are_finite", "-inf"),
    (OneForAll, "scores_are_finite", "shape (1,)"),
    (ByPlace, "order_of_particles_is_irrelevant", "in another order"),
    (Counts, "keeps_no_state", "keeps state"),
    (PriorityInPlace, "does_not_change_input", "in place"),
    (MovesAll, "keeps_the_distribution", "exact draws are no longer exact"),
    (ForgetsTheParent, "keeps_the_distribution", "x_t - x_{t-1}"),
    (WeighsMoves, "keeps_number_and_weights", "changes log weights"),
    (NeedsAPast, "keeps_number_and_weights", "previous=None"),
    (LosesOne, "keeps_number_and_weights", "2 particles became 1"),
    (GlobalRejuvenation, "does_not_use_global_generators", "global generator"),
    (SinglePrecision, "decoded_particles_are_equal", "not the same"),
    (Pickles, "encodes_as_arrays", "Python objects"),
    (Keeps, "decoded_particles_are_equal", "not the same"),
    (Sorts, "decoded_particles_are_equal", "not the same"),
    (Lists, "encodes_as_arrays", "a list as"),
    (DropsParticles, "parents_are_valid", 'parents "previous"'),
    (NeedsObservation, "takes_a_missing_observation", "observation=None"),
    (MovesInPlace, "does_not_change_input", "in place"),
    (FirstIsSpecial, "order_of_particles_is_irrelevant", "moves differently"),
    (NormalisesWeights, "scale_of_weights_is_irrelevant", "log weights + 50"),
    (GlobalMove, "does_not_use_global_generators", "global generator"),
    (OneDensity, "log_prob_of_own_moves_is_finite", "have shape ()"),
    (NormalisedDensity, "log_prob_of_a_move_does_not_depend_on_others", "three of six"),
    (OneTooFew, "gives_n_particles", "asked for 2 particles it returns 1"),
    (Remembers, "keeps_no_state", "keeps state"),
    (NeedsPrediction, "takes_any_of_its_inputs", "proposed particles"),
    (StrangeParents, "parents_exist", "99"),
    (AbsoluteWeight, "ignores_scale_and_order", "adding"),
    (MaybeTrigger, "answers", "True or False"),
    (HalfSize, "answers", "at least 1"),
    (Distance, "similarities_are_shares", "to itself"),
    (RelativeSimilarity, "pairs_do_not_depend_on_others", "of eleven particles"),
    (OneSided, "is_symmetric", "similarity of particles"),
    (CountsFromOne, "classes_are_numbered", "classes are"),
    (AllDifferent, "copies_are_equal", "copy"),
    (RulesOutOdd, "scores_are_finite", "-inf"),
    (OneScore, "scores_are_finite", "shape (1,)"),
    (FirstIsBest, "order_of_particles_is_irrelevant", "another order"),
    (ByIdentity, "copies_score_the_same", "its copy"),
    (HighNamesWin, "names_of_labels_are_irrelevant", "other numbers"),
    (GrowsTired, "keeps_no_state", "keeps state"),
]
