"""Read-only arrays, and keys that identify values by their content."""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Mapping
from enum import Enum
from pathlib import PurePath
from types import FunctionType
from weakref import WeakKeyDictionary

import numpy as np

_definitions: WeakKeyDictionary[type | FunctionType, int] = (
    WeakKeyDictionary()
)  # class or function -> earlier ones of its name
_defined: Counter[tuple[str, str]] = Counter()  # module and name -> classes or functions of this name


def read_only(array: np.ndarray) -> np.ndarray:
    """A read-only view of the data of an array."""
    view = array.view()
    view.flags.writeable = False
    return view


def frozen(array: np.ndarray) -> np.ndarray:
    """A read-only array. Writeable memory is copied, so that later writes to other arrays do not change it."""
    owner: object = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            copy = array.copy()
            copy.flags.writeable = False
            return copy
        owner = owner.base
    return array


def component_key(component: object) -> bytes:
    """Hash of the class and the fields of a component, and of the content of a user's file that defines the class.

    A class that is defined again, as in a notebook, is another class. The code of a class is not read: after a change
    of a function that the class calls, define the class again, or empty the cache by ``scene_cache.clear()``.

    The hash includes the attribute ``bound_key``, which identifies the ground truth of an oracle. A torch module is
    hashed by its weights, any other object by what a copy of it is made from.
    """
    if dataclasses.is_dataclass(component) and not isinstance(component, type):
        cls = type(component)
        source = getattr(cls, "__mst_source__", "") or _definition(cls) or ""
        fields = [component_key(getattr(component, f.name)) for f in dataclasses.fields(component)]
        return content_key(cls.__module__, cls.__qualname__, source, getattr(component, "bound_key", b""), *fields)
    if isinstance(component, (tuple, list)):
        return content_key(type(component).__name__, *(component_key(part) for part in component))
    if isinstance(component, Mapping):
        return content_key(*(part for k, v in component.items() for part in (k, component_key(v))))
    if isinstance(component, (str, bytes, int, float, complex, frozenset, np.generic, np.ndarray, PurePath, Enum)):
        return content_key(component)
    if isinstance(component, (type, FunctionType)):
        return content_key(component.__module__, component.__qualname__, _definition(component))
    if hasattr(component, "state_dict"):
        tensors = {name: np.asarray(tensor) for name, tensor in component.state_dict().items()}
        return content_key(repr(component), *(part for item in tensors.items() for part in item))
    try:
        return content_key(None) if component is None else component_key(component.__reduce_ex__(4))
    except (TypeError, RecursionError):  # what cannot be copied, such as a generator, is known by its text
        return content_key(component)


def _definition(named: type | FunctionType) -> int:
    """How many other classes or functions of the same module and name this process has used before."""
    number = _definitions.get(named)
    if number is None:
        name = named.__module__, named.__qualname__
        number = _definitions.setdefault(named, _defined[name])
        _defined[name] = number + 1
    return number


def content_key(*parts: object) -> bytes:
    """A 16-byte hash of arrays, bytes, strings and numbers. The hash depends on their order."""
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


def max_of_three(values: np.ndarray) -> np.ndarray:
    """Maximum over the last axis, which has length 3. The function is faster than ``values.max(axis=-1)``."""
    return np.asarray(np.maximum(np.maximum(values[..., 0], values[..., 1]), values[..., 2]))
