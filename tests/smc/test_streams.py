"""Streams made of words are numpy's own; spawning and copying keep their names."""

from __future__ import annotations

import copy
import pickle
import zlib

import numpy as np
import pytest

from mstfilter.errors import InputError
from mstfilter.smc import Key, Population, child, key_of
from mstfilter.smc.streams import _PREFIX, key_words, pcg64_states, step_generator


def words_of(seeds, *path):
    return np.array([key_words(Key(seed).child(*path)) for seed in seeds], np.uint32)


@pytest.mark.parametrize("seed", [0, 3, 2**31, 2**32, 2**40 + 5, 2**130 + 7])
@pytest.mark.parametrize("path", [(), (0,), (5, "update"), (2**33,), ("transition", 3, 0)])
def test_the_stream_of_a_key_is_that_of_its_seed_sequence(seed, path):
    key = Key(seed).child(*path)
    ours = key.generator()
    numpys = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(_PREFIX, *key.path))))
    assert key_of(ours) == key_of(numpys) == key == key_of(copy.deepcopy(ours))
    np.testing.assert_array_equal(child(ours, "a").random(3), child(numpys, "a").random(3))
    for a, b in zip(ours.spawn(2) + ours.spawn(1), numpys.spawn(2) + numpys.spawn(1), strict=True):
        np.testing.assert_array_equal(a.random(3), b.random(3))
    np.testing.assert_array_equal(ours.random(5), numpys.random(5))


@pytest.mark.parametrize("key", [Key(0), Key(2**130 + 7, (5, 2**40))])
@pytest.mark.parametrize("t", [0, 63, 64, 1000])
def test_the_stream_of_a_step_is_that_of_its_key(key, t):
    rng, expected = step_generator(key, t, "update"), key.child("step", t, "update").generator()
    assert key_of(rng) == key_of(expected) == key_of(copy.deepcopy(rng)) == key_of(pickle.loads(pickle.dumps(rng)))
    for a, b in zip(rng.spawn(2) + rng.spawn(1), expected.spawn(2) + expected.spawn(1), strict=True):
        np.testing.assert_array_equal(a.random(3), b.random(3))
    np.testing.assert_array_equal(rng.random(5), expected.random(5))
    a, b = (np.random.MT19937(r.bit_generator.seed_seq).random_raw(3) for r in (rng, expected))
    np.testing.assert_array_equal(a, b)


def test_moved_particles_keep_weights_and_parents():
    population = Population(np.zeros(3), np.log([1.0, 2.0, 3.0]), {"previous": np.arange(3)}, {"note": 1})
    moved = population.moved(np.ones((3, 2)))
    assert moved.ess == population.ess and moved.notes == {} and moved.parents is population.parents
    with pytest.raises(ValueError, match="read-only"):
        moved.particles[0] = 2
    with pytest.raises(InputError, match="3 particles became 2"):
        population.moved(np.zeros(2))


def test_what_a_name_shares_its_stream_with():
    """As the docstring says: with the pair of indices (CRC-32, 1), and with no single index."""
    key, number = Key(3), zlib.crc32(b"transition")
    named = key.child("transition").generator().random(4)
    np.testing.assert_array_equal(named, key.child(number, 1).generator().random(4))
    for other in ((number,), (number, 0), (1, number)):
        assert not np.array_equal(named, key.child(*other).generator().random(4))
    assert not np.array_equal(key.child(0).generator().random(4), key.child(0, 0).generator().random(4))


@pytest.mark.parametrize("path", [(), ("step", 7, "transition"), (2**33, 5)])
def test_states_of_many_streams_are_those_that_numpy_makes(path):
    seeds = [0, 1, 2**32 - 1, 2**32, 2**100 + 12345, 2**128 - 1]
    for seed, state in zip(seeds, pcg64_states(words_of(seeds, *path)).tolist(), strict=True):
        expected = Key(seed).child(*path).generator().bit_generator.state["state"]
        assert state[0] + (state[1] << 64) == expected["state"]
        assert state[2] + (state[3] << 64) == expected["inc"]
