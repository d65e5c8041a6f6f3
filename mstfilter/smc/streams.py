"""Random streams that are named by keys.

All random numbers of a run are drawn from streams with names (seed, slot, step, index). A slot is the name of a
component of the filter. The streams do not depend on the number of workers, the order of work, or other components.

>>> from mstfilter.smc import Key, child
>>> rng = Key(seed=1).child("transition", 3).generator()     # of step 3, as `ParticleFilter` makes it
>>> child(rng, "object", 7).random() == child(rng, "object", 7).random()    # does not consume `rng`
True

A `Key` consists of a seed and a tuple, and can be stored in a file. The generator of a key is numpy's PCG64. The
256-bit seed of a generator is a SHAKE-128 hash (FIPS 202) of the key. Streams of different keys are independent if
the hash behaves like a random function. Two of a billion streams have equal seeds with probability below 1e-50.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import shake_128
from typing import Any

import numpy as np
from numpy.random import PCG64, Generator
from numpy.random.bit_generator import ISpawnableSeedSequence

from mstfilter.base.errors import InputError

#: Neighbouring indices whose seeds are computed together: a filter takes one after the other.
_BLOCK = 16


@dataclass(frozen=True)
class Key:
    """The name of a random stream."""

    seed: int  #: non-negative
    path: tuple[int | str, ...] = ()  #: position in the run where the stream is used

    def __post_init__(self) -> None:
        if isinstance(self.seed, bool) or not isinstance(self.seed, (int, np.integer)) or self.seed < 0:
            raise InputError(f"seed is {self.seed!r}, expected an integer >= 0")
        object.__setattr__(self, "seed", int(self.seed))

    def child(self, *parts: int | str) -> Key:
        """The key with `parts` (slot, step, index) appended to the path."""
        for part in parts:
            if type(part) is not str and (type(part) is not int or part < 0):
                parts = tuple(map(_part, parts))
        new = object.__new__(Key)  # the seed has been checked
        new.__dict__.update(seed=self.seed, path=self.path + parts)
        return new

    def generator(self) -> np.random.Generator:
        """A new generator at the start of the stream."""
        return Generator(PCG64(_KeySequence(self)))  # type: ignore[arg-type]


class _KeySequence(ISpawnableSeedSequence):
    """A numpy seed sequence that gives the generator of a key its seed."""

    def __init__(self, key: Key) -> None:
        self.key, self._n_spawned = key, 0

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> np.ndarray:
        """(n_words,) integers, as `numpy.random.SeedSequence.generate_state` returns them."""
        seed, path = self.key.seed, self.key.path
        if path and type(path[-1]) is int:
            block, row = divmod(path[-1], _BLOCK)
            words = _seeds(seed, path[:-1], block)[row]
        else:
            words = _seeds(seed, path, None)[0]
        if n_words == 4 and dtype is np.uint64:
            return words
        return np.random.SeedSequence(words.tolist()).generate_state(n_words, dtype)  # for other bit generators

    def spawn(self, n_children: int) -> list[Any]:
        """Seed sequences for `numpy.random.Generator.spawn`. Repeated calls return new ones."""
        first = self._n_spawned
        self._n_spawned += n_children
        return [_KeySequence(self.key.child("spawn", k)) for k in range(first, self._n_spawned)]


@lru_cache(maxsize=1 << 13)
def _seeds(seed: int, path: tuple[int | str, ...], block: int | None) -> np.ndarray:
    """(16, 4) uint64 seeds. Row k is for ``(*path, 16 * block + k)``; if block is None, row 0 is for `path`."""
    return np.frombuffer(_digest(seed, path, block), "<u8").reshape(_BLOCK, 4)


def _digest(seed: int, path: tuple[int | str, ...], block: int | None) -> bytes:
    return shake_128(repr((seed, path, block)).encode()).digest(32 * _BLOCK)


def child(rng: np.random.Generator, *parts: int | str) -> np.random.Generator:
    """A generator of the child stream of `rng` with the name `parts`, for example ``"object", 7``.

    `rng` must be made from a seed, for example by numpy.random.default_rng or `Key`. `rng` is not advanced.
    """
    return key_of(rng).child(*parts).generator()


def key_of(rng: np.random.Generator) -> Key:
    """The key of the stream of a generator. The position in the stream has no effect."""
    sequence = rng.bit_generator.seed_seq
    if isinstance(sequence, _KeySequence):
        return sequence.key
    if not isinstance(sequence, np.random.SeedSequence) or not isinstance(sequence.entropy, (int, np.integer)):
        raise InputError(
            "the generator has no integer seed sequence, so it has no named child streams",
            "make it with numpy.random.default_rng(seed) or Key(seed).generator()",
        )
    return Key(int(sequence.entropy), ("numpy", *map(int, sequence.spawn_key)))


def _part(part: int | str) -> int | str:
    if isinstance(part, str):
        return str(part)
    if part < 0:
        raise InputError(f"part of a stream's name is {part}, expected a string or an integer >= 0")
    return int(part)
