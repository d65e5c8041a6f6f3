"""Degraded masks have the given quality, by splits, merges and displacements as requested."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.errors import InputError
from mstfilter.oracles import TrueBoundary, TrueMasks, bind_truth, degradation, degrade
from mstfilter.scene import component_key
from mstfilter.scoring import overlap, weighted_coverage
from tests.baselines.scenes import slide


def picture(rng, n=6):
    """Boxes side by side, some touching, at 160 x 120."""
    image = np.zeros((120, 160), np.int32)
    for k in range(1, n + 1):
        row, column = 20 + 40 * ((k - 1) // 3), 15 + 42 * ((k - 1) % 3)
        height, width = rng.integers(14, 38), rng.integers(20, 42)
        image[row : row + height, column : column + width] = k
    return image


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    quality=st.sampled_from([0.5, 0.6, 0.7, 0.8, 0.9, 0.95]),
    shares=st.sampled_from([(0.35, 0.35), (1.0, 0.0), (0.0, 0.0), (0.5, 0.5), (0.0, 1.0)]),
)
def test_the_given_quality_is_reached(seed, quality, shares):
    rng = np.random.default_rng(seed)
    true = picture(rng)
    worse = degrade(rng, true, quality, *shares)
    reached = weighted_coverage(worse, true)
    assert abs(reached - quality) <= 0.011, reached
    assert worse.shape == true.shape
    assert not worse[true == 0].any()


def test_splits_merges_and_displacements_have_their_effect():
    rng = np.random.default_rng(1)
    true = picture(rng)
    table = overlap(degrade(rng, true, 0.8, 1.0, 0.0), true)
    inner = table.counts[table.labels_a > 0][:, table.labels_b > 0]
    assert len(inner) > 6 and ((inner > 0).sum(axis=1) == 1).all()  # splits alone: no object holds two
    assert inner.sum() == (true > 0).sum()
    merged = degrade(rng, true, 0.7, 0.0, 1.0)
    assert len(np.unique(merged[merged > 0])) < 6
    moved = degrade(rng, true, 0.8, 0.0, 0.0)
    assert len(np.unique(moved[moved > 0])) == 6
    assert (moved > 0).sum() < (true > 0).sum()


@pytest.mark.parametrize("seed", range(5))
def test_split_objects_are_not_merged_again(seed):
    """Merges after splits: each object stays in as many pieces as it was cut into."""
    rng = np.random.default_rng(seed)
    true = np.kron(np.arange(1, 7).reshape(2, 3), np.ones((40, 45), np.int32))  # all touch
    split, names = degradation._split(rng, true, 0.8)
    both = degradation._merge(rng, true, split, names, 0.6)
    assert len(np.unique(split)) > 7 and len(np.unique(both)) < len(np.unique(split))
    for k in range(1, 7):
        assert len(np.unique(both[true == k])) == len(np.unique(split[true == k]))


def test_similar_images_get_similar_errors():
    """An object that has moved by some pixels is split at the same place."""
    rng = np.random.default_rng(3)
    true = picture(rng)
    later = np.where(true == 2, 0, true)
    rows, columns = np.nonzero(true == 2)
    later[rows + 3, columns + 1] = 2
    one, same, other = (
        degrade(np.random.default_rng(s), image, 0.6, 0.5, 0.5) for s, image in ((1, true), (1, later), (2, later))
    )
    still = true == later
    assert weighted_coverage(one * still, same * still) > 0.9
    assert weighted_coverage(one * still, other * still) < 0.8


def test_perfect_masks_and_empty_images_are_unchanged():
    true = picture(np.random.default_rng(0))
    assert (degrade(np.random.default_rng(0), true, 1.0) == true).all()
    assert not degrade(np.random.default_rng(0), true * 0, 0.5).any()


def test_the_same_stream_makes_the_same_masks():
    true = picture(np.random.default_rng(0))
    a, b, c = (degrade(np.random.default_rng(s), true, 0.7) for s in (1, 1, 2))
    assert (a == b).all() and (a != c).any()


def test_samples_have_different_errors_and_the_given_quality(tmp_path):
    recording = slide(tmp_path / "r")
    clip = recording.clips()[0]
    found = {}
    for quality in (0.9, 0.6):
        proposal = bind_truth(TrueMasks(quality=quality), recording)
        population = proposal.sample(np.random.default_rng(0), clip, 4)
        assert len({h.key for h in population.particles}) > 1
        np.testing.assert_allclose(population.notes["mask_quality"], quality, atol=0.011)
        true = recording.truth(0)
        found[quality] = np.mean([weighted_coverage(h.labels, true) for h in population.particles])
        # A sample does not depend on how many are drawn.
        fewer = proposal.sample(np.random.default_rng(0), clip, 2)
        assert [h.key for h in fewer.particles] == [h.key for h in population.particles[:2]]
    assert found[0.9] > found[0.6] + 0.1


def test_lasting_errors_are_the_same_in_all_samples_and_pauses(tmp_path):
    recording = slide(tmp_path / "r")
    one, two, *_ = recording.clips()
    proposal = bind_truth(TrueMasks(quality=0.6, errors="lasting"), recording)
    populations = [proposal.sample(np.random.default_rng(s), clip, 3) for s, clip in ((0, one), (1, one), (0, two))]
    keys = [{h.key for h in p.particles} for p in populations]
    assert len(keys[0]) == 1 and keys[0] == keys[1]
    for population in populations:
        np.testing.assert_allclose(population.notes["mask_quality"], 0.6, atol=0.011)


def test_component_key_depends_on_the_truth(tmp_path):
    first, second = slide(tmp_path / "a"), slide(tmp_path / "b")
    second = replace(second, truth=lambda t: first.truth(t) * 2)
    keys = {component_key(bind_truth(TrueBoundary(), r)) for r in (first, second)} | {component_key(TrueBoundary())}
    assert len(keys) == 3
    assert component_key(bind_truth(TrueBoundary(), first)) in keys


@pytest.mark.parametrize(
    "fields, says",
    [
        ({"quality": 1.2}, "quality of masks is 1.2"),
        ({"over": 0.7, "under": 0.5}, "shares"),
        ({"errors": "often"}, "errors is 'often'"),
    ],
)
def test_invalid_fields_are_an_error(fields, says):
    with pytest.raises(InputError, match=says):
        TrueMasks(**fields)
