"""A particle of changing structure: an immutable mapping from names to values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

__all__ = ["Trace"]


class Trace(Mapping[str, Any]):
    """Values by name; what a `per_particle` program makes of one particle.

    Parameters
    ----------
    values : mapping
        Numbers, strings or arrays.
    """

    __slots__ = ("_values",)

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"Trace({self._values!r})"
