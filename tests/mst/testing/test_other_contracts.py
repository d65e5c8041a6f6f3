"""Contracts of the other interfaces: components of the package pass, planted faults are reported."""

from __future__ import annotations

import pytest

from mstfilter.base.errors import InputError
from mstfilter.mst.testing import run_contract, scene_example
from mstfilter.runs import HypothesisCodec
from mstfilter.runs.presets import REGISTRY
from mstfilter.smc import (
    ArrayCodec,
    Dynamics,
    Normal,
    Population,
    Prior,
    PriorityLookahead,
    RandomWalkMove,
    Rejuvenation,
    Reweight,
    linear_gaussian,
    observe,
    sample,
)
from mstfilter.smc.testing import CodecContract, LookaheadContract
from tests.mst.testing import run_property
from tests.mst.testing.other_faults import CORRECT, CORRECT_RANDOM, FAULTS, exact_ar1
from tests.smc.models import AR1, RHO, SD0, SIGMA, TAU, predictive

MODEL = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])


def vectors(rng, n):
    return Population(rng.standard_normal((n, 1)), rng.standard_normal(n)), [0.4]


def traces(rng, n):
    return Population({"x": rng.standard_normal(n)}, rng.standard_normal(n)), 0.4


def ar1(previous, y):
    x = sample("x", Normal(0.0, SD0) if previous is None else Normal(RHO * previous["x"], SIGMA))
    observe("y", Normal(x, TAU), y)


class TestPriority(LookaheadContract):
    def make(self):
        return PriorityLookahead(predictive)


class TestNumbers(CodecContract):
    def make(self):
        return ArrayCodec()


OURS = {
    "dynamics": (Dynamics(MODEL), vectors, None),
    "prior": (Prior(MODEL), None, None),
    "likelihood": (Reweight(MODEL.log_likelihood), vectors, None),
    "random walk": (RandomWalkMove(AR1, 0.7), None, exact_ar1),
    "codec of mappings": (ArrayCodec(), traces, None),
    "codec of hypotheses": (HypothesisCodec(), scene_example, None),
}


def failures_of(component, example=None, exact=None):
    return {r.name: r.failure for r in run_contract(component, example, exact) if r.failure}


@pytest.mark.parametrize("name", OURS)
def test_components_of_models_keep_their_contract(name):
    assert failures_of(*OURS[name]) == {}


@pytest.mark.parametrize(
    "kind",
    ["trigger", "size", "similarity", "equivalence", "evidence", "transition", "proposal", "update"]
    + ["completer", "rule"],
)
def test_components_of_the_package_keep_their_contract(kind):
    """All components but oracles, which need the ground truth of a recording, and front ends, which need files."""
    for name, where in REGISTRY.known(kind).items():
        if not where.startswith(("mstfilter.lab.oracles:", "mstfilter.mst.frontends:")):
            assert failures_of(REGISTRY.build(kind, name)) == {}, name


@pytest.mark.parametrize(("fault", "name", "words", "exact"), FAULTS)
def test_planted_faults_are_reported(fault, name, words, exact):
    exact = exact or (exact_ar1 if issubclass(fault, Rejuvenation) else None)
    with pytest.raises(AssertionError) as error:
        run_property(fault(), name, exact)
    assert words in str(error.value)


def test_no_planted_fault_is_lost():
    assert len(FAULTS) == 81


@pytest.mark.parametrize(("component", "exact"), CORRECT)
def test_correct_components_pass(component, exact):
    results = run_contract(component, exact=exact)
    assert [r for r in results if r.failure or (r.skipped and "weighted" not in r.skipped)] == []


@pytest.mark.parametrize(("component", "exact"), CORRECT_RANDOM)
def test_correct_updates_that_draw_pass(component, exact):
    results = run_contract(component, exact=exact)
    assert [r for r in results if r.failure] == []
    skipped = ["weight_of_a_particle_does_not_depend_on_others", "order_of_particles_is_irrelevant"]
    assert [r.name for r in results if r.skipped] == skipped


def test_a_distribution_without_exact_draws_is_not_tested():
    skipped = {r.name: r.skipped for r in run_contract(RandomWalkMove(AR1, 0.7))}
    assert "write exact(rng, n)" in skipped["keeps_the_distribution"]


def test_an_object_without_an_interface_is_an_error():
    with pytest.raises(InputError, match="no component"):
        run_contract(3)
