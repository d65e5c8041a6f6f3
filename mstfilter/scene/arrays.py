"""Read-only arrays, and keys that identify values by their content."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping

import numpy as np


def read_only(array: np.ndarray) -> np.ndarray:
    """A read-only view of an array (the data are shared, not copied)."""
    view = array.view()
    view.flags.writeable = False
    return view


def frozen(array: np.ndarray) -> np.ndarray:
    """A read-only array whose memory no other array can change: a copy, unless its memory is read-only already."""
    owner: object = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            copy = array.copy()
            copy.flags.writeable = False
            return copy
        owner = owner.base
    return array


def component_key(component: object) -> bytes:
    """Key of a component: its class, its file if it has one, and its fields, arrays included.

    If a component has a ``bound_key`` (the ground truth of a recording, for oracles), the key includes it.
    """
    if dataclasses.is_dataclass(component) and not isinstance(component, type):
        cls = type(component)
        source = getattr(cls, "__mst_source__", "")
        fields = [component_key(getattr(component, f.name)) for f in dataclasses.fields(component)]
        return content_key(cls.__module__, cls.__qualname__, source, getattr(component, "bound_key", b""), *fields)
    if isinstance(component, (tuple, list)):
        return content_key(type(component).__name__, *(component_key(part) for part in component))
    if isinstance(component, Mapping):
        return content_key(*(part for k, v in component.items() for part in (k, component_key(v))))
    return content_key(component)


def content_key(*parts: object) -> bytes:
    """A 16-byte hash of the content of arrays, bytes, strings and numbers, in order."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        elif isinstance(part, bytes):
            digest.update(b"b%d:" % len(part) + part)
        else:
            text = repr(part).encode()
            digest.update(b"r%d:" % len(text) + text)
    return digest.digest()
