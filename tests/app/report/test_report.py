"""The report of a run: self-contained, made from the folder alone, deterministic, for all kinds of runs."""

from __future__ import annotations

import functools
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from mstfilter.app.report import run_report, viewpoint
from mstfilter.app.report.answer import answers_of_run
from mstfilter.app.report.run_numbers import read_numbers
from mstfilter.app.report.run_report import write_report
from mstfilter.app.report.scenes import scenes_of_run
from mstfilter.base.errors import InputError
from mstfilter.mst.belief import Belief
from mstfilter.runs import HypothesisCodec, RunFolder
from mstfilter.scene import Hypothesis, project, render
from mstfilter.scoring import BeliefScore, read_truth, score_pauses, weighted_coverage
from mstfilter.smc import Key, Population, State, save_state
from tests.app.report.pages import Page
from tests.app.report.runs import CAMERA, GRID, labels_of, make_run, recording, truth_at


def read(path):
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


@pytest.fixture(scope="module", autouse=True)
def small_pictures():
    """Voxel pictures of 120 x 90 pixels; nothing here depends on their size, and large ones take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_report, "viewpoint", functools.partial(viewpoint, width=120, height=90))
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run = make_run(tmp_path_factory.mktemp("report") / "run")
    return run, write_report(run)


def test_label_images_without_volumes_give_the_quality_in_the_image(tmp_path):
    """The numbers are those of `mstfilter.scoring.score_pauses`, beside both floors."""
    film = replace(recording(2, truth=False), instance=lambda i: render(truth_at(i), GRID, CAMERA).labels)
    run = make_run(tmp_path / "run", 2, film=film)
    expected = [row for row in score_pauses(run.estimates(), read_truth(film)) if row.form == "objects"]
    numbers = read_numbers(run)
    found = [step.image_score for step in numbers.steps]
    assert [(s.mean, s.best, s.one_blob, s.components) for s in found] == [
        (s.mean, s.best, s.one_blob, s.components) for s in expected
    ]
    page = write_report(run).read_text()
    assert f"the mean quality of the hypotheses is {expected[1].mean:.2f} of 1" in page
    assert "Quality in the image" in page and "no quality is shown" not in page
    assert all(f"{row.mean:.3f}" in page for row in expected)


def test_the_page_is_self_contained(finished):
    run, path = finished
    assert path == run.path / "report.html"
    text, page = read(path)
    # The only script is in a frame that cannot reach the page.
    assert "script" not in page.tags and "link" not in page.tags and page.tags.count("iframe") == 1
    assert 'sandbox="allow-scripts"' in text
    for link in page.links:
        assert link.startswith(("data:image/", "data:model/gltf-binary;base64,", "#")), link[:80]
        if link.startswith("#"):
            assert link[1:] in page.ids
    bare = re.sub(r'xmlns(:\w+)?="[^"]*"', "", text)
    bare = re.sub(r"data:(image|model)/[\w-]+;base64,[A-Za-z0-9+/=]+", "", bare)
    assert not re.search(r"https?:|file:|//\w|@import|\burl\((?!#)", bare)
    assert str(run.path) not in text and str(run.path.parent) not in text


def test_text_of_the_user_is_escaped(finished):
    _, path = finished
    text, page = read(path)
    assert "<b>odd" not in text and "</script>" not in text
    assert "<b>odd & named</b>" in page.text


def test_only_times_differ_between_equal_runs(finished, tmp_path):
    _run, path = finished
    again = make_run(tmp_path / "again")
    assert write_report(again).read_bytes() == path.read_bytes()
    (again.pause(1) / "seconds.json").write_text(json.dumps({"transition": 60.5, "proposal": 1.0}))
    other = read(write_report(again))[1].text
    assert other != read(path)[1].text and "62 s" in other
    pictures = [re.findall(r"data:image[^\"]*", p.read_text()) for p in (path, again.path / "report.html")]
    assert pictures[0] == pictures[1]


@pytest.mark.parametrize(
    "kind",
    [{"pauses": 1, "empty": True}, {"pauses": 1, "truth": False}],
)
def test_kinds_of_runs(kind, tmp_path):
    _text, page = read(write_report(make_run(tmp_path / "run", **kind)))
    if not kind.get("truth", True):
        assert "no ground truth" in page.text and "one blob" not in page.text and "Truth" not in page.text
    if kind.get("pauses") == 1:
        assert "say at the last of 1 pause · " in page.text
    if kind.get("empty"):
        assert "0 objects in view. No border is open." in page.text


@pytest.mark.nightly
def test_truth_at_some_pauses_only(tmp_path):
    run = make_run(tmp_path / "run", pauses=2)
    (run.pause(1) / "truth.npz").unlink()
    info = run.info(1)
    (run.pause(1) / "info.json").write_text(json.dumps({**info, "quality": None}))
    _, page = read(write_report(run))
    assert "Quality against the ground truth" in page.text


def test_interrupted_runs(tmp_path):
    run = make_run(tmp_path / "run", done=False)
    shutil.rmtree(run.pause(2))
    run.set_status("interrupted")
    _, page = read(write_report(run))
    assert "The run was interrupted: 2 of 3 pauses are complete." in page.text
    shutil.rmtree(run.path / "pauses")
    _, page = read(write_report(run))
    assert "0 of 3 pauses" in page.text and "Full configuration" in page.text


def test_the_first_picture_is_the_estimate(tmp_path):
    """Of hypotheses with equal weights the first is a random draw; the estimate agrees best with all of them."""
    run = make_run(tmp_path / "run", pauses=1)
    odd, one, other = (labels_of(*boxes) for boxes in (((0, 0, 2),), ((8, 8, 4),), ((8, 8, 5),)))
    made = tuple(Hypothesis.from_labels(labels, GRID) for labels in (odd, one, other))
    save_state(run.pause(0) / "state.npz", State(1, Population(made), Key(7), False), HypothesisCodec())
    info = run.info(0) | {"weights": [1 / 3] * 3}
    (run.pause(0) / "info.json").write_text(json.dumps(info))
    estimate = Belief(run.state(0).population).estimate()
    assert estimate.key in (made[1].key, made[2].key)
    views = scenes_of_run(run)[0].views
    assert views[0].hypothesis.key == estimate.key and views[0].text.startswith("estimate, weight 0.33")
    assert [view.members for view in views[1:-1]] == [(k,) for k in range(3) if (k,) != views[0].members]
    identity = views[0].identity
    shown = [one.number for one in answers_of_run(run)[0][0].table if one.in_estimate]
    assert shown == [identity[record.label] + 1 for record in estimate.objects]
    assert "The estimate, shown by 1 of 3" in read(write_report(run))[1].text


def test_errors(tmp_path):
    with pytest.raises(InputError, match="not a run folder"):
        write_report(tmp_path)
    run = make_run(tmp_path / "run", pauses=1)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write report"):
        write_report(RunFolder.open(run.path), tmp_path / "file" / "report.html")


def test_a_run_that_uses_the_ground_truth_is_marked(finished, tmp_path):
    assert "uses the ground truth" not in read(finished[1])[1].text
    run = make_run(tmp_path / "run", pauses=1)
    description = json.loads((run.path / "run.json").read_text())
    (run.path / "run.json").write_text(json.dumps({**description, "uses_truth": ["TrueMasks"]}))
    page = read(write_report(run))[1].text
    assert "uses the ground truth" in page and "from images alone: TrueMasks" in page


def test_the_quality_is_explained(finished):
    """Objects that are right in the image and too deep in the volume: outlines agree, volume is invented."""
    run, path = finished
    numbers = read_numbers(run)
    last = numbers.steps[-1]
    truth, hypotheses = run.truth(2), run.hypotheses(2)
    invented = np.mean([np.sum((h.labels > 0) & (truth == 0)) / np.sum(truth > 0) for h in hypotheses])
    missed = np.mean([np.sum((h.labels == 0) & (truth > 0)) / np.sum(truth > 0) for h in hypotheses])
    assert last.metrics["volume_invented"] == pytest.approx(invented)
    assert f"{100 * missed:.0f} % is missed and {100 * invented:.0f} % is invented" in read(path)[1].text
    views = [project(h, run.camera(2)) for h in hypotheses]
    seen = project(Hypothesis.from_labels(truth, hypotheses[0].grid), run.camera(2))
    assert last.in_image == pytest.approx(np.mean([weighted_coverage(view, seen) for view in views]))


def test_notes_that_a_stage_passes_on_are_shown_once(tmp_path):
    run = make_run(tmp_path / "run", pauses=1)
    info = run.info(0)
    info["notes"] = {"proposal": {"passed": 1, "changed": 1}, "resampler": {"passed": 1, "changed": 2, "own": 3}}
    (run.pause(0) / "info.json").write_text(json.dumps(info))
    step = read_numbers(run).steps[0]
    assert step.notes("resampler") == {"changed": 2, "own": 3}


def test_compared_runs_stand_beside_the_run(tmp_path):
    """In the summary, the table and the figure."""
    run = make_run(tmp_path / "run", pauses=2)
    other = make_run(tmp_path / "run" / "compare" / "without-past", pauses=1)
    assert list(run.compared()) == ["without past"]
    assert read_numbers(run).steps[0].compared == {"without past": np.mean(other.info(0)["quality"]["objects"])}
    text, _ = read(write_report(run))
    assert "without past" in re.search(r'<svg class="figure".*?</svg>', text, flags=re.S)[0]


def with_comparison(path, quality, loss):
    """Numbers of a run whose quality and log loss are 0.5, beside a single frame with the given ones."""
    numbers = read_numbers(make_run(path, pauses=2))
    belief = BeliefScore({"log_loss": 0.5}, np.zeros((1, 1001, 2), np.int32))
    beside = {"compared": {"single frame": quality}, "compared_losses": {"single frame": loss}, "belief": belief}
    steps = [replace(s, info={**s.info, "quality": {"objects": [0.5]}}, **beside) for s in numbers.steps]
    return replace(numbers, steps=tuple(steps))


def test_the_value_of_the_past_is_told_without_a_verdict(tmp_path):
    first = with_comparison(tmp_path / "run", 0.6, 0.4).value_of_the_past[0]
    assert "quality is 0.50 with earlier images and 0.60 from each image alone" in first
    assert "log loss is 0.50 and 0.40 nats" in first and "One recording cannot tell" in first


def test_the_log_loss_of_compared_runs_is_that_of_their_hypotheses(tmp_path):
    """The same hypotheses have the same log loss; without a single frame there is no sentence about it."""
    run = make_run(tmp_path / "run", pauses=2)
    assert read_numbers(run).value_of_the_past == []
    make_run(tmp_path / "run" / "compare" / "single-frame", pauses=2)
    known = [step for step in read_numbers(run).steps if step.belief is not None]
    assert known
    assert all(step.compared_losses == {"single frame": step.belief.row["log_loss"]} for step in known)
