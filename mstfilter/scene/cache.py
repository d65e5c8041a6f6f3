"""Cache of intermediate results. The key of a result is computed from the content of the inputs.

Some results depend only on the images and not on the hypothesis, for example the boundary map of a frame. `memo`
computes such a result once for all hypotheses of a step. A second run on the same data in the same process also uses
the stored results.

>>> from mstfilter.scene import memo, scene_cache
>>> memo("square", (3,), lambda: 9)
9
>>> memo("square", (3,), lambda: 10)    # found by name and key, not computed again
9
>>> scene_cache.clear()

A worker of a study runs all filters on a recording one after another. It sets `keeps_shared`, so the values that are
worth it, such as the optical flow, are kept from one run to the next.

`scene_cache` is the only global state of the package. The cache changes the duration of a run but never its results.
"""

from __future__ import annotations

import os
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

_Value = TypeVar("_Value")


class Cache:
    """Values in memory, identified by name and key. The cache can be used from several threads.

    If the total size exceeds `limit_bytes`, the least recently used values are dropped. If `keeps_shared` is True,
    `forget` keeps the values that runs share. For each name, `hits` counts the values that were found.
    """

    def __init__(self, limit_bytes: int = 768 * 2**20) -> None:
        self.limit_bytes = limit_bytes
        self.keeps_shared = False
        self._shared: set[tuple[str, Hashable]] = set()
        self._used: dict[tuple[str, Hashable], int] = {}  # calls of `forget` before the last use
        self._n_forgotten = 0
        self.hits: Counter[str] = Counter()
        self._entries: OrderedDict[tuple[str, Hashable], tuple[Any, int]] = OrderedDict()
        self._pending: dict[tuple[str, Hashable], threading.Event] = {}  # values that a thread computes now
        self._n_bytes = 0
        self._lock = threading.RLock()

    def get(self, name: str, key: Hashable, compute: Callable[[], _Value], shared: bool = False) -> _Value:
        """The cached value of ``compute()``. `compute` is called only if the value is not cached.

        `name` is the name of the computation. `key` contains content keys (`Frame.key`, `Camera.key`,
        `VoxelGrid.key`) and every parameter that affects the value. Name and key together determine the value
        completely, so `compute` must not draw random numbers. The caller must not modify the returned value.

        `shared` marks values that other runs on the recording need too, and that are small for the time they take.
        """
        return self.get_many(name, [key], lambda _: [compute()], shared)[0]

    def get_many(
        self,
        name: str,
        keys: Sequence[Hashable],
        compute: Callable[[Sequence[int]], Sequence[_Value]],
        shared: bool = False,
    ) -> list[_Value]:
        """The values of several keys. One call ``compute(indices)`` computes all missing values.

        If another thread is computing one of the values, `get_many` waits for the other thread.
        """
        found: dict[Hashable, _Value] = {}
        left: dict[Hashable, int] = {}
        for k, key in enumerate(keys):
            left.setdefault(key, k)
        while left:
            missing, others = {}, []
            with self._lock:
                for key, k in left.items():
                    entry = (name, key)
                    if entry in self._entries:
                        self._entries.move_to_end(entry)
                        self._used[entry] = self._n_forgotten
                        self.hits[name] += 1
                        found[key] = self._entries[entry][0]
                    elif entry in self._pending:
                        others.append(self._pending[entry])
                    else:
                        self._pending[entry] = threading.Event()
                        missing[key] = k
            try:
                new = compute(tuple(missing.values())) if missing else ()
                for key, value in zip(missing, new, strict=True):
                    found[key] = value
                    self._keep((name, key), value, shared)
            finally:
                for key in missing:
                    self._pending.pop((name, key)).set()
            for done in others:
                done.wait()
            left = {key: k for key, k in left.items() if key not in found}
        return [found[key] for key in keys]

    def _keep(self, entry: tuple[str, Hashable], value: Any, shared: bool) -> None:
        size = _size_of(value)
        if size > self.limit_bytes:
            return
        with self._lock:
            if entry not in self._entries:
                self._entries[entry] = (value, size)
                self._n_bytes += size
            self._used[entry] = self._n_forgotten
            if shared:
                self._shared.add(entry)
            while self._n_bytes > self.limit_bytes:
                self._drop(next(iter(self._entries)))

    def _drop(self, entry: tuple[str, Hashable]) -> None:
        self._n_bytes -= self._entries.pop(entry)[1]
        del self._used[entry]
        self._shared.discard(entry)

    @property
    def n_bytes(self) -> int:
        """Size of all values in bytes."""
        return self._n_bytes

    def forget(self) -> None:
        """Drop the values that were last used before the two previous calls of `forget`.

        A loop over pauses that calls `forget` after each step keeps the values of the last two steps. With
        `keeps_shared`, shared values are kept until the limit is reached.
        """
        with self._lock:
            kept = self._shared if self.keeps_shared else frozenset()
            for entry in [entry for entry, used in self._used.items() if used < self._n_forgotten - 1]:
                if entry not in kept:
                    self._drop(entry)
            self._n_forgotten += 1

    def clear(self) -> None:
        """Drop all values in memory and reset the counter `hits`."""
        with self._lock:
            self._entries.clear()
            self._used.clear()
            self._shared.clear()
            self.hits.clear()
            self._n_bytes = 0

    def after_fork(self) -> None:
        """Make the copy in a forked process usable, where no thread computes the values that are being computed."""
        self._pending.clear()
        self._lock.release()


scene_cache = Cache()  #: The cache of this process
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=scene_cache._lock.acquire,
        after_in_parent=scene_cache._lock.release,
        after_in_child=scene_cache.after_fork,
    )


def memo(name: str, key: Hashable, compute: Callable[[], _Value], shared: bool = False) -> _Value:
    """The value of ``compute()``, computed once in this process: `Cache.get` of `scene_cache`."""
    return scene_cache.get(name, key, compute, shared)


def memo_many(
    name: str, keys: Sequence[Hashable], compute: Callable[[Sequence[int]], Sequence[_Value]], shared: bool = False
) -> list[_Value]:
    """The values of several keys, each computed once in this process: `Cache.get_many` of `scene_cache`."""
    return scene_cache.get_many(name, keys, compute, shared)


def _size_of(value: Any) -> int:
    """Size in bytes of the arrays inside a value, including arrays in containers and dataclasses."""
    if isinstance(value, np.ndarray):
        return value.nbytes + 128
    if isinstance(value, dict):
        return sum(_size_of(v) for v in value.values()) + 128
    if isinstance(value, (list, tuple)):
        return sum(_size_of(v) for v in value) + 64
    if is_dataclass(value) and not isinstance(value, type):
        return sum(_size_of(getattr(value, f.name)) for f in fields(value)) + 128
    return 128
