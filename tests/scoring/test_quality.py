"""Weighted coverage: by hand, by brute force, and on real particles of the authors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from mstfilter.base.errors import InputError
from mstfilter.scoring.quality import FORMS, weighted_coverage


def by_definition(a, b, form):
    """The formulas written with sets."""
    first = 0 if form == "paper" else 1
    A = {k: set(np.flatnonzero(a.ravel() == k)) for k in range(first, int(a.max()) + 1) if (a == k).any()}
    B = {k: set(np.flatnonzero(b.ravel() == k)) for k in range(first, int(b.max()) + 1) if (b == k).any()}
    if not A or not B:
        return float(bool(A) == bool(B))
    side_a = sum(len(x) * max(len(x & y) / len(x | y) for y in B.values()) for x in A.values())
    side_b = sum(len(y) * max(len(x & y) / len(x | y) for x in A.values()) for y in B.values())
    volume_a, volume_b = sum(map(len, A.values())), sum(map(len, B.values()))
    if form == "objects":
        return (side_a / volume_a + side_b / volume_b) / 2
    return (side_a + side_b) / (2 * (a.size if form == "paper" else volume_a))


labels = hnp.arrays(np.int64, (3, 4, 2), elements=st.integers(0, 5))


@settings(max_examples=200, deadline=None)
@given(labels, labels)
def test_all_forms_by_definition(a, b):
    for form in FORMS:
        assert weighted_coverage(a, b, form) == pytest.approx(by_definition(a, b, form), abs=1e-12)


@settings(max_examples=100, deadline=None)
@given(labels, labels, st.permutations(range(1, 6)))
def test_quality_does_not_depend_on_label_values_and_objects_is_symmetric(a, b, order):
    renamed = np.array([0, *order])[a]
    assert weighted_coverage(renamed, b) == pytest.approx(weighted_coverage(a, b), abs=1e-12)
    assert weighted_coverage(a, b) == pytest.approx(weighted_coverage(b, a), abs=1e-12)
    assert weighted_coverage(a, renamed) == pytest.approx(1.0)
    assert 0 <= weighted_coverage(a, b) <= 1


def test_bad_input():
    with pytest.raises(InputError, match="shapes"):
        weighted_coverage(np.zeros(3, int), np.zeros(4, int))
    with pytest.raises(InputError, match="integers"):
        weighted_coverage(np.zeros(3), np.zeros(3, int))
    with pytest.raises(InputError, match="-1"):
        weighted_coverage(np.array([-1]), np.array([0]))
    with pytest.raises(InputError, match="no form"):
        weighted_coverage(np.array([1]), np.array([1]), "best")
    big = np.array([0, 65535])
    assert weighted_coverage(big, big) == 1.0


def test_the_authors_real_particles(shared_data):
    """Every fifth of 50 real particles with all of them in the three forms, to 1e-12."""
    folder = shared_data("r1")
    files = {
        n: dict(np.load(folder / f"{n}.npz")) for n in ("measurement", "estimate", "freespace_refined", "quality")
    }
    generations = files["measurement"]["generation"].tolist()
    particles = []
    for key in files["quality"]["keys"]:
        kind, generation, index = str(key).split("|")
        name = {"0_measurement": "measurement", "2_estimate": "estimate", "4_freespace_refined": "freespace_refined"}[
            kind
        ]
        g = generations.index(int(generation)) if name == "measurement" else 0
        particles.append(files[name]["labels"][g, int(index)])
    assert len(particles) == 50
    golden = {
        "objects": "q_objects_own_norm",
        "paper": "q_paper_all_labels",
        "authors": "q_code_symmetricCover",
    }
    for form, name in golden.items():
        want = files["quality"][name]
        got = np.array([[weighted_coverage(a, b, form) for b in particles] for a in particles[::5]])
        np.testing.assert_allclose(got, want[::5], rtol=0, atol=1e-12)
