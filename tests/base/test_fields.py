"""Bounds in annotations."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Literal, get_origin, get_type_hints

import numpy as np
import pytest

from mstfilter.base.errors import InputError, InputWarning
from mstfilter.base.fields import Bounded, Bounds, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Share
from mstfilter.runs.presets import REGISTRY


class Interface(Bounded):
    pass


@dataclass(frozen=True)
class Part(Interface):
    n: PositiveInt = 1


@dataclass(frozen=True)
class Whole(Bounded):
    part: Interface = Part()
    other: Interface | None = None
    count: NonNegativeInt = 0
    scale: PositiveFloat = 1.0
    reach: NonNegativeFloat = 0.0
    share: Share = 1.0
    ratio: Annotated[float, Bounds(at_least=4, below=10, unit="ratio", hint="try 5")] = 4.0
    order: Literal["first", "last"] = "first"
    free: int = -1


@dataclass(frozen=True)
class Own(Part):
    m: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.m < self.n:
            raise InputError(f"m is {self.m}, expected at least n = {self.n}")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"part": Part}, "part is the class Part, expected an Interface"),
        ({"part": None}, "part is None, expected an Interface"),
        ({"other": "part"}, "other is 'part', expected an Interface"),
        ({"count": -1}, "count is -1, expected an integer of at least 0"),
        ({"count": 1.0}, "count is 1.0, expected an integer of at least 0"),
        ({"scale": 0.0}, "scale is 0.0, expected a finite number above 0"),
        ({"reach": float("inf")}, "reach is inf, expected a finite number of at least 0"),
        ({"share": 1.5}, "share is 1.5, expected a finite number of at least 0 and of at most 1"),
        ({"ratio": 10.0}, "ratio is 10.0, expected a finite ratio of at least 4 and below 10"),
        ({"order": "next"}, "order is 'next', expected first or last"),
    ],
)
def test_values_outside_of_their_bounds_are_named(wrong, message):
    Whole(), Whole(other=Part(), free=-5, count=np.int64(3), scale=np.float32(0.5), share=1)
    with pytest.raises(InputError) as caught:
        Whole(**wrong)
    assert caught.value.message == message
    assert ("try 5" in caught.value.hints) == ("ratio" in wrong)


def test_bounds_are_checked_before_the_conditions_of_the_class():
    for wrong in ({"n": 0}, {"n": 3}):
        with pytest.raises(InputError, match="n is 0, expected an integer" if wrong["n"] == 0 else "at least n = 3"):
            Own(**wrong)


def checks_its_fields(part):
    """Numbers with bounds and choices, also of the parts of a component."""
    for field in fields(part):
        value = getattr(part, field.name)
        if isinstance(value, Bounded) and is_dataclass(value):
            checks_its_fields(value)
        hint = get_type_hints(type(part), include_extras=True)[field.name]
        if get_origin(hint) in (Annotated, Literal):
            with pytest.raises(InputError, match=f"{field.name} is 'nonsense'"):
                replace(part, **{field.name: "nonsense"})


@pytest.mark.parametrize("kind", REGISTRY.kinds)
def test_every_component_checks_its_fields(kind):
    for name in REGISTRY.known(kind):
        component = REGISTRY.build(kind, name)
        if is_dataclass(component):
            checks_its_fields(component)


def test_a_class_with_names_that_its_module_lacks_is_made():
    class Local:
        pass

    @dataclass(frozen=True)
    class Mine(Bounded):
        value: Local

    with pytest.warns(InputWarning, match="are not checked"):
        assert Mine(3).value == 3
