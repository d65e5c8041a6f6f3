"""The study of real groups: its score by hand, its constants, its summary, its small form."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.files import read_csv
from mstfilter.presets import describe_filter
from tests.conftest import shared_folder
from tests.experiments.scripts import import_script, run_script


@pytest.fixture(scope="module")
def study():
    return import_script("real_groups/run.py")


def test_score_ignores_pixels_without_label_and_the_table(study):
    label = np.array([[0, 0, 1, 1, 2, 2, 3, 3]], np.uint8)
    # One blob over both objects and a pixel of the table: every intersection over union is 2 / 5.
    image = np.array([[7, 0, 0, 1, 1, 1, 1, 1]], np.uint16)
    assert study.score(image, label) == pytest.approx(0.4)
    assert study.score(np.array([[9, 9, 0, 0, 5, 5, 4, 4]], np.uint16), label) == 1.0
    assert study.score(np.zeros_like(image), label) == 0.0


def test_changed_is_a_fraction_of_the_pixels_with_both_readings(study):
    before = np.array([[1.0, 1.0, np.nan, 1.0, 2.0]])
    after = np.array([[1.005, 1.02, 1.0, 1.2, 1.0]])
    assert study.changed(before, after, np.array([[True, True, True, True, False]])) == pytest.approx(2 / 3)
    assert study.changed(before, after, np.zeros((1, 5), bool)) == 0.0


def test_constants_reach_every_front_end(study):
    constants = {"colour_weight": "0.37", "centre": "0.41", "slope": "9.5", "colour_weight_learned": "0.53"}
    for method in study.METHODS:
        described = describe_filter(study.assemble(method, constants))
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
    arguments = ("real_groups/run.py", "--smoke", "--out", tmp_path)
    assert "s of the processor" in run_script(*arguments, MSTFILTER_SHARED=shared_folder())
    printed = run_script(*arguments, MSTFILTER_SHARED=shared_folder())
    assert "s of the processor" not in printed, "finished groups are not run again"
    rows = read_csv(tmp_path / "pauses.csv")
    assert len(rows) == 3 * len(read_csv(tmp_path / "summary.csv"))
    # Control: without a past the filter is its samples.
    first = {r["method"]: r["quality"] for r in rows if r["pause"] == "0"}
    alike = {first[m] for m in ("crossover", "samples_only", "union", "tracking_only")}
    assert len(alike) == 1 and first["floor_image"] not in alike
    assert first["paper"] == first["paper, samples only"]
    assert first["authors"] == first["authors, samples only"]
    assert all(0.2 < float(r["quality"]) <= float(r["best"]) + 1e-9 <= 1 + 1e-9 for r in rows)
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_summary_pairs_methods_by_group(study, tmp_path):
    """Pauses of a group are averaged first; the first pause, which has no past, does not count."""
    quality = {("a", "mst"): (0.8, 0.6), ("a", "samples_only"): (0.5, 0.7), ("b", "mst"): (0.9, 0.9)}
    quality |= {("b", "samples_only"): (0.8, 0.8)}
    rows = [
        {"group": group, "pause": str(pause), "method": method, "quality": str(q), "best": str(q), "objects": "3"}
        for (group, method), values in quality.items()
        for pause, q in enumerate((0.0, *values))
    ]
    means = study.group_means(rows, "quality")
    assert means["mst"] == pytest.approx({"a": 0.7, "b": 0.9})
    assert means["samples_only"] == pytest.approx({"a": 0.6, "b": 0.8})
    found = study.differences(means)
    assert set(found) == {"samples_only"}
    assert found["samples_only"].mean == pytest.approx(0.1) and found["samples_only"].n == 2
