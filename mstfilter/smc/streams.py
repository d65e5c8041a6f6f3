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

Rows (R n, ...) are the particles of R runs of n particles, run by run, in components that are called once for all of
them. `Rows` are such arrays; `RunGenerators` draw them, row r of every array by the generator of run r.
"""

from __future__ import annotations

import ctypes
import inspect
import math
import threading
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, ClassVar

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


# --- many runs -----------------------------------------------------------------------------------------------------
#: Streams whose states are computed together.
_STREAMS = 1 << 16


class SlotStreams:
    """States of the streams of many runs in one slot, for all steps; `seeds` are one per run, below 2^128."""

    def __init__(self, seeds: list[int], slot: str, n_steps: int) -> None:
        self.seeds, self.slot, self.n_steps = seeds, slot, n_steps
        self.block, self.known = max(1, _STREAMS // len(seeds)), -1
        self.found = np.zeros((0, len(seeds), 4), np.uint64)

    def states(self, t: int, runs: np.ndarray) -> np.ndarray:
        """(len(runs), 4) uint64 at step t."""
        block, position = divmod(t, self.block)
        if block != self.known:
            steps = range(block * self.block, min((block + 1) * self.block, self.n_steps))
            found = pcg64_states(step_words([Key(seed) for seed in self.seeds], self.slot, steps))
            self.found, self.known = found.reshape(len(steps), len(self.seeds), 4), block
        return self.found[position][runs]


class Rows(np.ndarray):
    """Arrays (R n, ...) of the particles of R runs, run by run, in the functions of batched components.

    Products with a matrix are computed for each run, as BLAS rounds an entry by the number of rows of the product.
    """

    n: ClassVar[int] = 0  #: particles of a run

    def __matmul__(self, other: Any) -> Any:
        if self.ndim != 2 or np.ndim(other) > 2 or isinstance(other, Rows) or len(self) % self.n:
            return super().__matmul__(other)
        by_run = np.asarray(self).reshape(-1, self.n, self.shape[1]) @ other
        return by_run.reshape(len(self), *by_run.shape[2:]).view(type(self))


@lru_cache(maxsize=64)
def rows_of(n: int) -> type[Rows]:
    """The class of arrays with `n` rows for each run; numpy gives it to the results of operations."""
    return type("Rows", (Rows,), {"n": n})


class RunGenerators:
    """The generators of R runs, for batched components: row r of every array is drawn by the generator of run r.

    ``standard_normal``, ``random`` and ``standard_exponential`` are fast. Any other method of
    `numpy.random.Generator` works if its size, or one of its arguments, has a first axis of length R. `states` (R, 4)
    are those of `pcg64_states`. With `n`, the arrays have n rows for each run, and a first axis of length R n.
    """

    def __init__(self, states: np.ndarray, n: int | None = None) -> None:
        self._states, self._n = np.ascontiguousarray(states), n
        self._own: list[np.random.Generator] | None = None  # made when another method is called

    def __len__(self) -> int:
        return len(self._states)

    def __getattr__(self, method: str) -> Any:
        if method.startswith("_") or not hasattr(np.random.Generator, method):
            raise AttributeError(method)
        if method in ("standard_normal", "random", "standard_exponential"):
            return partial(self._filled, method)

        def draw(*args: Any, **options: Any) -> np.ndarray:
            given = _signature(method).bind(None, *args, **options).arguments
            given.pop("self")
            split = {
                name: np.reshape(a, (len(self), -1, *np.shape(a)[1:]))
                for name, a in given.items()
                if name != "size" and np.ndim(a) and len(a) == self._length
            }
            if given.get("size") is not None or not split:
                given["size"] = self._inner(given.get("size"))
            drawn = []
            for r, rng in enumerate(self.generators()):
                rows = {name: a[r] if self._n else a[r, 0] for name, a in split.items()}
                drawn.append(getattr(rng, method)(**{**given, **rows}))
            return self._joined(np.stack(drawn))

        return draw

    def generators(self) -> list[np.random.Generator]:
        """The generators of the runs."""
        if self._own is None:
            self._own = []
            for low, high, inc_low, inc_high in self._states.tolist():
                rng = np.random.Generator(np.random.PCG64(0))
                state = {"state": low + (high << 64), "inc": inc_low + (inc_high << 64)}
                rng.bit_generator.state = {"bit_generator": "PCG64", "state": state, "has_uint32": 0, "uinteger": 0}
                self._own.append(rng)
        return self._own

    def _inner(self, size: Any) -> tuple[int, ...]:
        """Shape of the numbers of one run."""
        shape = tuple(size) if isinstance(size, (tuple, list)) else (size,)
        if shape[:1] != (self._length,):
            what = f"{len(self)} runs" if self._n is None else f"{len(self)} runs of {self._n} particles"
            raise InputError(
                f"a batched component drew numbers of size {size} for {what}",
                "give size=, the shape of the particles; or set batched to False",
            )
        return shape[1:] if self._n is None else (self._n, *shape[1:])

    @property
    def _length(self) -> int:
        """Length of the first axis of arrays."""
        return len(self) * (self._n or 1)

    def _joined(self, drawn: np.ndarray) -> np.ndarray:
        """The numbers drawn by all runs (R, ...) as one array."""
        if self._n is None:
            return drawn
        return drawn.reshape(self._length, *drawn.shape[2:]).view(rows_of(self._n))

    def _filled(self, method: str, size: Any = None) -> np.ndarray:
        return self._joined(self._filled_by_run(method, self._inner(size)))

    def _filled_by_run(self, method: str, inner: tuple[int, ...]) -> np.ndarray:
        out = np.empty((len(self), *inner))
        rows = out.reshape(len(self), -1)
        shared = _reused_generator(threading.get_ident())
        if self._own is not None or shared is None:
            for row, rng in zip(rows, self.generators(), strict=True):
                getattr(rng, method)(out=row)
            return out
        rng, memory = shared
        draw = getattr(rng, method)
        if method == "random" and rows.shape[1] == 1:
            rows[:, 0] = _next_uniforms(self._states)
            return out
        data = self._states.data.cast("B")
        for state, row in zip([data[k : k + 32] for k in range(0, len(data), 32)], rows, strict=True):
            memory[:] = state  # bytes are copied in less time than arrays
            draw(out=row)
            state[:] = memory
        return out


@lru_cache(maxsize=64)
def _signature(method: str) -> inspect.Signature:
    return inspect.signature(getattr(np.random.Generator, method))


def _next_uniforms(states: np.ndarray) -> np.ndarray:
    """(R,) uniform numbers on [0, 1), one from each PCG64 state (R, 4); the states advance.

    The output is the exclusive or of the halves, rotated by the six highest bits (XSL RR); its 53 highest bits are
    the number.
    """
    low, high, inc_low, inc_high = states.T
    low, high = add_128(*times_multiplier(low, high), inc_low, inc_high)
    states[:, 0], states[:, 1] = low, high
    rotation, word = high >> np.uint64(58), high ^ low
    word = word >> rotation | word << (np.uint64(64) - rotation & np.uint64(63))
    return (word >> np.uint64(11)) * 2.0**-53


@lru_cache(maxsize=16)
def _reused_generator(thread: int) -> tuple[np.random.Generator, memoryview] | None:
    """A generator of a thread, and its state as 32 bytes; None if its memory is not as expected.

    Writing the state takes a tenth of the time of setting ``bit_generator.state``.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(1)))
    address = ctypes.cast(rng.bit_generator.ctypes.state_address, ctypes.POINTER(ctypes.c_void_p))[0]
    if address is None:
        return None
    memory = np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(ctypes.c_uint64)), (4,))
    for _ in range(2):
        state = rng.bit_generator.state["state"]
        expected = [state["state"] & 2**64 - 1, state["state"] >> 64, state["inc"] & 2**64 - 1, state["inc"] >> 64]
        if memory.tolist() != expected:
            return None
        rng.random()
    return rng, memory.data.cast("B")


