"""The study of real groups: its score by hand, its constants, its small form, its committed figures."""

from __future__ import annotations

import csv
import importlib.util
import os
import subprocess
import sys
from collections import defaultdict

import numpy as np
import pytest
from scipy.stats import ttest_rel

from mstfilter.presets import describe_filter
from tests.conftest import REPOSITORY, shared_folder

FOLDER = REPOSITORY / "experiments/real_groups"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("real_groups_run", FOLDER / "run.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def lines(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_score_leaves_pixels_without_label_out_and_counts_the_table_as_nothing(study):
    label = np.array([[0, 0, 1, 1, 2, 2, 3, 3]], np.uint8)
    # One blob over both objects and a pixel of the table: every intersection over union is 2 / 5.
    image = np.array([[7, 0, 0, 1, 1, 1, 1, 1]], np.uint16)
    assert study.score(image, label) == pytest.approx(0.4)
    assert study.score(np.array([[9, 9, 0, 0, 5, 5, 4, 4]], np.uint16), label) == 1.0
    assert study.score(np.zeros_like(image), label) == 0.0


def test_changed_is_a_share_of_the_pixels_with_both_readings(study):
    before = np.array([[1.0, 1.0, np.nan, 1.0, 2.0]])
    after = np.array([[1.005, 1.02, 1.0, 1.2, 1.0]])
    assert study.changed(before, after, np.array([[True, True, True, True, False]])) == pytest.approx(2 / 3)
    assert study.changed(before, after, np.zeros((1, 5), bool)) == 0.0


def test_constants_reach_every_front_end(study):
    odd = {"colour_weight": "0.37", "centre": "0.41", "slope": "9.5", "colour_weight_learned": "0.53"}
    for method in study.METHODS:
        described = describe_filter(study.assemble(method, odd))
        assert (described["update"]["component"] == "samples_only") == (method not in study.OWN_SAMPLES), method
        part = described["proposal"]
        part = part.get("proposal", part)
        if method.startswith("floor"):
            assert "boundary" not in part
        elif method.startswith(("paper", "authors")):
            assert (part["tree"]["component"], part["tree"]["centre"], part["tree"]["slope"]) == ("ucm", 0.41, 9.5)
            assert part["boundary"]["colour_weight"] == 0.37
        else:
            assert (part["tree"]["component"], part["boundary"]["colour_weight"]) == ("learned", 0.53)
    assert {study.held_out(g)["frames"] for g in study.GROUPS} == {f"learn{a}-{b}" for a, b in study.GROUPS}


def test_smoke(tmp_path, shared_data):
    shared_data("real/osd_learn/info.json")
    command = [sys.executable, str(FOLDER / "run.py"), "--smoke"]
    environment = {**os.environ, "MSTFILTER_SHARED": str(shared_folder())}
    refused = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert refused.returncode == 2 and "would overwrite the results" in refused.stderr
    for _ in range(2):
        done = subprocess.run([*command, "--out", str(tmp_path)], check=True, capture_output=True, env=environment)
    assert b"s of the processor" not in done.stdout  # the second time nothing is run
    rows = lines(tmp_path / "pauses.csv")
    assert len(rows) == 3 * len(lines(tmp_path / "summary.csv"))
    # Control: without a past the filter is its samples.
    first = {r["method"]: r["quality"] for r in rows if r["pause"] == "0"}
    assert first["mst"] == first["samples_only"] == first["union"] == first["tracking_only"] != first["floor_image"]
    assert first["paper"] == first["paper, samples only"]
    assert first["authors"] == first["authors, samples only"]
    assert all(0.2 < float(r["quality"]) <= float(r["best"]) + 1e-9 <= 1 + 1e-9 for r in rows)
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_committed_summary_is_that_of_the_committed_pauses(study):
    rows, summary = (
        lines(FOLDER / "results/pauses.csv"),
        {r["method"]: r for r in lines(FOLDER / "results/summary.csv")},
    )
    assert set(summary) == set(study.METHODS)
    assert len({(r["group"], r["pause"]) for r in rows}) == 43 == len(rows) / len(study.METHODS)
    values = defaultdict(list)
    for r in rows:
        if r["pause"] != "0":
            values[r["method"], r["group"]].append(float(r["quality"]))
    groups = sorted({r["group"] for r in rows})
    assert len(groups) == 8
    mst = [np.mean(values["mst", g]) for g in groups]
    for method in ("paper", "samples_only", "floor_components"):
        other = [np.mean(values[method, g]) for g in groups]
        between = ttest_rel(mst, other).confidence_interval()
        line = summary[method]
        figures = [float(line[k]) for k in ("quality", "difference", "low", "high")]
        assert figures == pytest.approx(
            [np.mean(other), np.mean(mst) - np.mean(other), between.low, between.high], abs=6e-4
        )
    past = {r["method"]: r for r in lines(FOLDER / "results/past.csv")}
    paper, own = ([np.mean(values[m, g]) for g in groups] for m in ("paper", "paper, samples only"))
    between = ttest_rel(paper, own).confidence_interval()
    found = [float(past["paper"][k]) for k in ("difference", "low", "high")]
    assert found == pytest.approx([np.mean(paper) - np.mean(own), between.low, between.high], abs=6e-4)
