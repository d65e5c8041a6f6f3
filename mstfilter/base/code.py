"""Hashes of Python code, by which results are known to be of the same program.

Comments, docstrings, layout and the version number leave them as they are, because results do not depend on these:

>>> code_of(b"x = 1  # one") == code_of(b"x  =  1")
True
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path

_Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@lru_cache(maxsize=2000)
def code_of(source: bytes) -> bytes:
    """The syntax tree of Python code without docstrings and version number; of other text, the text itself.

    Comments and layout are not part of a syntax tree.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return source
    for node in _documented(tree):
        if ast.get_docstring(node, clean=False):
            del node.body[0]
    tree.body = [node for node in tree.body if not _is_version(node)]
    return ast.dump(tree).encode()


def _documented(tree: ast.AST) -> Iterator[_Documented]:
    """The module, the classes and the functions of a tree; they stand in statements, so expressions are left out."""
    if isinstance(tree, _Documented):
        yield tree
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        found = getattr(tree, name, ())
        for node in found if isinstance(found, list) else ():
            yield from _documented(node)


def _is_version(node: ast.stmt) -> bool:
    return isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__version__"


def hash_of_script(path: Path, source: bytes) -> str:
    """A hash of a Python file and of the files beside it that it imports, without comments and docstrings."""
    found, todo = {path: source}, [source]
    while todo:
        for name in _imported(todo.pop()):
            beside = path.parent / name.replace(".", "/")
            for file in (beside.with_suffix(".py"), beside / "__init__.py"):
                if file not in found and file.is_file():
                    found[file] = file.read_bytes()
                    todo.append(found[file])
    digest = hashlib.sha256()
    for content in (source, *(found[file] for file in sorted(found) if file != path)):
        digest.update(code_of(content))
    return digest.hexdigest()


def _imported(source: bytes) -> Iterator[str]:
    """The names of the modules that Python code imports, and of their packages."""
    for node in ast.walk(ast.parse(source)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{name}" for name in names)]
        for name in names:
            parts = name.split(".")
            yield from (".".join(parts[: k + 1]) for k in range(len(parts)))


def hash_of_files(root: Path, names: Iterable[str]) -> str:
    """A hash of files of a folder: their names and contents, of Python files without comments and docstrings."""
    digest = hashlib.sha256()
    for name in sorted(names):
        content = (root / name).read_bytes()
        digest.update(name.encode() + b"\0" + (code_of(content) if name.endswith(".py") else content))
    return digest.hexdigest()[:16]
