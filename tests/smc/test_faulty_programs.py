"""Faulty programs are named errors, correct ones run."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from scipy import stats

from mstfilter.base.errors import InputError
from mstfilter.smc import Distribution, Normal, Program, observe, sample
from mstfilter.smc.testing import ModelContract, check_properties
from mstfilter.smc.testing.models import check_density
from tests.smc.faulty_programs import CORRECT, FAULTY, INHERENT

#: Faults that the first steps of a run do not show, mostly because few particles are examined there.
FOUND_BY_CHECK = {
    "a_guide_with_a_maximum",
    "the_time",
    "a_running_maximum_of_an_object",
    "a_running_maximum_of_a_method",
    *(f"a_distribution_{name}" for name in ("OtherSign", "Density", "Unnormalised", "Variance")),
}


def failures(filter, ys):
    """What the contract of models says about a filter."""
    contract = type("Contract", (ModelContract,), {"observations": ys})
    return [result.failure for result in check_properties(filter, contract) if result.failure]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", [name for name in FAULTY if name not in FOUND_BY_CHECK])
def test_a_fault_is_a_named_error_of_a_run(name):
    filter, ys, expected = FAULTY[name]
    with pytest.raises(InputError) as caught:
        filter.run(ys, 0)
    text = " ".join([caught.value.message, *caught.value.hints])
    assert re.search(expected, text), text
    assert re.match(r"step \d, (initial|transition|update|lookahead)", text), text


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", FAULTY)
def test_check_names_every_fault(name):
    filter, ys, _ = FAULTY[name]
    assert failures(filter, ys)


#: Programs and distributions that take seconds to check.
SLOW = ("a_network_in_single_precision", "many peaks")


def fast_or_nightly(names):
    return [pytest.param(name, marks=[pytest.mark.nightly] * (name in SLOW)) for name in names]


@pytest.mark.parametrize("name", fast_or_nightly(CORRECT))
def test_check_finds_nothing_in_a_correct_program(name):
    assert failures(*CORRECT[name]) == []


@pytest.mark.parametrize("name", CORRECT)
def test_a_correct_program_runs(name):
    filter, ys = CORRECT[name]
    for seed in range(3):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.isfinite(filter.run(ys, seed)[0].log_evidence)


def test_a_fault_is_found_again_when_the_program_runs_again():
    def program(previous, y):
        x = sample("x", Normal(0.0, 1.0))
        observe("y", Normal(x - x.mean(), 1.0), y)

    filter = Program(program).bootstrap(50)
    for _ in range(4):
        with pytest.raises(InputError, match="alone"):
            filter.run([0.5], 0)


def test_a_guide_far_narrower_than_the_posterior_is_a_fault():
    def model(previous, y):
        observe("y", Normal(sample("x", Normal(0.0, 1.0)), 0.5), y)

    def guide(previous, y):
        sample("x", Normal(0.8 * y, 0.01))

    (fault,) = failures(Program(model).guided(guide, 500), [0.3, 0.1])
    assert re.search(r"evidence that is \S+ nats too small: it is narrower", fault)


def test_few_faults_run_without_an_error():
    for filter, ys, _ in INHERENT.values():
        filter.run(ys, 0)
    assert len(FAULTY) >= 60 and len(CORRECT) >= 20 and len(INHERENT) <= 5


class Of(Distribution):
    """A distribution of the user from one of scipy."""

    def __init__(self, draws, density=None):
        self.draws, self.density = draws, density or draws.logpdf

    mean = np.zeros(())

    def sample(self, rng, size):
        return self.draws.rvs(size=size, random_state=rng)

    def log_prob(self, value):
        return self.density(value)


class Peaks:
    """Narrow peaks that are far apart."""

    def __init__(self, n):
        self.centres = 100.0 * np.arange(n)

    def rvs(self, size, random_state):
        return random_state.normal(0, 0.01, size) + self.centres[random_state.integers(0, len(self.centres), size)]

    def logpdf(self, x):
        each = stats.norm(self.centres[:, None], 0.01).logpdf(np.ravel(x))
        return np.logaddexp.reduce(each, axis=0).reshape(np.shape(x)) - np.log(len(self.centres))


SKEWED = {
    "gamma": stats.gamma(0.5),
    "beta": stats.beta(0.5, 0.5),
    "half Cauchy": stats.halfcauchy(),
    "lognormal": stats.lognorm(2.0),
    "Pareto": stats.pareto(1),
    "exponential": stats.expon(),
    "two peaks": Peaks(2),
    "many peaks": Peaks(150),
    "poles": stats.beta(0.1, 0.1),
    "almost a point": stats.gamma(0.01),
    "tiny": stats.norm(0, 1e-160),
}


@pytest.mark.parametrize("name", fast_or_nightly(SKEWED))
def test_heavy_tails_poles_and_jumps_of_a_density_are_no_fault(name):
    for seed in range(2):
        check_density("x", Of(SKEWED[name]), np.random.default_rng(seed))


@pytest.mark.parametrize(
    "density",
    [stats.norm(0, 2).logpdf, stats.norm(0.5).logpdf, lambda x: -x * x / 2, stats.norm().pdf],
    ids=["scale", "shift", "not normalised", "no log"],
)
def test_a_density_of_other_draws_is_a_fault(density):
    with pytest.raises(AssertionError, match="do not have its density"):
        check_density("x", Of(stats.norm(), density), np.random.default_rng(0))
