"""Contracts of components of numbers: planted faults are reported, correct components and ours pass.

False alarms: each contract has up to four statistical properties at 1e-6, so below 3e-4 for this file.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import pytest

import mstfilter.smc.testing as contracts
from mstfilter import smc
from mstfilter.base.errors import InputError
from mstfilter.mst.testing import run_contract, scene_example
from mstfilter.runs import HypothesisCodec
from mstfilter.runs.presets import REGISTRY
from mstfilter.smc import (
    ArrayCodec,
    ClusterStratified,
    Coalesced,
    Dynamics,
    FearnheadClifford,
    Gaussian,
    Multinomial,
    Population,
    Prior,
    PriorityLookahead,
    RandomWalkMove,
    Reweight,
    Sorted,
    Tempered,
    Update,
    WeightResampler,
    linear_gaussian,
)
from mstfilter.smc.testing import CodecContract, LookaheadContract, WeightResamplerContract
from tests.mst.testing import faults, run_property
from tests.smc.models import AR1, predictive

MODEL = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])


def failures_of(component, example=None, exact=None):
    return {r.name: r.failure for r in run_contract(component, example, exact) if r.failure}


class TestCorrect(WeightResamplerContract):
    def make(self):
        return faults.Correct()


@pytest.mark.nightly
class TestCorrectWeighted(WeightResamplerContract):
    def make(self):
        return faults.CorrectWeighted()


class TestPriority(LookaheadContract):
    def make(self):
        return PriorityLookahead(predictive)


class TestNumbers(CodecContract):
    def make(self):
        return ArrayCodec()


# --- faults -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("fault", "name", "words", "exact"),
    [pytest.param(*one, marks=[pytest.mark.nightly] * (one[0].__name__ == "OnePercent")) for one in faults.FAULTS],
)
def test_planted_faults_are_reported(fault, name, words, exact):
    with pytest.raises(AssertionError) as error:
        run_property(fault(), name, exact)
    assert words in str(error.value)


def test_every_property_has_a_planted_fault():
    """Those of models are in tests/smc/test_faulty_programs.py."""
    classes = (getattr(contracts, name) for name in dir(contracts) if name.endswith("Contract"))
    stated = {name for cls in classes if cls is not contracts.ModelContract for name in dir(cls)}
    assert {name[5:] for name in stated if name.startswith("test_")} == {name for _, name, *_ in faults.FAULTS}


def test_a_component_that_never_draws_is_a_remark_or_a_false_statement():
    fixed = faults.move(lambda rng, x, y: 0.9 * x)()
    result = next(r for r in run_contract(fixed) if r.name == "depends_on_its_arguments_only")
    assert result.failure is None and "draws = False" in result.remark

    class Declares(type(fixed)):
        draws = True

    with pytest.raises(AssertionError, match="declares draws = True"):
        run_property(Declares(), "depends_on_its_arguments_only")


# --- correct components -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("calls", ["few", pytest.param("all", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("scheme", faults.RESAMPLERS, ids=lambda scheme: type(scheme).__name__)
def test_correct_schemes_pass(scheme, calls, request):
    if calls == "few":
        request.getfixturevalue("fewer_calls")
    assert [r for r in run_contract(scheme) if r.failure or r.skipped] == []


@pytest.mark.parametrize(("component", "exact"), faults.CORRECT)
def test_correct_components_pass(component, exact):
    results = run_contract(component, exact=exact)
    assert [r for r in results if r.failure] == []
    skipped = SKIPPED.get((type(component), exact))
    assert skipped is None or [r.name for r in results if r.skipped] == skipped


#: Properties that a component cannot have; all others are tested.
SKIPPED = {
    (faults.Posterior, faults.exact_weights): [],
    (faults.Guided, faults.exact_moves): ["moves_do_not_depend_on_others"],
    (faults.CorrectNoise, faults.exact_weights): [
        "weight_of_a_particle_does_not_depend_on_others",
        "order_of_particles_is_irrelevant",
    ],
}


def test_a_property_that_needs_exact_draws_says_how_to_write_them():
    reasons = {r.name: r.skipped for r in run_contract(RandomWalkMove(AR1, 0.7))}
    assert "write exact(rng, n)" in reasons["distribution_is_exact"]


def arrays(rng, n):
    return rng.normal(size=n), rng.normal(size=n), 0.7


def fails(rng, n):
    return rng.normals(n)


WRONG_EXACT = {
    "ndarray, ndarray, float; expected two Populations of 1000": (faults.CorrectDensity(), arrays),
    "ndarray, ndarray, float; expected two Populations": (faults.Posterior(), arrays),
    "ndarray, ndarray, float; expected a Population": (faults.proposal(faults.antithetic)(), arrays),
    "NoneType, a Population of 9000, float; expected two": (
        faults.Posterior(),
        lambda rng, n: (None, smc.Population(rng.normal(size=9000)), 0.7),
    ),
    "a Population of 5, a Population of 5, float; expected two": (
        faults.CorrectDensity(),
        lambda rng, n: faults.exact_walk(rng, 5),
    ),
    "a Population of 9000; expected two": (
        RandomWalkMove(AR1, 0.7),
        lambda rng, n: smc.Population(rng.normal(size=9000)),
    ),
    "exact(rng, n): it raises AttributeError": (faults.CorrectDensity(), fails),
}


@pytest.mark.parametrize("message", WRONG_EXACT)
def test_wrong_exact_draws_do_not_blame_the_component(message):
    component, exact = WRONG_EXACT[message]
    found = failures_of(component, exact=exact)
    assert found and all(failure.startswith("exact(rng, ") for failure in found.values())
    assert any(message in failure for failure in found.values())


class OtherNames(Update):
    def update(self, g, before, new, y):
        return faults.Posterior().update(g, before, new, y)


def test_components_are_called_by_position():
    assert failures_of(OtherNames()) == {}


OURS = {
    "tempered optimal": Tempered(FearnheadClifford(), 0.0),
    "clusters, optimal inside": ClusterStratified(Gaussian(0.5), 0.3, FearnheadClifford()),
    "tempered, sorted": Tempered(Sorted(), 0.3),
    "tempered, coalesced": Tempered(Coalesced(), 0.3),
}


@pytest.mark.parametrize("calls", ["few", pytest.param("all", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", [*smc.__components__["resampler"], *OURS])
def test_resamplers_of_the_package_keep_their_contract(name, calls, request):
    if calls == "few" or name in OURS:  # other forms of schemes that are tested with all calls
        request.getfixturevalue("fewer_calls")
    scheme = OURS.get(name) or REGISTRY.build("resampler", name)
    results = run_contract(scheme)
    assert [r for r in results if r.failure or r.remark] == []
    outcomes = {r.name: r.skipped is None for r in results}
    assert outcomes["carried_weight"] == scheme.properly_weighted


def test_resamplers_work_on_other_particles(fewer_calls):
    for example in (
        lambda rng, n: (Population({"x": rng.standard_normal((n, 2)), "k": rng.integers(0, 5, n)}), None),
        lambda rng, n: (Population(tuple(f"particle {i}" for i in range(n))), None),
    ):
        assert failures_of(Coalesced(), example) == {}


def vectors(rng, n):
    return Population(rng.standard_normal((n, 1)), rng.standard_normal(n)), [0.4]


def traces(rng, n):
    return Population({"x": rng.standard_normal(n)}, rng.standard_normal(n)), 0.4


@pytest.mark.parametrize(
    ("component", "example", "exact"),
    [
        (Dynamics(MODEL), vectors, None),
        (Prior(MODEL), None, None),
        (Reweight(MODEL.log_likelihood), vectors, None),
        pytest.param(RandomWalkMove(AR1, 0.7), None, faults.exact_ar1, marks=pytest.mark.nightly),
        (ArrayCodec(), traces, None),
        (HypothesisCodec(), scene_example, None),
    ],
    ids=lambda value: type(value).__name__,
)
def test_components_of_models_keep_their_contract(component, example, exact):
    assert failures_of(component, example, exact) == {}


KINDS = ["trigger", "size", "similarity", "equivalence", "evidence", "transition", "proposal", "update"]
KINDS += ["completer", "rule"]
#: Trackers take seconds; test_known_truth.py has their main property.
SLOW = {"transition": ["tracking"], "rule": ["mst", "authors"]}


@pytest.mark.parametrize(
    ("kind", "slow"),
    [(kind, False) for kind in KINDS] + [pytest.param(kind, True, marks=pytest.mark.nightly) for kind in SLOW],
)
def test_components_of_the_package_keep_their_contract(kind, slow):
    """All components but oracles, which need the ground truth of a recording, and front ends, which need files."""
    for name, where in REGISTRY.known(kind).items():
        others = where.startswith(("mstfilter.lab.oracles:", "mstfilter.mst.frontends:"))
        if not others and (name in SLOW.get(kind, ())) == slow:
            assert failures_of(REGISTRY.build(kind, name)) == {}, name


# --- how a contract is run ----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Slow(WeightResampler):
    """Draws by weight, and takes a millisecond for each particle."""

    def select(self, rng, log_weights, n):
        time.sleep(1e-3 * n)
        return Multinomial().select(rng, log_weights, n)


def test_properties_that_take_too_long_are_not_tested():
    seen = []
    results = run_contract(Slow(), budget=6.0, progress=seen.append)
    assert seen == results
    late = {r.name: r.skipped for r in results if r.out_of_time}
    assert late["carried_weight"].startswith("out of time after ")
    assert "out of time" in late["many_particles"]
    assert [r for r in results if r.failure] == []
    assert not next(r for r in results if r.name == "result_is_valid").skipped


def test_an_object_without_an_interface_is_an_error():
    with pytest.raises(InputError, match="no component"):
        run_contract(3)
