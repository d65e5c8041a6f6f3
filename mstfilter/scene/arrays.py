"""Read-only arrays, and keys that identify values by their content."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import pickle
from collections.abc import Mapping
from enum import Enum
from functools import cached_property, partial
from pathlib import PurePath
from types import CodeType, FunctionType, MappingProxyType
from typing import Any

import numpy as np

_MANY = 1000  # entries of a container beyond which it is hashed as a whole


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


def _code(cls: type) -> bytes | str:
    """A hash of the methods and class attributes of a user-defined class; "" for a class of this package."""
    return _described(cls, "", set()) if _own_bases(cls) else ""


def _own_bases(cls: type) -> list[type]:
    return [base for base in cls.__mro__ if base.__module__.split(".")[0] not in ("mstfilter", "builtins", "abc")]


def _described(value: Any, module: str, seen: set[int]) -> bytes:
    """A hash of a value that the code of a user names. `module` is the module of this code ("" for any).

    The hash of a function includes its defaults, the cells of its closure, and the global values that the function
    names. Functions of other modules are known by their code alone. Containers count with their present content.
    Instances of other classes are left out.
    """
    if isinstance(value, np.ndarray):
        return content_key(value if value.dtype.kind in "biufcSU" else repr(value.tolist()))
    if isinstance(value, (str, bytes, int, float, complex, np.generic, PurePath, Enum, range, type(None))):
        return content_key(repr(value))
    if id(value) in seen:
        return b""
    inner: Any = ()
    if isinstance(value, (dict, MappingProxyType)):
        inner = [part for item in value.items() for part in item]
    elif isinstance(value, (tuple, list, set, frozenset)):
        inner = value
    elif isinstance(value, property):
        inner = value.fget, value.fset
    elif isinstance(value, (staticmethod, classmethod)):
        inner = (value.__func__,)
    elif isinstance(value, cached_property):
        inner = (value.func,)
    elif isinstance(value, partial):
        inner = value.func, value.args, value.keywords
    elif isinstance(value, FunctionType):
        return _described_function(inspect.unwrap(value), module, seen)
    elif isinstance(value, type) and module in ("", value.__module__):
        seen.add(id(value))
        items = [(base.__module__, *item) for base in _own_bases(value) for item in vars(base).items()]
        chosen = [item for item in items if isinstance(item[2], FunctionType) or not item[1].startswith("__")]
        return content_key(*(part for of, name, v in chosen for part in (name, _described(v, of, seen))))
    if not inner:
        return b""
    if isinstance(value, (list, dict)):
        seen.add(id(value))  # they may contain themselves
    if len(inner) > _MANY:
        with contextlib.suppress(Exception):
            return content_key(pickle.dumps(value))
    parts = [_described(part, module, seen) for part in inner]
    return content_key(type(value).__name__, *(sorted(parts) if isinstance(value, (set, frozenset)) else parts))


def _described_function(function: Any, module: str, seen: set[int]) -> bytes:
    code = _text(function.__code__)
    if id(function) in seen or module != function.__module__:
        return content_key(code)
    seen.add(id(function))
    values = [function.__defaults__, function.__kwdefaults__]
    values += [function.__globals__.get(name) for name in _names(function.__code__)]
    for cell in function.__closure__ or ():
        with contextlib.suppress(ValueError):  # a cell without a value
            values.append(cell.cell_contents)
    return content_key(code, *(_described(value, module, seen) for value in values))


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
