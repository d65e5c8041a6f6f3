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
    """The methods and class attributes of a user-defined class, as text."""
    return _described(cls, "", set())


def _described(value: Any, module: str, seen: set[int]) -> str:
    """Text of a value on which the code of a user depends. `module` is the module of the code that names the value.

    The text of a function includes its defaults, and the values that the function names. Instances of other classes,
    and the inner parts of functions of other modules, are left out.
    """
    if isinstance(value, np.ndarray):
        return content_key(value).hex()
    if isinstance(value, (str, bytes, int, float, complex, np.generic, type(None))):
        return repr(value)
    if isinstance(value, Mapping):
        return "".join(_described(part, module, seen) for item in value.items() for part in item)
    if isinstance(value, (tuple, list, set, frozenset)):
        parts = [_described(part, module, seen) for part in value]
        return "".join(parts if isinstance(value, (tuple, list)) else sorted(parts))
    if id(value) in seen or (module not in ("", getattr(value, "__module__", module)) and isinstance(value, type)):
        return ""
    if isinstance(value, type):
        seen.add(id(value))
        own = [
            base for base in value.__mro__ if base.__module__.split(".")[0] not in ("mstfilter", "builtins", "abc")
        ]
        items = ((base.__module__, *item) for base in own for item in vars(base).items())
        chosen = [item for item in items if isinstance(item[2], FunctionType) or not item[1].startswith("__")]
        return "".join(name + _described(part, of, seen) for of, name, part in chosen)
    inner = getattr(value, "fget", None) or getattr(value, "func", None) or getattr(value, "__func__", value)
    inner = inspect.unwrap(inner) if callable(inner) else inner  # methods whose results are checked
    if not isinstance(inner, FunctionType) or id(inner) in seen:
        return ""
    text = _text(inner.__code__)
    if module != inner.__module__:
        return text
    seen.add(id(inner))
    closure = inspect.getclosurevars(inner).nonlocals
    named = [inner.__globals__.get(name) for name in _names(inner.__code__)]
    for part in (inner.__defaults__, inner.__kwdefaults__, closure, named):
        text += _described(part, module, seen)
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
