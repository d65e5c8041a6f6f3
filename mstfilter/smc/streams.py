"""Keyed random streams.

All random numbers of a run are drawn from streams named by their use: (seed, step, slot, index). The number of
workers, the order of work, and removing a component therefore change no other stream.

>>> from mstfilter.smc import Key, child
>>> rng = Key(seed=1).child("step", 3, "transition").generator()     # as `ParticleFilter` does
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
from numpy.random.bit_generator import ISpawnableSeedSequence

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
    """The name of a random stream."""

    seed: int  #: non-negative
    path: tuple[int, ...] = ()  #: position in the run where the stream is used

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
        return np.random.Generator(np.random.PCG64(_sequence(self)))


def _sequence(key: Key) -> _KeyedSequence:
    sequence = _KeyedSequence(np.array(key_words(key), dtype=np.uint32))
    sequence.key = key
    return sequence


def key_words(key: Key) -> list[int]:
    """The entropy of a key: words of the seed, at least 4 as numpy has it before a spawn key, prefix, and path."""
    words = _words(key.seed)
    words += [0] * (4 - len(words))
    words.append(_PREFIX)
    for number in key.path:
        words += _words(number)
    return words


def child(rng: np.random.Generator, *parts: int | str) -> np.random.Generator:
    """A stream derived from the stream of `rng` and named by `parts`, for example ``"object", 7``.

    `rng` is made from a seed, for example by numpy.random.default_rng or `Key`. It is not advanced.
    """
    return key_of(rng).child(*parts).generator()


def key_of(rng: np.random.Generator) -> Key:
    """The key of the stream of a generator, whatever its current position in the stream."""
    sequence = rng.bit_generator.seed_seq
    if isinstance(sequence, (_KeyedSequence, _KnownSequence)):
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


def step_generator(key: Key, t: int, slot: str) -> np.random.Generator:
    """``key.child("step", t).child(slot).generator()``; the seeds of 64 steps are computed together."""
    block, position = divmod(t, 64)
    sequence = _KnownSequence(key, t, slot, _seeds_of_steps(key, slot, block)[position])
    return np.random.Generator(np.random.PCG64(sequence))  # type: ignore[arg-type]


@lru_cache(maxsize=32)
def _seeds_of_steps(key: Key, slot: str, block: int) -> np.ndarray:
    """(64, 4) uint64 seeds of the generators of a slot."""
    return pcg64_seeds(step_words([key], slot, range(64 * block, 64 * block + 64)))


def step_words(keys: list[Key], slot: str, steps: range) -> np.ndarray:
    """(len(steps) * len(keys), k) uint32 words of ``key.child("step", t, slot)`` for each step and key."""
    words = np.array([key_words(key.child("step", 0, slot)) for key in keys], np.uint32)
    repeated = np.tile(words, (len(steps), 1, 1))
    number_of_step = len(key_words(keys[0].child("step")))
    repeated[:, :, number_of_step] = np.array(steps, np.uint32)[:, None]
    return repeated.reshape(-1, words.shape[1])


class _KnownSequence(ISpawnableSeedSequence):
    """The SeedSequence of a step and a slot, of which the seed of a PCG64 is known."""

    def __init__(self, key: Key, t: int, slot: str, seed: np.ndarray) -> None:
        self._place, self._seed = (key, t, slot), seed

    @property
    def key(self) -> Key:
        key, t, slot = self._place
        return key.child("step", t, slot)

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> np.ndarray:
        """As the sequence that it stands for."""
        if n_words == 4 and dtype is np.uint64:
            return self._seed
        return _sequence(self.key).generate_state(n_words, dtype)

    def spawn(self, n_children: int) -> list[Any]:
        """As the sequence that it stands for; repeated calls give new children."""
        if "_real" not in self.__dict__:
            self._real = _sequence(self.key)
        return self._real.spawn(n_children)


def pcg64_seeds(words: np.ndarray) -> np.ndarray:
    """Seeds (m, 4) uint64 of the PCG64 generators that numpy's SeedSequence makes from given words.

    The words (m, k) uint32 are the assembled entropy of m sequences, k >= 4, as `Key.generator` makes it. The result
    holds high and low word of the initial state, then of the sequence number. O'Neill (2015), "Developing a seed_seq
    alternative", has the hash of SeedSequence.
    """
    constant = 0x43B0D7E5

    def hashed(value: np.ndarray) -> np.ndarray:
        nonlocal constant
        value = value ^ np.uint32(constant)
        constant = constant * 0x931E8875 & 0xFFFFFFFF
        value = value * np.uint32(constant)
        return value ^ value >> np.uint32(16)

    def mixed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        z: Any = x * np.uint32(0xCA01F9DD) - y * np.uint32(0x4973F715)
        return z ^ z >> np.uint32(16)

    pool = [hashed(words[:, i]) for i in range(4)]
    for source in range(4):
        for target in range(4):
            if source != target:
                pool[target] = mixed(pool[target], hashed(pool[source]))
    for source in range(4, words.shape[1]):
        for target in range(4):
            pool[target] = mixed(pool[target], hashed(words[:, source]))
    state, out = 0x8B51F9DD, []
    for i in range(8):
        value = pool[i % 4] ^ np.uint32(state)
        state = state * 0x58F38DED & 0xFFFFFFFF
        value = value * np.uint32(state)
        out.append((value ^ value >> np.uint32(16)).astype(np.uint64))
    return np.stack([out[2 * i] | out[2 * i + 1] << np.uint64(32) for i in range(4)], axis=1)


def pcg64_states(words: np.ndarray) -> np.ndarray:
    """States (m, 4) uint64 of the generators of `pcg64_seeds` (O'Neill 2014, PCG, section 4).

    Low and high word of the state, low and high word of the increment.
    """
    seed_high, seed_low, inc_high, inc_low = pcg64_seeds(words).T
    # inc = 2 * sequence + 1; state = (inc + seed) * multiplier + inc, modulo 2^128.
    inc_high, inc_low = inc_high << np.uint64(1) | inc_low >> np.uint64(63), inc_low << np.uint64(1) | np.uint64(1)
    low, high = add_128(inc_low, inc_high, seed_low, seed_high)
    low, high = add_128(*times_multiplier(low, high), inc_low, inc_high)
    return np.stack([low, high, inc_low, inc_high], axis=1)


def add_128(a_low: np.ndarray, a_high: np.ndarray, b_low: np.ndarray, b_high: np.ndarray) -> tuple[Any, Any]:
    """Sums modulo 2^128."""
    low = a_low + b_low
    return low, a_high + b_high + (low < a_low)


def times_multiplier(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Products with the multiplier of PCG64, modulo 2^128."""
    m_high, m_low = np.uint64(0x2360ED051FC65DA4), np.uint64(0x4385DF649FCCF645)
    half, mask = np.uint64(32), np.uint64(0xFFFFFFFF)
    a, b, c, d = low & mask, low >> half, m_low & mask, m_low >> half
    middle = (a * c >> half) + (b * c & mask) + (a * d & mask)
    carry = b * d + (b * c >> half) + (a * d >> half) + (middle >> half)
    return low * m_low, high * m_low + low * m_high + carry


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
