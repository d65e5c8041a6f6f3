"""Contracts of the other interfaces: ours pass, planted faults are named."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mstfilter import registry
from mstfilter.errors import InputError
from mstfilter.smc.interfaces import Proposal, Size, Transition, Trigger, Update
from mstfilter.smc.population import Population
from mstfilter.smc.similarity import Equivalence, Similarity
from mstfilter.smc.state_space import Dynamics, Prior, linear_gaussian
from mstfilter.smc.updates import Reweight
from mstfilter.testing import (
    EquivalenceContract,
    ProposalContract,
    SimilarityContract,
    SizeContract,
    TransitionContract,
    TriggerContract,
    UpdateContract,
    verify,
)
from mstfilter.testing.starters import example_of

MODEL = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])


def vectors(rng, n):
    return Population(rng.standard_normal((n, 1)), rng.standard_normal(n)), np.array([0.4])


class TestDynamics(TransitionContract):
    def make(self):
        return Dynamics(MODEL)

    def example(self, rng, n):
        return vectors(rng, n)


class TestPrior(ProposalContract):
    def make(self):
        return Prior(MODEL)


class TestReweight(UpdateContract):
    def make(self):
        return Reweight(MODEL.log_likelihood)

    def example(self, rng, n):
        return vectors(rng, n)


class TestEss(TriggerContract):
    def make(self):
        return registry.build("trigger", "ess")


class TestKld(SizeContract):
    def make(self):
        return registry.build("size", "kld")


class TestGaussian(SimilarityContract):
    def make(self):
        return registry.build("similarity", "gaussian")


class TestBins(EquivalenceContract):
    def make(self):
        return registry.build("equivalence", "bins")


@pytest.mark.parametrize("kind", ["trigger", "size", "similarity", "equivalence", "transition", "proposal", "update"])
def test_our_own(kind):
    for name in registry.COMPONENTS[kind]:
        component = registry.build(kind, name)
        assert [o.broken for o in verify(component, example_of(type(component))) if o.broken] == [], name


# -- planted faults --------------------------------------------------------------------------------------------------


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


FAULTS = [
    (DropsParticles, "says_where_particles_come_from", 'parents "previous"'),
    (NeedsObservation, "takes_a_missing_observation", "observation None"),
    (MovesInPlace, "leaves_input_alone", "in place"),
    (FirstIsSpecial, "order_of_particles_is_irrelevant", "moves differently"),
    (NormalisesWeights, "scale_of_weights_is_irrelevant", "log weights + 50"),
    (GlobalMove, "leaves_global_generators_alone", "global generator"),
    (OneTooFew, "gives_n_particles", "asked for 2 particles it returns 1"),
    (Remembers, "has_no_memory", "keeps something"),
    (NeedsPrediction, "takes_any_of_its_inputs", "proposed particles"),
    (StrangeParents, "parents_exist", "99"),
    (AbsoluteWeight, "trigger_ignores_scale_and_order", "adding"),
    (MaybeTrigger, "answers_yes_or_no", "True or False"),
    (HalfSize, "answers_a_number", "at least 1"),
    (Distance, "similarities_are_shares", "to itself"),
    (RelativeSimilarity, "similarity_of_pairs", "four of nine"),
    (OneSided, "similarity_is_symmetric", "like"),
    (CountsFromOne, "classes_are_numbered", "classes are"),
    (AllDifferent, "copies_are_equal", "copy"),
]


@pytest.mark.parametrize(("fault", "name", "words"), FAULTS, ids=lambda f: getattr(f, "__name__", ""))
def test_planted_faults_are_named(fault, name, words):
    broken = {o.property.name: o.broken for o in verify(fault()) if o.broken}
    assert name in broken, broken
    assert words in broken[name]


def test_what_is_no_component():
    with pytest.raises(InputError, match="no component"):
        list(verify(3))
