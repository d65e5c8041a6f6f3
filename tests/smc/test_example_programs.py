"""The example programs run."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from tests.conftest import REPOSITORY

PROGRAMS = sorted((REPOSITORY / "models" / "programs").glob("*.py"))


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda p: p.stem)
def test_every_filter_of_every_program_runs(path):
    module = runpy.run_path(str(path))
    if "filters" not in module:
        pytest.skip("is no program with filters()")
    observations = module["simulate"](6)[-1]
    for filter in module["filters"](30).values():
        state, _ = filter.run(observations, 0)
        assert np.isfinite(state.log_evidence)
        again, _ = filter.run(observations, 0)
        assert again.log_evidence == state.log_evidence


def test_the_object_chain_agrees_with_the_forward_algorithm():
    """Only the number of boxes matters for the counts: a birth-death chain, summed exactly."""
    from scipy import stats

    module = runpy.run_path(str(REPOSITORY / "models" / "programs" / "object_hmm.py"))
    counts = [1, 1, 2]
    size = np.zeros(8)
    size[0], total = 1.0, 0.0
    for count in counts:
        moved = 0.5 * size
        moved[1:] += 0.3 * size[:-1]
        moved[:-1] += 0.2 * size[1:]
        moved[0] += 0.2 * size[0]
        size = moved * stats.binom.pmf(count, np.arange(8), 0.8)
        total += np.log(size.sum())
        size /= size.sum()
    filter = module["filters"](120)["bootstrap"]
    ratios = np.exp([filter.run(counts, seed)[0].log_evidence - total for seed in range(60)])
    assert abs(ratios.mean() - 1) < 4 * ratios.std(ddof=1) / np.sqrt(len(ratios))
