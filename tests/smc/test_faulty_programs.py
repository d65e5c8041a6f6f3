"""Faulty programs are named errors, correct ones run."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from scipy import stats

from mstfilter.errors import InputError, InputWarning
from mstfilter.smc import Distribution, Normal, Program, observe, sample
from tests.smc.faulty_programs import CORRECT, FAULTY, INHERENT


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", FAULTY)
def test_a_fault_is_a_named_error(name):
    filter, ys, expected = FAULTY[name]
    with pytest.raises(InputError) as caught:
        filter.run(ys, 0)
    text = " ".join([caught.value.message, *caught.value.hints])
    assert re.search(expected, text), text
    assert re.match(r"step \d, (initial|transition|update|lookahead)", text), text


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


def test_a_guide_far_narrower_than_the_posterior_warns():
    def model(previous, y):
        observe("y", Normal(sample("x", Normal(0.0, 1.0)), 0.5), y)

    def guide(previous, y):
        sample("x", Normal(0.8 * y, 0.01))

    with pytest.warns(InputWarning, match=r"differ by -[\d.]+ nats[\s\S]*narrower"):
        Program(model).guided(guide, 500).run([0.3], 0)


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


def run_with(distribution, seed):
    kind = type("Kind", (Of,), {})  # each class is tested once

    def program(previous, y):
        x = sample("x", kind(distribution.draws, distribution.density))
        observe("y", Normal(np.clip(x, -3, 3), 1.0), y)

    Program(program).bootstrap(20).run([0.5], seed)


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


@pytest.mark.parametrize("name", SKEWED)
def test_heavy_tails_poles_and_jumps_of_a_density_are_no_fault(name):
    for seed in range(5):
        run_with(Of(SKEWED[name]), seed)


@pytest.mark.parametrize(
    "density",
    [stats.norm(0, 2).logpdf, stats.norm(0.5).logpdf, lambda x: -x * x / 2, stats.norm().pdf],
    ids=["scale", "shift", "not normalised", "no log"],
)
def test_a_density_of_other_draws_is_a_fault(density):
    with pytest.raises(InputError, match="do not have its density"):
        run_with(Of(stats.norm(), density), 0)
