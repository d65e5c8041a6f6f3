"""The example of docs/front-ends.md on masks of a small simulated recording, degraded in three ways."""

from __future__ import annotations

import re

import numpy as np

import mstfilter
from mstfilter.frontends import write_masks
from mstfilter.oracles import TrueMasks, bind_truth, degrade
from mstfilter.simulation import cached_recording
from mstfilter.smc import Key
from tests.conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "front-ends.md").read_text()
#: Shares of splits and of merges among the errors; the rest displaces borders.
WAYS = [(1.0, 0.0), (0.0, 1.0), (0.0, 0.0)]


def test_the_estimate_is_better_than_the_best_alternative(tmp_path, monkeypatch, capsys):
    """Quality of the estimate at the last pause, against each alternative alone, completed in the same way."""
    monkeypatch.chdir(tmp_path)
    recording = mstfilter.open_recording(cached_recording("demo", 0))
    true = bind_truth(TrueMasks(), recording)
    masks = {}
    for clip in recording.clips():
        shown = true.masks(clip.after, clip)
        masks[clip.after.rgb.tobytes()] = [
            degrade(Key(0).child(k).generator(), shown, 0.7, *WAYS[k]) for k in range(3)
        ]
    example = next(b for b in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL) if "write_masks" in b)
    assert len([line for line in example.splitlines() if line.strip()]) <= 10
    given = {"mstfilter": mstfilter, "recording": recording, "segment": lambda rgb: masks[rgb.tobytes()]}
    exec(compile(example, "front-ends.md", "exec"), given)
    assert "{" in capsys.readouterr().out
    clip = recording.clips()[-1]
    truth = recording.truth(clip.index)
    alone = []
    for k in range(3):
        write_masks(f"alone{k}", clip.index, [masks[clip.after.rgb.tobytes()][k]])
        proposal = mstfilter.preset("single_frame", "proposal=mask_folder", f"proposal.folder=alone{k}").proposal
        (hypothesis,) = proposal.sample(np.random.default_rng(0), clip, 1).particles
        alone.append(mstfilter.weighted_coverage(hypothesis.labels, truth))
    assert mstfilter.weighted_coverage(given["belief"].estimate().labels, truth) > max(alone)