def summaries(log_weights: np.ndarray, top: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Effective sample sizes (R,) and log mean weights (R,) of log weights (R, n); the numbers of `Population`.

    `top` are the largest log weights (R,), if they are known.
    """
    top = log_weights.max(axis=1) if top is None else top
    weights = log_weights - top[:, None]
    np.exp(weights, out=weights)
    totals = weights.sum(axis=1)
    ess = totals * totals / np.vecdot(weights, weights)
    # `math.log`, as for a single population: numpy's may differ in the last bit.
    logs = np.fromiter(map(math.log, (totals / log_weights.shape[1]).tolist()), np.float64, len(totals))
    return ess, top + logs


def each_array(function: Callable[[np.ndarray], np.ndarray], particles: Any) -> Any:
    """A function of the particles if they are an array, or of every array of a mapping."""
    if isinstance(particles, Mapping):
        return {name: function(a) for name, a in particles.items()}
    if isinstance(particles, np.ndarray):
        return function(particles)
    raise InputError("the particles are objects")


def flat(particles: Any, n: int) -> Any:
    """Particles (R n, ...) of particles (R, n, ...)."""
    return each_array(lambda a: a.reshape(-1, *a.shape[2:]).view(rows_of(n)), particles)


def by_run(particles: Any, n: int) -> Any:
    """Particles (R, n, ...) of particles (R n, ...)."""
    return each_array(lambda a: np.asarray(a).reshape(-1, n, *a.shape[1:]), particles)


def of_runs(particles: Any, row: Any) -> Any:
    """Particles of one run, or of the runs of an index."""
    return each_array(lambda a: a[row], particles)


def resampled_runs(particles: Any, rows: np.ndarray, index: np.ndarray) -> Any:
    """Particles after resampling some rows by (len(rows), n) ancestors."""

    def chosen(a: np.ndarray) -> np.ndarray:
        if len(rows) == len(a):
            return a[rows[:, None], index]
        out = a.copy()
        out[rows] = a[rows[:, None], index]
        return out

    return each_array(chosen, particles)
