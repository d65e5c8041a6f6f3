"""Bounds of fields, which are stated in the annotations of a dataclass and checked when an instance is made.

>>> from dataclasses import dataclass
>>> from typing import Annotated, Literal
>>> from mstfilter.base.fields import Bounded, Bounds, PositiveInt
>>> @dataclass(frozen=True)
... class Tempering(Bounded):
...     steps: PositiveInt = 10
...     power: Annotated[float, Bounds(above=0, below=1, unit="exponent")] = 0.5
...     order: Literal["first", "last"] = "first"
>>> Tempering(power=2.0)
Traceback (most recent call last):
mstfilter.base.errors.InputError: power is 2.0, expected a finite exponent above 0 and below 1

A field is checked if its annotation is a number with `Bounds`, a ``Literal``, or a subclass of `Bounded` such as the
interface of a component, also as ``Interface | None``. Other fields are not checked.

A class with conditions on several fields defines ``__post_init__``, which calls ``super().__post_init__()`` first.
"""

from __future__ import annotations

import copy
import functools
import math
import types
import typing
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, TypeVar

from mstfilter.base.errors import InputWarning, check_choice, check_component, check_integer, check_number


@dataclass(frozen=True)
class Bounds:
    """Bounds of a number, for ``Annotated[float, Bounds(...)]``. For an int, use only `at_least` and `at_most`."""

    above: float = -math.inf
    at_least: float = -math.inf
    at_most: float = math.inf
    below: float = math.inf
    unit: str = "number"  #: name of a float in the error, as in "expected a finite distance above 0"
    hint: str = ""  #: hint for the user about a wrong value


PositiveInt = Annotated[int, Bounds(at_least=1)]
NonNegativeInt = Annotated[int, Bounds(at_least=0)]
PositiveFloat = Annotated[float, Bounds(above=0)]
NonNegativeFloat = Annotated[float, Bounds(at_least=0)]
Share = Annotated[float, Bounds(at_least=0, at_most=1)]


class Bounded:
    """Base class of dataclasses whose fields are checked by ``__post_init__``."""

    def __post_init__(self) -> None:
        """Raise InputError if a field is outside of its bounds."""
        cls: type = type(self)
        for name, check in _checks(cls):
            check(name, getattr(self, name))


_Check = Callable[[str, Any], None]


@functools.cache
def _checks(cls: Any) -> tuple[tuple[str, _Check], ...]:
    """Names of the checked fields of a dataclass, with their checks."""
    try:
        hints = typing.get_type_hints(cls, include_extras=True)
    except NameError as error:  # a name that only a function or a type checker knows
        fact = f"the fields of {cls.__qualname__} are not checked, as an annotation has an unknown name: {error}"
        warnings.warn(InputWarning(fact, "define or import the name in the module of the class"), stacklevel=4)
        return ()
    found = ((field.name, _check_of(hints[field.name])) for field in fields(cls))
    return tuple((name, check) for name, check in found if check is not None)


def _check_of(annotation: Any) -> _Check | None:
    """The check ``check(name, value)`` of a field with this annotation; None if the annotation has no bounds."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        return functools.partial(check_choice, choices=parts)
    if origin is Annotated:
        return next((_check_of_number(parts[0], part) for part in parts[1:] if isinstance(part, Bounds)), None)
    optional = origin in (types.UnionType, typing.Union) and len(parts) == 2 and parts[1] is type(None)
    interface = parts[0] if optional else annotation
    if isinstance(interface, type) and issubclass(interface, Bounded):
        return functools.partial(check_component, interface=interface, optional=optional)
    return None


def _check_of_number(kind: type, bounds: Bounds) -> _Check:
    hints = [bounds.hint] if bounds.hint else []
    if kind is int:
        least, most = int(bounds.at_least), bounds.at_most
        return lambda name, value: check_integer(name, value, *hints, at_least=least, at_most=most)
    limits = {name: getattr(bounds, name) for name in ("above", "at_least", "at_most", "below", "unit")}
    return lambda name, value: check_number(name, value, *hints, **limits)


_Component = TypeVar("_Component")


def bound_to(component: _Component, **attributes: Any) -> _Component:
    """A copy of a frozen component with additional attributes that are not fields, such as data of one pause."""
    bound = copy.copy(component)
    for name, value in attributes.items():
        object.__setattr__(bound, name, value)
    return bound


def copied(component: Any) -> Any:
    """A deep copy. Functions, and objects that cannot be copied, are returned unchanged."""
    try:
        return copy.deepcopy(component)
    except Exception:  # for example a lock or a module in a field
        return component
