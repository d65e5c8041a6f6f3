"""The resampler contract: planted faults are reported, correct resamplers and those of the package pass.

False alarms: each contract has up to four statistical properties at 1e-6, so below 2e-4 for this file.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import pytest

from mstfilter import smc
from mstfilter.mst.testing import run_contract
from mstfilter.runs.presets import REGISTRY
from mstfilter.smc import (
    ClusterStratified,
    Coalesced,
    FearnheadClifford,
    Gaussian,
    Multinomial,
    Population,
    Sorted,
    Tempered,
    WeightResampler,
)
from mstfilter.smc.testing import ResamplerContract, WeightResamplerContract
from tests.mst.testing import faults, run_property
from tests.mst.testing.faults import CORRECT, FAULTS


def failures_of(component, example=None):
    return [r.failure for r in run_contract(component, example) if r.failure]


class TestCorrect(WeightResamplerContract):
    def make(self):
        return faults.Correct()


class TestCorrectWeighted(WeightResamplerContract):
    def make(self):
        return faults.CorrectWeighted()


@pytest.mark.parametrize("scheme", CORRECT, ids=lambda scheme: type(scheme).__name__)
def test_correct_schemes_pass(scheme):
    assert [r for r in run_contract(scheme) if r.failure or r.skipped] == []


@pytest.mark.parametrize(("fault", "name", "words", "exact"), FAULTS)
def test_planted_faults_are_reported(fault, name, words, exact):
    with pytest.raises(AssertionError) as error:
        run_property(fault(), name)
    assert words in str(error.value)


def test_no_planted_fault_is_lost():
    assert len(FAULTS) == 50


OURS = {
    **{name: REGISTRY.build("resampler", name) for name in smc.__components__["resampler"]},
    "tempered optimal": Tempered(FearnheadClifford(), 0.0),
    "clusters, optimal inside": ClusterStratified(Gaussian(0.5), 0.3, FearnheadClifford()),
    "clusters, tempered inside": ClusterStratified(Gaussian(0.5), 0.3, Tempered()),
    "tempered, sorted": Tempered(Sorted(), 0.3),
    "tempered, coalesced": Tempered(Coalesced(), 0.3),
}


@pytest.fixture
def fewer_calls(monkeypatch):
    """A quarter of the calls of schemes that compare particles; the bounds allow for the number of calls."""
    fewer = tuple(replace(case, calls=case.calls // 4) for case in ResamplerContract.cases)
    monkeypatch.setattr(ResamplerContract, "cases", fewer)


@pytest.mark.parametrize("name", OURS)
def test_components_of_the_package_keep_their_contract(name, request):
    if " " in name:  # another form of a scheme that is tested with all calls
        request.getfixturevalue("fewer_calls")
    results = run_contract(OURS[name])
    assert [r for r in results if r.failure or r.remark] == []
    outcomes = {r.name: r.skipped is None for r in results}
    assert outcomes["carried_weight"] == OURS[name].properly_weighted


PARTICLES = {
    "vectors": lambda rng, n: (Population(rng.standard_normal((n, 2))), None),
    "mappings": lambda rng, n: (Population({"x": rng.standard_normal(n), "k": rng.integers(0, 5, n)}), None),
    "objects": lambda rng, n: (Population(tuple(f"particle {i}" for i in range(n))), None),
}


@pytest.mark.parametrize("kind", PARTICLES)
def test_resamplers_work_on_other_particles(kind, fewer_calls):
    assert failures_of(Coalesced(), PARTICLES[kind]) == []


def test_uniform_numbers_at_the_ends_are_a_remark():
    result = next(r for r in run_contract(faults.ZeroAtTheEdge()) if r.name == "zero_weights_are_never_chosen")
    assert result.failure is None
    assert "gives 0, of weights (0, 0, 1, 2, 3) it selects particle 0, weight 0" in result.remark


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
