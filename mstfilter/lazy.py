"""Front doors of packages: names that are imported when they are first used.

A package's ``__init__.py`` holds its documentation and two lines::

    from mstfilter.lazy import attach
    __getattr__, __dir__, __all__ = attach(__name__, __file__)

Its ``__init__.pyi`` lists the names, one ``from module import name as name`` statement a module. Type checkers read
the same file. ``import mstfilter.scene`` thus costs nothing, ``from mstfilter.scene import Camera`` imports the
module of `Camera` only (the scheme of Scientific Python's SPEC 1).
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def exported(init: str | Path) -> dict[str, str]:
    """Name -> module, as the stub beside an ``__init__.py`` lists them."""
    tree = ast.parse(Path(init).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [statement for statement in tree.body if isinstance(statement, ast.ImportFrom)]
    return {alias.name: str(statement.module) for statement in imports for alias in statement.names}


def attach(package: str, init: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package whose stub lists its public names."""
    modules = exported(init)
    names = sorted(modules)

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(modules[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: names, names
