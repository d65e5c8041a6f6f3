"""HTML pages: templates, and short texts for values of unknown structure.

>>> write_page(path, fill_template("study.html", filters, study=...))  # doctest: +SKIP
>>> flatten({"sampler": {"acceptance": 0.25}, "sizes": [3, 3, 4]})
{'sampler.acceptance': 0.25, 'sizes': [3, 3, 4]}
>>> short_text([3, 3, 4]), short_text(0.123456)
('3, 3, 4', '0.1235')
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from mstfilter.base.files import write_text, writing

_LONGEST = 6  # lists up to this length are written in full


def fill_template(template: str, filters: Mapping[str, Callable[..., Any]], **content: Any) -> str:
    """The text of a page from a template of this package and `content`. Missing values raise an error."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    folder = files("mstfilter.app.report") / "templates"
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
    """Write a page; raises InputError if the file cannot be written."""
    with writing(f"report {path}", "choose another file"):
        write_text(path, text)
    return path


def seconds_text(value: float) -> str:
    """A duration as text, in ms or s."""
    if 0 < value < 0.0005:
        return "< 1 ms"
    if value < 0.0995:
        return f"{1000 * value:.0f} ms"
    return f"{value:.2f} s" if value < 9.95 else f"{value:.0f} s"


def flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Nested mappings as one mapping, with keys joined by dots. Empty mappings are omitted."""
    if not isinstance(value, Mapping):
        return {path or "value": value}
    rows: dict[str, Any] = {}
    for key, inner in value.items():
        rows.update(flatten(inner, f"{path}.{key}" if path else str(key)))
    return rows


def short_text(value: Any) -> str:
    """A value as short text: numbers with four digits, long lists by median and range."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return _list_text(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {short_text(v)}" for k, v in value.items())
    return str(value)


def _list_text(values: Sequence[Any]) -> str:
    if len(values) == 0:
        return "none"
    texts = [short_text(v) for v in values]
    if len(set(texts)) == 1 and len(texts) > 1:
        return f"{texts[0]} (all {len(texts)})"
    if len(texts) <= _LONGEST:
        return ", ".join(texts)
    if all(isinstance(v, (int, float)) for v in values):
        middle = short_text(float(np.median(values)))
        return f"median {middle}, {short_text(min(values))} to {short_text(max(values))}"
    return f"{', '.join(texts[:_LONGEST])}, … ({len(texts)})"


def note_rows(notes: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """A table of the values that a component stored: a row per key, a column per pause, empty texts if missing."""
    flat = [flatten(n) if n else {} for n in notes]
    keys = list(dict.fromkeys(key for rows in flat for key in rows))
    return [(key, [short_text(rows[key]) if key in rows else "" for rows in flat]) for key in keys]
