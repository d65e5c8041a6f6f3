"""Faulty programs are named errors, correct ones run."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

from mstfilter.errors import InputError
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
    if "torch" in name:
        pytest.importorskip("torch", reason="torch cannot be imported", exc_type=ImportError)
    for seed in range(3):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.isfinite(filter.run(ys, seed)[0].log_evidence)


def test_few_faults_run_without_an_error():
    for filter, ys, _ in INHERENT.values():
        filter.run(ys, 0)
    assert len(FAULTY) >= 60 and len(CORRECT) >= 30 and len(INHERENT) <= 5
