"""Arms of the error budget: each changes its stage of mst and nothing else, and the experiment holds all of them."""

from __future__ import annotations

import pytest

from mstfilter.lab.oracles import uses_truth
from mstfilter.lab.oracles.stages import STAGES
from mstfilter.runs.presets import build_filter, describe_filter, load_config
from tests.lab.baselines.test_presets import differences

#: A filter without any estimate: true masks need no boundary, and the best candidates are selected.
PERFECT_STAGES = ("masks", "completion", "motions", "partition", "free space", "selection")
MST = describe_filter(build_filter(load_config("mst")))


def overrides_of(*stages):
    """Overrides of `mst` that replace several stages, in the order of `STAGES`."""
    return tuple(change for stage in STAGES if stage in stages for change in STAGES[stage])


WHERE = {
    "boundary": ["proposal.boundary"],
    "masks": ["proposal"],
    "completion": ["update.completer"],
    "motions": ["transition"],
    "choice": ["update.evidence", "update.n_scored"],
    "partition": ["update.pairs"],
    "free space": ["update.free_space"],
    "selection": ["resampler", "update.evidence"],
}


def described(*overrides):
    return describe_filter(build_filter(load_config("mst", overrides)))


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_changes_only_itself(stage):
    config = described(*overrides_of(stage))
    assert sorted(differences(config, MST)) == sorted(WHERE[stage])
    for slot, fields in {
        "proposal": ("completer", "objects", "threshold"),
        "transition": ("warp",),
    }.items():
        if [slot] == WHERE[stage]:  # another component stands there: what both have is the same
            for field in fields:
                assert config[slot][field] == MST[slot][field], (slot, field)


def test_with_all_stages_replaced_nothing_is_estimated():
    filter = build_filter(load_config("mst", overrides_of(*PERFECT_STAGES)))
    assert set(uses_truth(filter)) == {
        "TrueMotions",
        "TrueMasks",
        "TrueCompletion",
        "TruePairs",
        "TrueFreeSpace",
        "TrueQuality",
    }
    assert filter.transition.warp.method == "smooth"
    for left in PERFECT_STAGES:
        fewer = described(*overrides_of(*(s for s in PERFECT_STAGES if s != left)))
        assert differences(fewer, describe_filter(filter)), left
