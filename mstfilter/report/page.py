"""One HTML page: filled in from a template, written whole or not at all.

>>> write_page(path, render("study.html", filters, study=...))


Notes and configurations of unknown structure as rows of text.

>>> flatten({"sampler": {"acceptance": 0.25}, "sizes": [3, 3, 4]})
{'sampler.acceptance': 0.25, 'sizes': [3, 3, 4]}
>>> shown([3, 3, 4]), shown(0.123456)
('3, 3, 4', '0.1235')
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.errors import InputError

__all__ = ["counts", "flatten", "note_rows", "render", "shown", "write_page"]


def render(template: str, filters: Mapping[str, Callable[..., Any]], **content: Any) -> str:
    """Text of a template of this package with the style sheet; what is not given is an error."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    folder = files("mstfilter.report") / "templates"
    environment = Environment(
        loader=FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters)
    style = (folder / "style.css").read_text(encoding="utf-8")
    return environment.get_template(template).render(style=style, **content)


def write_page(path: Path, text: str) -> Path:
    """Write a page under a temporary name and rename it; an `InputError` where that is not possible."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"cannot write report {path}: {error.strerror}", "choose another file") from error
    return path


_LONGEST = 6


def flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Nested mappings as one, keys joined by dots; an empty mapping leaves nothing."""
    if not isinstance(value, Mapping):
        return {path or "value": value}
    rows: dict[str, Any] = {}
    for key, inner in value.items():
        rows.update(flatten(inner, f"{path}.{key}" if path else str(key)))
    return rows


def shown(value: Any) -> str:
    """A value as short text: four digits, long lists by their range."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return _shown_list(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {shown(v)}" for k, v in value.items())
    return str(value)


def _shown_list(values: Sequence[Any]) -> str:
    if len(values) == 0:
        return "none"
    texts = [shown(v) for v in values]
    if len(set(texts)) == 1 and len(texts) > 1:
        return f"{texts[0]} (all {len(texts)})"
    if len(texts) <= _LONGEST:
        return ", ".join(texts)
    if all(isinstance(v, (int, float)) for v in values):
        return f"median {shown(float(np.median(values)))}, {shown(min(values))} to {shown(max(values))}"
    return f"{', '.join(texts[:_LONGEST])}, … ({len(texts)})"


def note_rows(notes: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """One row a key, one column a pause; a key that a pause lacks is shown empty."""
    flat = [flatten(n) if n else {} for n in notes]
    keys = list(dict.fromkeys(key for rows in flat for key in rows))
    return [(key, [shown(rows[key]) if key in rows else "" for rows in flat]) for key in keys]


def counts(notes: Sequence[Mapping[str, Any]]) -> dict[str, list[dict[str, int]]]:
    """Entries that count kinds of things (a mapping of names to whole numbers), by key, one a pause."""
    found: dict[str, list[dict[str, int]]] = {}
    for t, note in enumerate(notes):
        for key, value in note.items():
            whole = isinstance(value, Mapping) and len(value) > 0
            if whole and all(type(v) is int and v >= 0 for v in value.values()):
                found.setdefault(key, [{} for _ in notes])[t] = dict(value)
    return found
