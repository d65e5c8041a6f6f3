"""Streams are named by their keys: the same numbers for the same name, others for every other name."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.smc import Key, child, key_of

GOLDEN = {
    (0, ()): [6483122582865679825, 1579675997288522721],
    (1, ("transition", 3)): [7681709073394494191, 3197119547693137766],
    (2**130 + 7, ("update", 63)): [4893272398828858616, 234212582004005741],
    (5, ("a", 2**40, "object", 7)): [6384708064524710814, 8805389102303117619],
}


@pytest.mark.parametrize("name", GOLDEN, ids=str)
def test_first_draws_of_some_keys(name):
    """They change if numpy changes PCG64, or if the keys get other seeds: then results of stored seeds change."""
    assert Key(*name).generator().integers(2**63, size=2).tolist() == GOLDEN[name]


def test_a_stream_of_numpy_has_children():
    drawn = child(np.random.default_rng(7), "object", 1).integers(2**63, size=2)
    assert drawn.tolist() == [1139216477989410493, 5796144235490380818]


def test_streams_depend_on_their_name_alone():
    key = Key(4)
    a = key.child(3, "transition").generator().random(4)
    np.testing.assert_array_equal(a, Key(4).child(np.int64(3)).child("transition").generator().random(4))
    rng = key.child("x").generator()
    before = child(rng, "object", 1).random(3)
    rng.random(100)
    np.testing.assert_array_equal(before, child(rng, "object", 1).random(3))
    for other in (rng, copy.deepcopy(rng), pickle.loads(pickle.dumps(rng))):
        assert key_of(other) == key.child("x")


def test_different_names_have_different_streams():
    """Also an index and its block of neighbours, names that look alike, and children of numpy's streams."""
    paths = [
        (),
        ("a",),
        ("a", 0),
        (0,),
        (0, 0),
        ("a", 16),
        ("a", 1, 0),
        (1, "a"),
        ("1",),
        ("a", "0"),
        ("a, 0",),
        (1,),
    ]
    keys = [Key(seed).child(*path) for seed in (0, 7, 2**64) for path in paths]
    plain = np.random.default_rng(7)
    spawned = plain.spawn(2)
    of_numpy = [plain, *spawned, child(plain, 0), child(plain, 1), child(spawned[0], 0)]
    ours = Key(7).generator()
    rngs = [*(key.generator() for key in keys), *of_numpy, *ours.spawn(2), *ours.spawn(1)]
    assert len({tuple(rng.random(2)) for rng in rngs}) == len(rngs)


def test_neighbouring_streams_are_independent():
    """Correlations of 2,000 draws of 33 streams are normal with sd 1 / sqrt(2000): bound 5.3 sd, false alarm 6e-5."""
    draws = np.stack([Key(1).child("transition", t).generator().standard_normal(2000) for t in range(33)])
    correlations = np.corrcoef(draws)[np.triu_indices(33, 1)]
    assert np.abs(correlations).max() < 5.3 / np.sqrt(2000)


def test_other_bit_generators_can_be_seeded():
    sequence = Key(3).generator().bit_generator.seed_seq
    for kind in (np.random.MT19937, np.random.SFC64, np.random.Philox):
        a, b = (np.random.Generator(kind(s)).random(2) for s in (sequence, Key(3).generator().bit_generator.seed_seq))
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True])
def test_bad_seeds(seed):
    with pytest.raises(InputError, match="seed"):
        Key(seed)


def test_bad_parts():
    with pytest.raises(InputError, match="part of a stream's name is -1"):
        Key(0).child("a", -1)
    with pytest.raises(InputError, match="no integer seed sequence"):
        child(np.random.Generator(np.random.PCG64([1, 2])), "a")
