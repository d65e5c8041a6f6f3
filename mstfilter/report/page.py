"""One HTML page: filled in from a template, written whole or not at all.

>>> write_page(path, render("study.html", filters, study=...))
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from mstfilter.errors import InputError

__all__ = ["render", "write_page"]


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
