"""The version of the code that a result depends on: a hash of the modules that its components reach.

>>> code_version(["mstfilter.fusion.update"])
'6f1f...'

Imports are followed, also those inside functions. Comments, docstrings and layout do not count, so a better
sentence repeats no run; any change of what is computed does.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

__all__ = ["code_version", "files_version", "package_version", "reached"]

_PACKAGE = "mstfilter"


def code_version(modules: Iterable[str]) -> str:
    """A hash of the code of modules of the package and of all modules of the package that they import."""
    digest = hashlib.sha256()
    for module in sorted(reached(modules)):
        path = _path(module)
        assert path is not None
        digest.update(f"{module}:{_parsed(path, path.stat().st_mtime_ns)[0]}\n".encode())
    return digest.hexdigest()[:16]


def files_version(modules: Iterable[str]) -> str:
    """A hash of the files of exactly these modules, byte by byte: quick, and stricter than `code_version`."""
    digest = hashlib.sha256()
    for module in sorted(modules):
        path = _path(module)
        digest.update(f"{module}:".encode() + (b"" if path is None else path.read_bytes()))
    return digest.hexdigest()[:16]


def package_version() -> str:
    """A hash of all files of the package."""
    import mstfilter

    root = Path(mstfilter.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}:".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def reached(modules: Iterable[str]) -> set[str]:
    """Modules of the package that these import, directly or not, and they themselves."""
    found: set[str] = set()
    waiting = [m for m in modules if m.split(".")[0] == _PACKAGE]
    while waiting:
        module = waiting.pop()
        path = _path(module)
        if module in found or path is None or module == _PACKAGE:  # the root only passes names on
            continue
        found.add(module)
        for name in _parsed(path, path.stat().st_mtime_ns)[1]:
            # `from package import name`: a module, or something in the package
            waiting.append(name if _path(name) is not None else name.rpartition(".")[0])
    return found


@lru_cache(maxsize=4096)
def _path(module: str) -> Path | None:
    """The file of a module of the package, found without importing anything; None where there is none."""
    root = find_spec(_PACKAGE)
    if root is None or root.origin is None:
        return None
    place = Path(root.origin).parent.joinpath(*module.split(".")[1:])
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


@lru_cache(maxsize=4096)
def _parsed(path: Path, changed: int) -> tuple[str, tuple[str, ...]]:
    """Hash of a file's code, and the names it imports from the package."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.extend(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.append(node.module)
            names.extend(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                node.body = node.body[1:]
    code = hashlib.sha256(ast.dump(tree).encode()).hexdigest()
    return code, tuple(n for n in names if n.split(".")[0] == _PACKAGE)
