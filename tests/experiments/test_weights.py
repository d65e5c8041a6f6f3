"""The study of experiments/weights: its definitions by hand and by enumeration."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from mstfilter.base.files import read_csv
from tests.experiments.scripts import import_script, run_script

reliability = import_script("weights/reliability.py")


def test_disagreement_counts_pairs_of_readings():
    """Readings are listed one by one; readings of no object (0) belong to no object together."""
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 4, (4, 3))
    truth = [(cell, label) for cell in range(4) for label in range(3) for _ in range(counts[cell, label])]
    partitions = np.array([[1, 1, 1, 1], [1, 2, 1, 3], [1, 2, 3, 4]])
    expected = [
        sum((row[a] == row[b]) != (x == y > 0) for (a, x), (b, y) in combinations(truth, 2)) for row in partitions
    ]
    found = reliability.disagreements(partitions, counts)
    # Pairs of a reading with itself are in every partition alike.
    np.testing.assert_allclose(found - found[0], np.array(expected) - expected[0])


def test_partitions_that_differ_in_few_pairs_are_one_class():
    partitions = np.array([[1, 1, 2, 2], [1, 1, 1, 2], [1, 2, 3, 3]])  # the second one moves a small cell
    assert reliability.classes(partitions, np.array([400, 500, 1, 300])).tolist() == [0, 0, 1]
    assert len(set(reliability.classes(partitions, np.array([40, 50, 20, 30])))) == 3


def test_the_most_probable_image_has_the_most_probable_components():
    """Of two independent components, at T = 1 and at T = 1/2, with probabilities by hand."""
    p = np.array([[0, 0, 0, 0.8, 5, 0], [0, 0, 1, 0.2, 7, 1], [0, 1, 0, 0.4, 3, 0], [0, 1, 1, 0.6, 1, 0]])
    kept = {
        "p": p,
        "prediction": np.zeros(1),
        "candidates": np.array([[0, 0.0], [0, 0.0]]),
        "chosen": np.array([[0, 1], [1, 1]]),
        "selected": np.array([[0, 0.5], [1, 0.7]]),
        "mutual": np.array([[1.0, 0.6], [0.7, 1.0]]),
    }
    for temperature, first, second in ((1.0, 0.8, 0.6), (0.5, 16 / 17, 9 / 13)):
        found = {one.name: one for one in reliability._of_pause(kept, temperature)}
        assert found["component"].p.max() == pytest.approx(second)  # the last one
        assert found["image"].p.max() == pytest.approx(first * second)
        assert found["image"].right[found["image"].p.argmax()]
        assert found["component, merged"].p.max() == pytest.approx(first)  # the second component has one class
        assert found["image, merged"].p.max() == pytest.approx(first)
        assert found["scene"].p.max() == pytest.approx(first)  # the second component is the same in both
        assert not found["scene"].right[found["scene"].p.argmax()]


@pytest.mark.nightly
def test_small_forms(tmp_path):
    run_script("weights/reliability.py", "--smoke", "--out", tmp_path)
    rows = read_csv(tmp_path / "reliability.csv")
    at_1 = {row["question"]: row for row in rows if row["temperature"] == "1.0"}
    assert {"component", "image", "scene"} <= set(at_1)
    assert all(0 <= float(row["frequency"]) <= 1 and float(row["log_loss"]) >= 0 for row in at_1.values())
