"""The resampler contract: planted faults are reported, correct resamplers and those of the package pass.

False alarms: each contract has up to four statistical properties at 1e-6, so below 2e-4 for this file.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from mstfilter import smc
from mstfilter.presets import REGISTRY
from mstfilter.smc import ClusterStratified, Coalesced, FearnheadClifford, Gaussian, Population, Sorted, Tempered
from mstfilter.smc.testing import ResamplerContract, WeightResamplerContract
from mstfilter.testing import run_contract
from tests.testing import faults, run_property
from tests.testing.faults import CORRECT, FAULTS


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
    assert len(FAULTS) == 51


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
    assert [r for r in results if r.failure] == []
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
