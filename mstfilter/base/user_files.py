"""Loads Python files of the user: components, models and functions named as ``./file.py:Name``.

>>> load_attribute("./mine.py:model")

A file is executed once per process for any spelling of its path, and again if its content has changed. Instances of
its classes can be pickled, because unpickling loads the file.
"""

from __future__ import annotations

import copyreg
import hashlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from mstfilter.base.code import hash_of_script
from mstfilter.base.errors import InputError, install_hint, place_in_user_file, suggestion


def load_class(path: str, attribute: str) -> type:
    """The class that a Python file of the user has under a name."""
    module = load_file(path)
    found = getattr(module, attribute, None)
    if not isinstance(found, type):
        classes = ", ".join(cls.__name__ for cls in _classes_of(module))
        raise InputError(f"{path} has no class {attribute!r}", f"it has: {classes or 'none'}")
    return found


def load_attribute(location: str) -> Any:
    """What a Python file of the user holds under a name: ``./file.py:name``."""
    path, _, name = location.partition(":")
    if not Path(path).is_file():
        raise InputError(f"file does not exist: {path}")
    module = load_file(path)
    if not hasattr(module, name):
        raise InputError(f"{path} has no {name!r}", *suggestion(name, vars(module)))
    return getattr(module, name)


_MODULES: dict[tuple[Path, str], ModuleType] = {}  # resolved path and hash of the content of a file -> its module


def load_file(path: str | Path) -> ModuleType:
    """The module made by executing a Python file. Raises InputError if the file cannot be read or executed."""
    resolved = Path(path).resolve()
    try:
        source = resolved.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    key = resolved, hashlib.sha256(source).hexdigest()
    if key not in _MODULES:
        _MODULES[key] = _executed(path, source, *key)
    return _MODULES[key]


def _executed(path: str | Path, source: bytes, resolved: Path, digest: str) -> ModuleType:
    """A new module from the source of a file. The module's name is unique for its path and content."""
    unique = hashlib.sha256(f"{resolved}\0{digest}".encode()).hexdigest()[:12]
    name = f"mstfilter_user_{resolved.stem}_{unique}"
    spec = importlib.util.spec_from_file_location(name, resolved)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle look their module up
    try:
        # The loader of `spec` takes stale bytecode for a file that is edited twice in a second.
        exec(compile(source, str(resolved), "exec"), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        place = place_in_user_file(error)
        hints = [place] if place else []
        if isinstance(error, ModuleNotFoundError):
            missing = str(error.name).partition(".")[0]
            if (resolved.parent / f"{missing}.py").is_file() or (resolved.parent / missing).is_dir():
                hints.append(f"{missing} lies beside it: set the environment variable PYTHONPATH={resolved.parent}")
            else:
                hints.append(f"if {missing} is a library: {install_hint(missing)}")
        raise InputError(f"{path} cannot be loaded: {type(error).__name__}: {error}", *hints) from error
    code = hash_of_script(resolved, source)
    for cls in _classes_of(module):
        cls.__mst_file__ = f"{resolved}:{cls.__qualname__}"  # type: ignore[attr-defined]
        cls.__mst_source__ = digest  # type: ignore[attr-defined]
        cls.__mst_code__ = code  # type: ignore[attr-defined]
        if (cls.__reduce_ex__, cls.__reduce__) == (object.__reduce_ex__, object.__reduce__):
            cls.__reduce_ex__ = _reduce  # type: ignore[method-assign, assignment]
    return module


def _classes_of(module: ModuleType) -> list[type]:
    """The classes that a module itself defines, without imported classes."""
    return [v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__]


def _reduce(instance: object, protocol: Any) -> Any:
    """Pickle an instance with the path of the class's file, as other processes cannot import the module by name."""
    reduced: Any = object.__reduce_ex__(instance, max(int(protocol), 2))
    how, arguments, *state = reduced
    cls = type(instance)
    if how is not copyreg.__newobj__ or "__mst_file__" not in vars(cls):  # type: ignore[attr-defined]
        return (how, arguments, *state)
    path, _, name = cls.__mst_file__.rpartition(":")  # type: ignore[attr-defined]
    return (_new_instance, (path, name, cls.__mst_source__, *arguments[1:]), *state)  # type: ignore[attr-defined]


def _new_instance(path: str, name: str, digest: str, *arguments: Any) -> Any:
    """A new instance, for unpickling. The user's file that defines the class must have the hash `digest`."""
    module = _MODULES.get((Path(path), digest)) or load_file(path)
    cls = getattr(module, name)
    if cls.__mst_source__ != digest:
        raise InputError(f"{path} has changed since an instance of {name} was pickled", "make the instance again")
    return cls.__new__(cls, *arguments)
