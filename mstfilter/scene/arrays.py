"""Read-only arrays, and keys that identify values by their content."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import pickle
from collections.abc import Mapping
from enum import Enum
from pathlib import PurePath
from types import CodeType, FunctionType
from typing import Any

import numpy as np


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
    """Hash of the class and the fields of a component, and of the source code of a user-defined class.

    The hash includes the attribute ``bound_key``, which identifies the ground truth of an oracle. A torch module is
    hashed by its weights. A field of any other class is hashed by its pickled content.
    """
    if dataclasses.is_dataclass(component) and not isinstance(component, type):
        cls = type(component)
        source = getattr(cls, "__mst_source__", "") or _code(cls)
        fields = [component_key(getattr(component, f.name)) for f in dataclasses.fields(component)]
        return content_key(cls.__module__, cls.__qualname__, source, getattr(component, "bound_key", b""), *fields)
    if isinstance(component, (tuple, list)):
        return content_key(type(component).__name__, *(component_key(part) for part in component))
    if isinstance(component, Mapping):
        return content_key(*(part for k, v in component.items() for part in (k, component_key(v))))
    plain = (str, bytes, int, float, complex, frozenset, np.generic, np.ndarray, PurePath, Enum, type, type(None))
    if hasattr(component, "state_dict"):
        tensors = {name: np.asarray(tensor) for name, tensor in component.state_dict().items()}
        return content_key(repr(component), *(part for item in tensors.items() for part in item))
    if not isinstance(component, plain):
        with contextlib.suppress(Exception):  # what cannot be pickled, such as a lambda, is known by its text
            return content_key(pickle.dumps(component))
    return content_key(component)


def _code(cls: type) -> str:
    """The code of the methods of a user-defined class, as text."""
    own = [base for base in cls.__mro__ if base.__module__.split(".")[0] not in ("mstfilter", "builtins", "abc")]
    values = [value for base in own for value in vars(base).values()]
    inner = [getattr(v, "fget", None) or getattr(v, "func", None) or getattr(v, "__func__", v) for v in values]
    inner = [inspect.unwrap(v) if callable(v) else v for v in inner]  # methods whose results are checked
    seen: set[CodeType] = set()
    return "".join(_with_globals(value, seen) for value in inner if isinstance(value, FunctionType))


def _with_globals(function: FunctionType, seen: set[CodeType]) -> str:
    """The code of a function, and the constants and functions that the function names."""
    seen.add(function.__code__)
    text = _text(function.__code__)
    for name in _names(function.__code__):
        value = function.__globals__.get(name)
        if isinstance(value, FunctionType) and value.__code__ not in seen:
            same_module = value.__globals__ is function.__globals__
            text += _with_globals(value, seen) if same_module else _text(value.__code__)
        elif all(isinstance(v, (str, bytes, int, float)) for v in (value if isinstance(value, tuple) else [value])):
            text += repr(value)
        elif isinstance(value, np.ndarray):
            text += content_key(value).hex()
    return text


def _names(code: CodeType) -> list[str]:
    """The names in compiled code, and in the code of inner functions."""
    inner = [part for part in code.co_consts if isinstance(part, CodeType)]
    return [*code.co_names, *(name for part in inner for name in _names(part))]


def _text(constant: Any) -> str:
    """Text of compiled code (without file name and line numbers), or of a constant in compiled code."""
    if isinstance(constant, CodeType):
        return repr((constant.co_code, constant.co_names)) + "".join(_text(part) for part in constant.co_consts)
    return repr(sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant)


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
