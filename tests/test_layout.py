"""The shape of the package: names that are public once, front doors, no import cycles."""

from __future__ import annotations

import ast
import functools
from collections import defaultdict
from pathlib import Path

import networkx as nx
import pytest

from mstfilter.base.lazy import exported
from tests.conftest import REPOSITORY

PACKAGE = REPOSITORY / "mstfilter"
FILES = sorted(PACKAGE.rglob("*.py"))


@functools.cache
def trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}


def module_of(path: Path) -> str:
    parts = path.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


def public_definitions(tree: ast.Module) -> list[str]:
    """Classes, functions and constants that a module defines under a public name."""
    names = []
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.append(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names += [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
    return [name for name in names if not name.startswith("_")]


def imported_modules(tree: ast.Module) -> set[str]:
    """Modules that a module imports anywhere, also inside functions; names of front doors are followed."""
    checked = [
        node
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in ast.walk(block)
    ]
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import) and node not in checked:
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node not in checked:
            for alias in node.names:
                found.add(source_of(str(node.module), alias.name))
    return found & MODULES.keys()


def source_of(module: str, name: str) -> str:
    """The module that defines what ``from module import name`` imports."""
    if f"{module}.{name}" in MODULES:
        return f"{module}.{name}"
    path = MODULES.get(module)
    if path is not None and path.name == "__init__.py" and path.with_suffix(".pyi").exists():
        inner = exported(path).get(name)
        return module if inner is None else source_of(inner, name)
    return module


def test_a_public_name_is_defined_once():
    where = defaultdict(list)
    for path, tree in trees().items():
        if "templates" not in path.parts:
            for name in public_definitions(tree):
                where[name].append(module_of(path))
    assert {name: modules for name, modules in where.items() if len(modules) > 1} == {}


def test_no_module_imports_itself_through_others():
    graph = nx.DiGraph(
        [(module_of(path), other) for path, tree in trees().items() for other in imported_modules(tree)]
    )
    graph.remove_edges_from(nx.selfloop_edges(graph))
    assert [sorted(group) for group in nx.strongly_connected_components(graph) if len(group) > 1] == []


@pytest.mark.parametrize("init", sorted(PACKAGE.rglob("__init__.pyi")), ids=lambda path: path.parent.name)
def test_a_front_door_exports_what_its_modules_define(init):
    for name, module in exported(init).items():
        inner = MODULES[module]
        assert name in public_definitions(trees()[inner]) or inner.name == "__init__.py", f"{module} {name}"
        assert f"{module_of(init.with_suffix('.py'))}.{name}" not in MODULES, f"{name} is a module and a name"
