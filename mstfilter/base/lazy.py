"""Lazy imports: names of a package are imported at their first use, and methods import drawing code when called.

The ``__init__.py`` of a package contains the package's documentation and two lines:

>>> from mstfilter.base.lazy import attach
>>> __getattr__, __dir__, __all__ = attach(__name__, __file__)      # doctest: +SKIP

The stub ``__init__.pyi`` lists the public names, with one ``from module import name as name`` statement per module.
Type checkers also read the stub. With lazy imports, ``import mstfilter.scene`` is fast, and ``from mstfilter.scene
import Camera`` imports only the module of `Camera` (the scheme of Scientific Python's SPEC 1).
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import os
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from mstfilter.base.errors import MissingLibraryError, exhausted, missing_library


def exported(init: str | Path) -> dict[str, str]:
    """Mapping from public names to modules, read from the stub beside an ``__init__.py``."""
    tree = ast.parse(Path(init).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [statement for statement in tree.body if isinstance(statement, ast.ImportFrom)]
    return {alias.name: str(statement.module) for statement in imports for alias in statement.names}


def attach(package: str, init: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package with a stub that lists the public names."""
    modules = exported(init)
    names = sorted(modules)

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(modules[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: names, names


def short_repr(component: Any) -> str:
    """A short repr: for a dataclass, the fields that differ from the defaults; for other objects, the class name."""
    parts = []
    for field in dataclasses.fields(component) if dataclasses.is_dataclass(component) else ():
        value = getattr(component, field.name, None)
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        if field.repr and not (value is default or (type(value) is type(default) and _equal(value, default))):
            nested = dataclasses.is_dataclass(value) and not isinstance(value, type)
            text = short_repr(value) if nested and not hasattr(value, "_repr_html_") else repr(value)
            parts.append(f"{field.name}={text if len(text) <= 200 else f'{text[:196]} ...'}")
    text = f"{type(component).__name__}({', '.join(parts)})"
    return text if len(text) <= 300 else f"{text[:295]} ...)"


def _equal(a: Any, b: Any) -> bool:
    try:
        return bool(a == b)
    except ValueError:  # arrays
        return False


def late(location: str, summary: str) -> Callable[..., Any]:
    """A method that calls the function `location` (``module:function``) and imports the module at the first call.

    Methods that plot and methods that find pauses use `late`. So `mstfilter.scene` and `mstfilter.smc` do not depend
    on `mstfilter.app.report` and `mstfilter.formats`.
    """
    module, _, name = location.partition(":")

    def method(self: Any, *arguments: Any, **named: Any) -> Any:
        return getattr(import_module(module), name)(self, *arguments, **named)

    method.__doc__ = f"{summary} See `{module}.{name}`."
    method.__name__ = name
    return method


@contextlib.contextmanager
def progress_of(progress: Any, what: str = "", bars: str = "progress_bar") -> Iterator[Callable[..., None]]:
    """A function to call with progress. If `progress` is True, it updates a bar of `mstfilter.app.report.progress`.

    Otherwise it is the function `progress`, or a function without effect if `progress` is False.
    """
    if progress is True:
        with getattr(import_module("mstfilter.app.report.progress"), bars)(*([what] if what else [])) as advance:
            yield advance
    else:
        yield progress or (lambda *arguments: None)


# A forked process has no copy of OpenCV's threads and would wait for them for ever, so they end before a fork.
_opencv_threads = 1


def _end_threads_of_opencv() -> None:
    global _opencv_threads
    opencv: Any = sys.modules.get("cv2")
    if hasattr(opencv, "setNumThreads"):
        _opencv_threads = opencv.getNumThreads()
        opencv.setNumThreads(1)


def _restore_threads_of_opencv() -> None:
    opencv: Any = sys.modules.get("cv2")
    if hasattr(opencv, "setNumThreads"):
        opencv.setNumThreads(_opencv_threads)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_end_threads_of_opencv, after_in_parent=_restore_threads_of_opencv)


SYSTEM_PACKAGES = ("libusb-1.0-0", "libgl1", "libegl1", "libgomp1")


def import_open3d() -> ModuleType:
    """Import open3d, limited to one thread. Only this function imports the package, which needs system libraries.

    With several threads the order of a parallel sum varies, so the last digits of results vary. Raises
    MissingLibraryError if the package or a required system library is missing, and InputError if memory runs out.
    """
    try:
        open3d = import_module("open3d")
    except ModuleNotFoundError as error:
        raise missing_library(error, "this function") from error
    except (ImportError, OSError) as error:  # a shared library does not load
        if short := exhausted(error):
            raise short.with_message(f"out of memory: open3d cannot be loaded: {error}") from error
        raise MissingLibraryError(
            f"open3d cannot be imported: {error}",
            f"install its libraries: apt-get install {' '.join(SYSTEM_PACKAGES)}",
        ) from error
    open3d.utility.set_max_threads(1)
    return open3d
