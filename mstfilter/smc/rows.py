"""Arrays and generators of the particles of many runs, for components that are called once for all of them.

Rows (R n, ...) are the particles of R runs of n particles, run by run. `Rows` are such arrays, `RunGenerators` draw
them: row r of every array by the generator of run r.
"""

from __future__ import annotations

import ctypes
import inspect
import math
import threading
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.streams import Key, add_128, pcg64_states, step_words, times_multiplier

#: Streams whose states are computed together.
_BLOCK = 1 << 16


class SlotStreams:
    """States of the streams of many runs in one slot, for all steps; `seeds` are one per run, below 2^128."""

    def __init__(self, seeds: list[int], slot: str, n_steps: int) -> None:
        self.seeds, self.slot, self.n_steps = seeds, slot, n_steps
        self.block, self.known = max(1, _BLOCK // len(seeds)), -1
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
