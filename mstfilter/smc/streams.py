"""Keyed random streams.

Everything random in a run is drawn from a stream that is named by where it is used: (seed, step, slot, index).
Worker count, order of work and switching a slot off then change nothing elsewhere.

>>> from mstfilter.smc.streams import Key, child
>>> rng = Key(seed=1).child(3, "transition").generator()     # step 3, slot "transition"
>>> child(rng, "object", 7).random() == child(rng, "object", 7).random()    # does not consume `rng`
True

A `Key` is data (an integer and a tuple) and can be stored; a generator is not kept anywhere. Keys stand on
numpy's SeedSequence with a prefix of our own, so a child never collides with `Generator.spawn`.

A name stands for two words of the spawn key, its CRC-32 and 1. So a name is no single index below 2^32, but it is the
same stream as that pair of indices: ``key.child("a")`` draws what ``key.child(zlib.crc32(b"a"), 1)`` draws. Two names
with the same CRC-32 share a stream as well (of a hundred names two do so with a chance of one in a million).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from mstfilter.errors import InputError

__all__ = ["Key", "child"]

_PREFIX = 0x6D7374  # "mst": spawn() numbers its children from 0, which would meet a naive key


class _KeyedSequence(np.random.SeedSequence):
    """The seed sequence ``SeedSequence(seed, spawn_key=(prefix, *path))``, made of its words: six times as quick."""

    key: Key

    def spawn(self, n_children: int) -> list[Any]:
        """As the sequence that it stands for."""
        numbers = [c.spawn_key[-1] for c in super().spawn(n_children)]
        path = (_PREFIX, *self.key.path)
        return [np.random.SeedSequence(self.key.seed, spawn_key=(*path, n)) for n in numbers]


@dataclass(frozen=True)
class Key:
    """The name of a random stream.

    Parameters
    ----------
    seed : int
        Not negative.
    path : tuple of int
        Where in the run the stream is used.
    """

    seed: int
    path: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.seed, bool) or not isinstance(self.seed, (int, np.integer)) or self.seed < 0:
            raise InputError(f"seed is {self.seed!r}, expected an integer >= 0")
        object.__setattr__(self, "seed", int(self.seed))

    def child(self, *parts: int | str) -> Key:
        """The key of a part: a step, a slot by name, an index."""
        new = object.__new__(Key)  # the seed has been checked
        new.__dict__.update(seed=self.seed, path=self.path + tuple([_number(p) for p in parts]))
        return new

    def generator(self) -> np.random.Generator:
        """A new generator at the start of the stream."""
        words = _words(self.seed)
        words += [0] * (4 - len(words))  # as numpy does before a spawn key
        words.append(_PREFIX)
        for number in self.path:
            if number < 1 << 32:
                words.append(number)
            else:
                words += _words(number)
        sequence = _KeyedSequence(np.array(words, dtype=np.uint32))
        sequence.key = self
        return np.random.Generator(np.random.PCG64(sequence))


def child(rng: np.random.Generator, *parts: int | str) -> np.random.Generator:
    """A stream derived from the one that `rng` was made for; `rng` itself is not consumed.

    Parameters
    ----------
    rng : Generator
        Made from a seed (all generators of numpy.random.default_rng and of `Key` are).
    *parts : int or str
        Name of the part: for example ``"object", 7``.
    """
    return key_of(rng).child(*parts).generator()


def key_of(rng: np.random.Generator) -> Key:
    """The key of the stream that a generator was made for (wherever in the stream it is now)."""
    sequence = rng.bit_generator.seed_seq
    if isinstance(sequence, _KeyedSequence):
        return sequence.key
    if not isinstance(sequence, np.random.SeedSequence) or not isinstance(sequence.entropy, (int, np.integer)):
        raise InputError(
            "this generator has no integer seed sequence, so no child stream can be named after it",
            "make it with numpy.random.default_rng(seed) or Key(seed).generator()",
        )
    path = tuple(int(n) for n in sequence.spawn_key)
    if path[:1] == (_PREFIX,):
        return Key(int(sequence.entropy), path[1:])
    return Key(int(sequence.entropy), (_PREFIX, len(path), *path))  # its length: a child is no sibling's namesake


def _words(number: int) -> list[int]:
    """A number as 32-bit words, lowest first."""
    if number < 1 << 32:
        return [number]
    words = []
    while number:
        words.append(number & 0xFFFFFFFF)
        number >>= 32
    return words


def _number(part: int | str) -> int:
    if isinstance(part, str):
        return _named(part)
    return int(part)


@lru_cache(maxsize=256)
def _named(name: str) -> int:
    return zlib.crc32(name.encode()) | 1 << 32  # two words, so no single index below 2^32 is its namesake
