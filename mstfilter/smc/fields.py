"""Checks of the fields of components, with one wording: what, the value found, what was expected.

>>> number("share", 0.5, above=0.0, at_most=1.0)
>>> whole("k", 2)
>>> part("scheme", Systematic(), Resampler)

Each raises an `InputError` where the value is of no use; hints say what was probably meant.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mstfilter.errors import InputError

__all__ = ["number", "part", "whole"]


def number(
    name: str,
    value: Any,
    *hints: str,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    below: float = math.inf,
    unit: str = "number",
) -> None:
    """A finite number, ``above < value < below`` and ``at_least <= value <= at_most``."""
    numeric = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if numeric and math.isfinite(value) and above < value < below and at_least <= value <= at_most:
        return
    bounds = (
        f"above {above:g}" if above > -math.inf else "",
        f"of at least {at_least:g}" if at_least > -math.inf else "",
        f"of at most {at_most:g}" if at_most < math.inf else "",
        f"below {below:g}" if below < math.inf else "",
    )
    wanted = " and ".join(b for b in bounds if b)
    raise InputError(f"{name} is {value!r}, expected a finite {unit} {wanted}".rstrip(), *hints)


def whole(name: str, value: Any, *hints: str, at_least: int = 1) -> None:
    """A whole number of at least `at_least`."""
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= at_least:
        return
    raise InputError(f"{name} is {value!r}, expected a whole number of at least {at_least}", *hints)


def part(name: str, value: Any, interface: type, optional: bool = False) -> None:
    """A component of an interface; None too where it is optional."""
    if isinstance(value, interface) or (optional and value is None):
        return
    hint = ""
    if isinstance(value, type) and issubclass(value, interface):
        hint = f"pass an instance: {name}={value.__name__}(...)"
    elif isinstance(value, str):
        hint = "names are for presets and the command line; in Python pass a component"
    article = "an" if interface.__name__[0] in "AEIOU" else "a"
    found = value.__name__ if isinstance(value, type) else repr(value)
    found = f"the class {found}" if isinstance(value, type) else found
    raise InputError(f"{name} is {found}, expected {article} {interface.__name__}", *([hint] if hint else []))
