"""Components other than resamplers with one fault each, and the property that each violates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mstfilter.fusion import Evidence
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


#: Fault of weighted distributions, property that must be broken, words of its message, exact draws.
WEIGHTED_FAULTS = [
    (WrongSign, "weighted_moves_are_those_of_the_model", "opposite sign", exact_moves),
    (OneNoise, "weighted_moves_are_those_of_the_model", "is below", exact_moves),
    (OneNoise, "order_of_particles_is_irrelevant", "the same noise", None),
    (Permutes, "weighted_moves_are_those_of_the_model", "x_t - x_{t-1}", exact_moves),
    (PermutesAll, "weights_stay_with_their_particles", "another order", None),
    (Squared, "weights_are_those_of_the_posterior", "is below", exact_posterior),
    (PermutesUpdate, "parents_belong_to_their_particles", "parent", None),
]


@dataclass(frozen=True)
class RandomStep(DensityTransition):
    def predict(self, rng, population, observation):
        return replace(population, particles=population.particles + rng.standard_normal(len(population)))


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
