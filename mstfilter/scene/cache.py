"""Work that several parts of a step need, computed once and kept by content.

The boundary map of a frame, the flow between two frames or the place of every voxel in an image depend on
the data alone, not on the hypothesis that asks. They are kept here under the content of what they were made
from, so hypotheses share them, and a repeated run on the same data in one process finds them again.

>>> from mstfilter.scene.cache import memo
>>> memo("square", (3,), lambda: 9)
9

The store is bounded (`LIMIT_BYTES`); what was used longest ago is dropped first. Values must be treated as
read-only. `beneath` puts a further layer below it, such as a `DiskMemo`.
"""

from __future__ import annotations

import contextlib
import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

__all__ = ["LIMIT_BYTES", "Layer", "beneath", "clear", "memo"]

LIMIT_BYTES = 768 * 2**20

T = TypeVar("T")

_lock = threading.RLock()
_store: OrderedDict[tuple[str, Hashable], tuple[Any, int]] = OrderedDict()
_used = 0


class Layer(ABC):
    """Where values are looked for that the store has not, and kept when they are computed."""

    @abstractmethod
    def find(self, name: str, key: Hashable) -> Any:
        """The value; None where it is not known."""

    @abstractmethod
    def keep(self, name: str, key: Hashable, value: Any) -> None:
        """A value that was computed; what a layer does not want it leaves."""


_layer: Layer | None = None


@contextlib.contextmanager
def beneath(layer: Layer | None) -> Iterator[None]:
    """Use a layer below the store, for all threads of this process, in place of the one there was."""
    global _layer
    before, _layer = _layer, layer
    try:
        yield
    finally:
        _layer = before


def memo(name: str, key: Hashable, compute: Callable[[], T]) -> T:
    """The value of ``compute()``, from the store where it was computed before.

    Parameters
    ----------
    name : str
        What is computed; together with `key` it must determine the value completely.
    key : hashable
        Content keys (`Frame.key`, `Camera.key`, `VoxelGrid.key`) and every parameter that matters.
    compute : callable
        Computes the value. Deterministic: a value that depends on a generator does not belong here.
    """
    global _used
    full = (name, key)
    with _lock:
        if full in _store:
            _store.move_to_end(full)
            return _store[full][0]
    layer = _layer
    found = None if layer is None else layer.find(name, key)
    value = compute() if found is None else found
    if layer is not None and found is None:
        layer.keep(name, key, value)
    size = _size_of(value)
    if size > LIMIT_BYTES:
        return value
    with _lock:
        if full not in _store:
            _store[full] = (value, size)
            _used += size
        while _used > LIMIT_BYTES:
            _, (_, dropped) = _store.popitem(last=False)
            _used -= dropped
    return value


def clear() -> None:
    """Forget everything (tests and benchmarks)."""
    global _used
    with _lock:
        _store.clear()
        _used = 0


def _size_of(value: Any) -> int:
    """Bytes of the arrays inside a value; containers and dataclasses are followed."""
    if isinstance(value, np.ndarray):
        return value.nbytes + 128
    if isinstance(value, dict):
        return sum(_size_of(v) for v in value.values()) + 128
    if isinstance(value, (list, tuple)):
        return sum(_size_of(v) for v in value) + 64
    if is_dataclass(value) and not isinstance(value, type):
        return sum(_size_of(getattr(value, f.name)) for f in fields(value)) + 128
    return 128
