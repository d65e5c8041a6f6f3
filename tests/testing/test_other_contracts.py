"""Contracts of the other interfaces: components of the package pass, planted faults are reported."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.presets import REGISTRY
from mstfilter.runs import HypothesisCodec
from mstfilter.smc import (
    ArrayCodec,
    Dynamics,
    Normal,
    Population,
    Prior,
    PriorityLookahead,
    ProgramLookahead,
    ProgramMove,
    RandomWalkMove,
    Rejuvenation,
    Reweight,
    linear_gaussian,
    observe,
    sample,
)
from mstfilter.testing import (
    CodecContract,
    DensityTransitionContract,
    LookaheadContract,
    ProposalContract,
    RejuvenationContract,
    UpdateContract,
    run_contract,
    scene_example,
)
from tests.smc.models import AR1, RHO, SD0, SIGMA, TAU, Box, optimal, predictive
from tests.testing.other_faults import CORRECT, CORRECT_RANDOM, FAULTS, WEIGHTED_FAULTS, correct_kernel

MODEL = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])


def vectors(rng, n):
    return Population(rng.standard_normal((n, 1)), rng.standard_normal(n)), np.array([0.4])


class TestDynamics(DensityTransitionContract):
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


def boxes(rng, n):
    return Population(tuple(Box((int(k),) * 4) for k in rng.integers(3, size=n))), None


def exact_ar1(rng, n):
    """x_{t-1}, draws of p(x_t | x_{t-1}, y_t), y_t."""
    previous = rng.normal(0.2, 1.0, n)
    return Population(previous), Population(optimal(previous, 0.7).sample(rng, n)), 0.7


def ar1(previous, y):
    x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, TAU), y)


def traces(rng, n):
    return Population({"x": rng.standard_normal(n)}, rng.standard_normal(n)), 0.4


class TestPriority(LookaheadContract):
    def make(self):
        return PriorityLookahead(predictive)


class TestProgramLookahead(LookaheadContract):
    def make(self):
        return ProgramLookahead(ar1, 0.5)

    def example(self, rng, n):
        return traces(rng, n)


class TestRandomWalk(RejuvenationContract):
    def make(self):
        return RandomWalkMove(AR1, 0.7)

    def exact(self, rng, n):
        return exact_ar1(rng, n)


class TestProgramMove(RejuvenationContract):
    def make(self):
        return ProgramMove(ar1, 1.0)

    def example(self, rng, n):
        return traces(rng, n)

    def exact(self, rng, n):
        previous, x, y = exact_ar1(rng, n)
        return Population({"x": previous.particles}), Population({"x": x.particles}), y


class TestNumbers(CodecContract):
    def make(self):
        return ArrayCodec()


class TestTraces(CodecContract):
    def make(self):
        return ArrayCodec()

    def example(self, rng, n):
        return traces(rng, n)


class TestObjects(CodecContract):
    def make(self):
        return ArrayCodec()

    def example(self, rng, n):
        return boxes(rng, n)


class TestHypotheses(CodecContract):
    def make(self):
        return HypothesisCodec()

    def example(self, rng, n):
        return scene_example(rng, n)


@pytest.mark.parametrize(
    "kind", ["trigger", "size", "similarity", "equivalence", "evidence", "transition", "proposal", "update"]
)
def test_components_of_the_package_keep_their_contract(kind):
    """All components but oracles, which need the ground truth of a recording, and front ends, which need files."""
    for name, where in REGISTRY.known(kind).items():
        if where.startswith(("mstfilter.oracles:", "mstfilter.frontends:")):
            continue
        component = REGISTRY.build(kind, name)
        assert [r for r in run_contract(component) if r.failure] == [], name


@pytest.mark.parametrize(("fault", "name", "words"), FAULTS, ids=lambda f: getattr(f, "__name__", ""))
def test_planted_faults_are_reported(fault, name, words):
    broken = {r.name: r.failure for r in run_contract(fault(), exact=exact_ar1) if r.failure}
    assert name in broken, broken
    assert words in broken[name]


@pytest.mark.parametrize(("fault", "name", "words", "exact"), WEIGHTED_FAULTS)
def test_faults_of_weighted_distributions_are_reported(fault, name, words, exact):
    exact = exact or (exact_ar1 if issubclass(fault, Rejuvenation) else None)
    broken = {r.name: r.failure for r in run_contract(fault(), exact=exact) if r.failure}
    assert words in broken.get(name, ""), broken


@pytest.mark.parametrize(("component", "exact"), [*CORRECT, (correct_kernel(), exact_ar1)])
def test_correct_weighted_distributions_pass(component, exact):
    results = run_contract(component, exact=exact)
    assert [r for r in results if r.failure or r.skipped] == []


@pytest.mark.parametrize(("component", "exact"), CORRECT_RANDOM)
def test_correct_updates_that_draw_pass(component, exact):
    results = run_contract(component, exact=exact)
    assert [r for r in results if r.failure] == []
    assert [r.name for r in results if r.skipped] == ["weight_of_a_particle_does_not_depend_on_others"]


def test_a_distribution_without_exact_draws_is_not_tested():
    skipped = {r.name: r.skipped for r in run_contract(RandomWalkMove(AR1, 0.7))}
    assert "write exact(rng, n)" in skipped["keeps_the_distribution"]


def test_an_object_without_an_interface_is_an_error():
    with pytest.raises(InputError, match="no component"):
        run_contract(3)
