"""Errors and warnings that a user can mend: what is wrong, where, the value found; then what to do.

>>> from mstfilter.errors import InputError
>>> raise InputError("depth image 000003.png is empty", "record the frame again")
Traceback (most recent call last):
...
mstfilter.errors.InputError: depth image 000003.png is empty

`check_number`, `check_integer`, `check_choice` and `check_component` check the fields of components with one wording.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any


class _WithHints(Exception):
    def __init__(self, message: str, *hints: str) -> None:
        super().__init__(message)
        self.message = message
        self.hints = hints


class InputError(_WithHints, ValueError):
    """Input that cannot be used.

    `message` is one line: what is wrong, where, and the value found. Each hint is one line: what the user can do
    about it.
    """


class MissingLibraryError(InputError):
    """A library or a system package that a chosen component needs is not there."""


class LostRunError(InputError):
    """No particle explains an observation: the estimate of the evidence is 0, and the run cannot continue."""


class InputWarning(_WithHints, UserWarning):
    """Input that can be used but is probably not what was meant; message and hints as for `InputError`.

    The command line shows it as one ``warning:`` line.
    """


def check_number(
    name: str,
    value: Any,
    *hints: str,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    below: float = math.inf,
    unit: str = "number",
) -> None:
    """Raise InputError unless `value` is finite, ``above < value < below`` and ``at_least <= value <= at_most``."""
    numeric = isinstance(value, Real) and not isinstance(value, bool)
    if numeric and math.isfinite(value) and above < value < below and at_least <= value <= at_most:
        return
    bounds = (
        f"above {above:g}" if above > -math.inf else "",
        f"of at least {at_least:g}" if at_least > -math.inf else "",
        f"of at most {at_most:g}" if at_most < math.inf else "",
        f"below {below:g}" if below < math.inf else "",
    )
    expected = " and ".join(bound for bound in bounds if bound)
    raise InputError(f"{name} is {value!r}, expected a finite {unit} {expected}".rstrip(), *hints)


def check_integer(name: str, value: Any, *hints: str, at_least: int = 1) -> None:
    """Raise InputError unless `value` is an integer of at least `at_least`."""
    if isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= at_least:
        return
    raise InputError(f"{name} is {value!r}, expected an integer of at least {at_least}", *hints)


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise InputError unless `value` is one of `choices`."""
    if value not in choices:
        raise InputError(f"{name} is {value!r}, expected {', '.join(choices[:-1])} or {choices[-1]}")


def check_component(name: str, value: Any, interface: type, optional: bool = False) -> None:
    """Raise InputError unless `value` is an instance of `interface`, or None where it is optional."""
    if isinstance(value, interface) or (optional and value is None):
        return
    hints = []
    if isinstance(value, type) and issubclass(value, interface):
        hints = [f"pass an instance: {name}={value.__name__}(...)"]
    elif isinstance(value, str):
        hints = ["names are for presets and the command line; in Python pass a component"]
    article = "an" if interface.__name__[0] in "AEIOU" else "a"
    found = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
    raise InputError(f"{name} is {found}, expected {article} {interface.__name__}", *hints)
