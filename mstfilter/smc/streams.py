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

For batched components, `Rows` are the particles of R runs, and `RunGenerators` are the generators of the runs.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from hashlib import shake_128
from typing import Any, ClassVar

import numpy as np
from numpy.random import PCG64, Generator
from numpy.random.bit_generator import ISeedSequence, ISpawnableSeedSequence

from mstfilter.errors import InputError

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


# --- many runs -----------------------------------------------------------------------------------------------------
class Rows(np.ndarray):
    """Arrays (R n, ...) of the particles of R runs, sorted by run, for the functions of batched components.

    Products with a matrix are computed for each run, since the rounding of BLAS depends on the number of rows.
    """

    n: ClassVar[int] = 0  #: number of particles of a run

    def __matmul__(self, other: Any) -> Any:
        if self.ndim != 2 or np.ndim(other) > 2 or isinstance(other, Rows) or len(self) % self.n:
            return super().__matmul__(other)
        by_run = np.asarray(self).reshape(-1, self.n, self.shape[1]) @ other
        return by_run.reshape(len(self), *by_run.shape[2:]).view(type(self))


@lru_cache(maxsize=64)
def rows_of(n: int) -> type[Rows]:
    """The subclass of `Rows` with `n` rows for each run. Results of numpy operations keep the subclass."""
    return type("Rows", (Rows,), {"n": n})


class RunKeys:
    """The keys of R runs. `generators` makes generators in half the time of `Key.generator`."""

    def __init__(self, keys: list[Key]) -> None:
        self.keys = keys
        self._blocks: dict[str, tuple[int, np.ndarray]] = {}  # slot -> number of a block of steps, (R, 16, 4) seeds

    def generators(self, slot: str, t: int, runs: np.ndarray) -> list[np.random.Generator]:
        """``keys[r].child(slot, t).generator()`` for each r of `runs`. The generators have no child streams."""
        block, row = divmod(t, _BLOCK)
        if slot not in self._blocks or self._blocks[slot][0] != block:
            digests = [_digest(key.seed, (*key.path, slot), block) for key in self.keys]
            self._blocks[slot] = block, np.frombuffer(b"".join(digests), "<u8").reshape(-1, _BLOCK, 4)
        seeds = _SeedsInTurn(self._blocks[slot][1][runs, row])
        return [Generator(PCG64(seeds)) for _ in runs]  # type: ignore[arg-type]


class _SeedsInTurn(ISeedSequence):
    """Gives k generators their seeds (k, 4) in turn, which is faster than k seed sequences."""

    def __init__(self, words: np.ndarray) -> None:
        self._rows = iter(words)

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> np.ndarray:
        return next(self._rows)


class RunGenerators:
    """The generators of R runs, for batched components. The generator of run r draws row r of every array.

    A method of `numpy.random.Generator` works if its size, or one of its arguments, has a first axis of length R. If
    `n` is given, arrays have n rows for each run, and a first axis of length R n.
    """

    def __init__(self, generators: list[np.random.Generator], n: int | None = None) -> None:
        self._generators, self._n = generators, n

    def generators(self) -> list[np.random.Generator]:
        """The generators of the runs."""
        return self._generators

    def __len__(self) -> int:
        return len(self._generators)

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
            for r, rng in enumerate(self._generators):
                rows = {name: a[r] if self._n else a[r, 0] for name, a in split.items()}
                drawn.append(getattr(rng, method)(**{**given, **rows}))
            return self._joined(np.stack(drawn))

        return draw

    def _inner(self, size: Any) -> tuple[int, ...]:
        """Shape of the numbers that one run draws."""
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
        inner = self._inner(size)
        draw = getattr(np.random.Generator, method)
        if not inner:
            return np.array([draw(rng) for rng in self._generators])
        out = np.empty((len(self), *inner))
        for row, rng in zip(out.reshape(len(self), -1), self._generators, strict=True):
            draw(rng, out=row)
        return self._joined(out)


@lru_cache(maxsize=64)
def _signature(method: str) -> inspect.Signature:
    return inspect.signature(getattr(np.random.Generator, method))


def summaries(log_weights: np.ndarray, top: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Effective sample sizes (R,) and log mean weights (R,) of log weights (R, n), as `Population` computes them.

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
    """Apply a function to the particles if they are an array, or to every array of a mapping."""
    if isinstance(particles, Mapping):
        return {name: function(a) for name, a in particles.items()}
    if isinstance(particles, np.ndarray):
        return function(particles)
    raise InputError("the particles are objects")


def of_runs(particles: Any, row: Any) -> Any:
    """Particles of one run, or of several runs if `row` is an index array."""
    return each_array(lambda a: a[row], particles)
