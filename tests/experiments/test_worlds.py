"""The study of experiments/worlds: its definitions by hand, and its small form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mstfilter.base.files import read_csv
from tests.experiments.scripts import import_script, run_script

one_or_two = import_script("worlds/one_or_two.py")


def test_parts_are_one_if_most_readings_of_each_have_one_object():
    parts = [np.arange(10) < 5, np.arange(10) >= 5]
    assert one_or_two.is_one(np.array([1, 1, 1, 2, 2, 1, 1, 1, 0, 0]), parts)
    assert not one_or_two.is_one(np.array([1, 1, 1, 1, 1, 2, 2, 2, 1, 1]), parts)
    assert not one_or_two.is_one(np.zeros(10, int), parts)  # a missed group is no object


def test_a_reading_is_present_if_an_object_overlaps_each_region():
    a, b = np.arange(20) < 8, (np.arange(20) >= 8) & (np.arange(20) < 16)
    both = np.where(a, 1, np.where(b, 2, 0))
    assert one_or_two.shows(both, [a, b]) and not one_or_two.shows(both, [a | b])
    together = np.where(a | b, 3, 0)
    assert one_or_two.shows(together, [a | b]) and not one_or_two.shows(together, [a, b])
    wider = np.where(np.arange(20) < 10, 1, np.where(b, 2, 0))  # 8 of 10 readings: exactly .8
    assert not one_or_two.shows(wider, [a])
    assert not one_or_two.shows(np.zeros(20, int), [a])


def test_scores_of_questions_by_hand():
    rows = [
        {"family": "row", "share": 0.5, "seed": k // 2, "forecast": p, "one": y, "has_one": 1, "has_several": 1 - y}
        for k, (p, y) in enumerate([(1.0, 1), (0.5, 0), (0.0, 0), (0.9, 1)])
    ]
    found = one_or_two.line(rows)
    assert (found["questions"], found["forecast"], found["frequency"], found["difference"]) == (4, 0.6, 0.5, 0.1)
    assert (found["where_one"], found["where_several"], found["both_readings"]) == (0.95, 0.25, 0.5)
    assert found["log_loss_of_share"] == round(math.log(2), 3)
    soft = [0.98 * p + 0.01 for p in (1.0, 0.5, 1.0, 0.9)]  # of the truth
    assert found["log_loss"] == pytest.approx(-np.log(soft).mean(), abs=1e-3)
    # Two scenes, with the sums .5 and -.1 of forecast minus truth: each .3 from the mean of .2.
    assert found["standard_error"] == pytest.approx(math.sqrt(2 * 0.3**2) / 4, abs=1e-3)


def test_later_seeds_are_not_looked_at_by_accident(tmp_path):
    assert "looked at once" in run_script(
        "worlds/one_or_two.py", "--seeds", "70-80", "--out", tmp_path, expected_exit=2
    )


@pytest.mark.nightly
def test_small_form(tmp_path):
    arguments = ("worlds/one_or_two.py", "--smoke", "--recordings", tmp_path / "recordings", "--out")
    assert "s of processor time for each scene" in run_script(*arguments, tmp_path / "first")
    rows = read_csv(tmp_path / "first/groups.csv")
    assert {row["preset"] for row in rows} == {"mst", "single_frame"} and len({row["seed"] for row in rows}) == 3
    assert all(row["forecast"] in ("0.0", "1.0") for row in rows if row["preset"] == "single_frame")
    run_script(*arguments, tmp_path / "again")
    assert rows == read_csv(tmp_path / "again/groups.csv")
    assert {row["family"] for row in read_csv(tmp_path / "first/one_or_two.csv")} == {"all", "row"}
