"""The resampler contract: planted faults are reported, correct resamplers and those of the package pass.

False alarms: each contract has three statistical properties at 1e-6, so below 2e-4 for this file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mstfilter import smc
from mstfilter.presets import REGISTRY
from mstfilter.smc import (
    ClusterStratified,
    Coalesced,
    EnsembleTransform,
    FearnheadClifford,
    Gaussian,
    Population,
    Residual,
    Shuffled,
    Sorted,
    Tempered,
    TransformResampler,
)
from mstfilter.testing import (
    ResamplerContract,
    WeightResamplerContract,
    contract_of,
    number_example,
    run_contract,
)
from mstfilter.testing.contract import restore_global_state
from mstfilter.testing.resampling import makes_particles
from tests.testing.faults import (
    CORRECT,
    FAULTS,
    Correct,
    CorrectWeighted,
    ForgetsAncestors,
    MeansByOrder,
    Rejection,
)


class TestCorrect(WeightResamplerContract):
    def make(self):
        return Correct()


class TestCorrectWeighted(WeightResamplerContract):
    def make(self):
        return CorrectWeighted()


@pytest.mark.parametrize("scheme", CORRECT, ids=lambda scheme: type(scheme).__name__)
def test_correct_schemes_pass(scheme):
    results = run_contract(scheme)
    assert [r for r in results if r.failure] == []
    assert all("too slow" in r.skipped for r in results if r.skipped)


def test_what_costs_too_much_is_left_out_by_count():
    results = run_contract(Rejection())
    assert [r for r in results if r.failure] == []
    skipped = {r.name: r.skipped for r in results if r.skipped}
    assert skipped.keys() == {"largest_weight", "many_particles"}
    assert "too slow at this weight" in skipped["largest_weight"]
    assert "max w / mean w = 1e5" in skipped["many_particles"]


def failure_of(component, name):
    """The message of one test of the contract, without the others."""
    contract = type("Contract", (contract_of(type(component)),), {"make": lambda self: component})()
    contract.setup_method()
    with pytest.raises(AssertionError) as error:
        getattr(contract, f"test_{name}")()
    restore_global_state(contract._global_state)
    return str(error.value)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.__name__)
def test_planted_faults_are_reported(fault):
    name, words = FAULTS[fault]
    assert words in failure_of(fault(), name)


def test_a_missing_ancestor_is_no_new_particle():
    assert makes_particles(MeansByOrder(), number_example)
    assert not makes_particles(ForgetsAncestors(), number_example)
    assert not makes_particles(Correct(), number_example)


def test_the_global_generators_are_restored():
    from tests.testing.faults import GlobalGenerator

    before = np.random.get_state()[1].copy()  # noqa: NPY002
    run_contract(GlobalGenerator())
    np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002


OURS = {
    **{name: REGISTRY.build("resampler", name) for name in smc.__components__["resampler"]},
    "mean partition": Sorted(order="mean_partition"),
    "residual, stratified": Residual("stratified"),
    "residual, systematic": Residual("systematic"),
    "tempered optimal": Tempered(FearnheadClifford(), 0.0),
}
# Other forms of schemes above that compare particles and are slow.
SLOW = {
    "clusters, wide": ClusterStratified(Gaussian(5.0)),
    "clusters, optimal inside": ClusterStratified(Gaussian(0.5), 0.3, FearnheadClifford()),
    "clusters, tempered inside": ClusterStratified(Gaussian(0.5), 0.3, Tempered()),
    "tempered, sorted": Tempered(Sorted(), 0.3),
    "shuffled, sorted": Shuffled(Sorted()),
    "coalesced residual": Coalesced(Residual()),
}


@pytest.fixture
def fewer_calls(monkeypatch):
    """A quarter of the calls of the statistical tests, whose bounds allow for the number of calls."""
    fewer = tuple(replace(case, calls=case.calls // 4) for case in ResamplerContract.cases)
    monkeypatch.setattr(ResamplerContract, "cases", fewer)


@pytest.mark.parametrize("name", OURS)
def test_components_of_the_package_keep_their_contract(name):
    check(OURS[name])


@pytest.mark.parametrize("name", SLOW)
def test_slow_components_of_the_package_keep_their_contract(name, fewer_calls):
    check(SLOW[name])


def check(component):
    results = run_contract(component)
    assert [r for r in results if r.failure] == []
    outcomes = {r.name: r.skipped is None for r in results}
    if isinstance(component, TransformResampler):
        assert outcomes["keeps_the_weighted_mean"]
    else:
        assert outcomes["carried_weight"] == component.properly_weighted


def test_resamplers_work_on_other_particles(fewer_calls):
    """Vectors, mappings and objects."""

    def vectors(rng, n):
        return Population(rng.standard_normal((n, 2))), None

    def mapping(rng, n):
        return Population({"x": rng.standard_normal(n), "k": rng.integers(0, 5, n)}), None

    def objects(rng, n):
        return Population(tuple(f"particle {i}" for i in range(n))), None

    for scheme, example in ((ClusterStratified(), vectors), (Coalesced(), mapping), (Coalesced(), objects)):
        assert [r for r in run_contract(scheme, example) if r.failure] == []


@dataclass(frozen=True)
class Mixture(TransformResampler):
    """New particles by optimal transport, with planted faults."""

    fault: str = ""

    def resample(self, rng, population, n):
        made = EnsembleTransform().resample(rng, population, n)
        if self.fault == "ignores weights":
            flat = population.reweighted(population.log_mean_weight - population.log_weights)
            made = EnsembleTransform().resample(rng, flat, n)
        if self.fault == "sum of weights":
            return made.reweighted(np.full(n, np.log(len(population) / n)))
        if self.fault == "jitter":
            return made.moved(made.particles + 0.01 * rng.standard_normal(n))
        if self.fault == "collapse":
            return made.moved(0 * made.particles + made.particles.mean())
        if self.fault == "ancestors":
            return made.with_ancestors(np.zeros(n, int))
        return made.take(np.arange(max(n - 1, 1))) if self.fault == "one less" else made


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("", None),
        ("ignores weights", "has mean"),
        ("sum of weights", "log mean of the old weights"),
        ("jitter", "has mean"),
        ("ancestors", "parents ['ancestor']"),
        ("collapse", "the variance of the particles changes"),
        ("one less", "it returns"),
    ],
)
def test_contract_of_resamplers_that_make_particles(fault, words):
    failures = [r.failure for r in run_contract(Mixture(fault)) if r.failure]
    assert not failures if words is None else any(words in failure for failure in failures), failures
