"""The example of docs/front-ends.md on masks of a small simulated recording with three kinds of errors."""

from __future__ import annotations

import re

import numpy as np
import pytest

import mstfilter
from mstfilter.lab.oracles import TrueMasks, bind_truth
from mstfilter.lab.simulation import cached_recording
from mstfilter.mst.frontends import write_masks
from mstfilter.runs import filter_recording
from mstfilter.runs.presets import load_config
from tests.conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "front-ends.md").read_text()


def wrong(masks):
    """Masks (H, W) with objects cut in two, with two objects merged, and with all borders moved by three pixels."""
    halves = np.where(np.arange(masks.shape[1]) < np.nonzero(masks)[1].mean(), masks, 2 * masks.max() - masks + 1)
    first, second, *_ = np.unique(masks[masks > 0])
    moved = np.where(masks > 0, np.roll(masks, 3, axis=1), 0)
    return [np.where(masks > 0, halves, 0), np.where(masks == second, first, masks), moved]


def test_all_pauses_are_checked_before_a_run(tmp_path):
    """A missing file of a later pause is found before the folder of the run is made."""
    recording = mstfilter.open_recording(cached_recording("demo", 0, n_actions=1))
    write_masks(tmp_path / "masks", 0, [recording.instance(0) * 0])
    folder = f"folder={tmp_path / 'masks'}"
    for overrides, message in (
        (("proposal=mask_folder", f"proposal.{folder}"), "no masks for pause 1"),
        (("proposal.completer=external", f"proposal.completer.{folder}"), "none for pause 1"),
        (("proposal.boundary=cob", "proposal.boundary.weights=none"), "do not exist"),
        (("proposal.tree=cob", "proposal.tree.contours.weights=none"), "do not exist"),
        (("transition.tracker=siammask", "transition.tracker.weights=none"), "do not exist"),
        (("transition.tracker=sam2", "transition.tracker.checkpoint=none"), "do not exist"),
    ):
        with pytest.raises(mstfilter.InputError, match=message):
            filter_recording(recording, load_config("mst", overrides), tmp_path / "run")
        assert not (tmp_path / "run").exists()


@pytest.mark.nightly
def test_the_estimate_is_better_than_the_best_alternative(tmp_path, monkeypatch, capsys):
    """Mean quality of the estimate of three seeds at the last pause, against each alternative, completed likewise."""
    monkeypatch.chdir(tmp_path)
    recording = mstfilter.open_recording(cached_recording("demo", 0, n_actions=1))
    true = bind_truth(TrueMasks(), recording)
    masks = {clip.after.rgb.tobytes(): wrong(true.masks(clip.after, clip)) for clip in recording.clips()}
    cells = re.findall(r"```\{code-cell\}\n(?::[^\n]*\n)*(.*?)```", PAGE, flags=re.DOTALL)
    example = next(cell for cell in cells if "write_masks" in cell)
    given = {"mstfilter": mstfilter, "recording": recording, "segment": lambda rgb: masks[rgb.tobytes()]}
    exec(compile(example, "front-ends.md", "exec"), given)
    assert "{" in capsys.readouterr().out
    clip = recording.clips()[-1]
    truth = recording.truth(clip.index)
    alone = []
    for k in range(3):
        write_masks(f"alone{k}", clip.index, [masks[clip.after.rgb.tobytes()][k]])
        proposal = mstfilter.preset(
            "single_frame", "proposal=mask_folder", f"proposal.folder=alone{k}", "proposal.completer=network"
        ).proposal
        (hypothesis,) = proposal.sample(np.random.default_rng(0), clip, 1).particles
        alone.append(mstfilter.weighted_coverage(hypothesis.labels, truth))
    runs = [given["filter"].run(recording.clips(), seed)[0] for seed in (0, 1, 2)]
    estimates = [mstfilter.Belief(state.population).estimate().labels for state in runs]
    assert np.mean([mstfilter.weighted_coverage(labels, truth) for labels in estimates]) > max(alone)
