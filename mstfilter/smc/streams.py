"""Keyed random streams.

All random numbers of a run are drawn from streams named by their use: (seed, step, slot, index). The number of
workers, the order of work, and removing a component therefore change no other stream.

>>> from mstfilter.smc import Key, child
>>> rng = Key(seed=1).child(3, "transition").generator()     # step 3, slot "transition"
>>> child(rng, "object", 7).random() == child(rng, "object", 7).random()    # does not consume `rng`
True

A `Key` is data (an integer and a tuple) and can be stored; generators are not stored. Keys use numpy's SeedSequence
with a fixed prefix, so that a child never equals a child of `Generator.spawn`.

A name adds two words to the spawn key, its CRC-32 and 1. It therefore differs from every single index below 2^32, but
equals that pair of indices: ``key.child("a")`` is ``key.child(zlib.crc32(b"a"), 1)``. Two names with the same CRC-32
share a stream (probability one in a million for a hundred names).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from mstfilter.errors import InputError

_PREFIX = 0x6D7374  # "mst"; spawn() numbers its children from 0


class _KeyedSequence(np.random.SeedSequence):
    """``SeedSequence(seed, spawn_key=(prefix, *path))``, made from its words in a sixth of the time."""

    key: Key

    def spawn(self, n_children: int) -> list[Any]:
        """As the sequence that it replaces."""
        numbers = [c.spawn_key[-1] for c in super().spawn(n_children)]
        path = (_PREFIX, *self.key.path)
        return [np.random.SeedSequence(self.key.seed, spawn_key=(*path, n)) for n in numbers]


@dataclass(frozen=True)
class Key:
    """The name of a random stream.

    Parameters
    ----------
    seed : int
        Non-negative.
    path : tuple of int
        Position in the run where the stream is used.
    """

    seed: int
    path: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.seed, bool) or not isinstance(self.seed, (int, np.integer)) or self.seed < 0:
            raise InputError(f"seed is {self.seed!r}, expected an integer >= 0")
        object.__setattr__(self, "seed", int(self.seed))

    def child(self, *parts: int | str) -> Key:
        """The key of a step, a slot (by name) or an index within this one."""
        new = object.__new__(Key)  # the seed has been checked
        new.__dict__.update(seed=self.seed, path=self.path + tuple([_number(p) for p in parts]))
        return new

    def generator(self) -> np.random.Generator:
        """A new generator at the start of the stream."""
        words = _words(self.seed)
        words += [0] * (4 - len(words))  # as numpy does before a spawn key
        words.append(_PREFIX)
        for number in self.path:
            words += _words(number)
        sequence = _KeyedSequence(np.array(words, dtype=np.uint32))
        sequence.key = self
        return np.random.Generator(np.random.PCG64(sequence))


def child(rng: np.random.Generator, *parts: int | str) -> np.random.Generator:
    """A stream derived from the stream of `rng`; `rng` itself is not advanced.

    Parameters
    ----------
    rng : Generator
        Made from a seed, for example by numpy.random.default_rng or `Key`.
    *parts : int or str
        Name of the child, for example ``"object", 7``.
    """
    return key_of(rng).child(*parts).generator()


def key_of(rng: np.random.Generator) -> Key:
    """The key of the stream of a generator, whatever its current position in the stream."""
    sequence = rng.bit_generator.seed_seq
    if isinstance(sequence, _KeyedSequence):
        return sequence.key
    if not isinstance(sequence, np.random.SeedSequence) or not isinstance(sequence.entropy, (int, np.integer)):
        raise InputError(
            "the generator has no integer seed sequence, so it has no named child streams",
            "make it with numpy.random.default_rng(seed) or Key(seed).generator()",
        )
    path = tuple(int(n) for n in sequence.spawn_key)
    if path[:1] == (_PREFIX,):
        return Key(int(sequence.entropy), path[1:])
    return Key(int(sequence.entropy), (_PREFIX, len(path), *path))  # the length makes children and siblings differ


def _words(number: int) -> list[int]:
    """A number as 32-bit words, lowest first."""
    words = [number & 0xFFFFFFFF]
    while (number := number >> 32) > 0:
        words.append(number & 0xFFFFFFFF)
    return words


def _number(part: int | str) -> int:
    if isinstance(part, str):
        return _named(part)
    if part < 0:
        raise InputError(f"part of a stream's name is {part}, expected a string or an integer >= 0")
    return int(part)


@lru_cache(maxsize=256)
def _named(name: str) -> int:
    return zlib.crc32(name.encode()) | 1 << 32  # two words, so different from any single index below 2^32
