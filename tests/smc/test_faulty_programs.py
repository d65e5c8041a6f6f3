"""Faulty programs are named errors, correct ones run."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

from mstfilter.errors import InputError, InputWarning
from mstfilter.smc import Normal, Program, observe, sample
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
