"""What goes on inside a step: which slot is at work, its wall time and its notes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mstfilter.smc.population import Population

__all__ = ["Watch", "telling"]

_told: list[Callable[[str, bool], None]] = []


@contextlib.contextmanager
def telling(listener: Callable[[str, bool], None]) -> Iterator[None]:
    """Tell `listener` the slot, and whether it begins, of all steps of this process: to measure what it takes."""
    _told.append(listener)
    try:
        yield
    finally:
        _told.remove(listener)


class Watch:
    """Times the parts of a step, collects their notes, and knows which part is at work."""

    def __init__(self) -> None:
        self.slot = ""
        self.seconds: dict[str, float] = {}
        self.notes: dict[str, Mapping[str, Any]] = {}
        self._last = time.perf_counter()

    def enter(self, slot: str) -> None:
        """A slot starts to work."""
        for listener in _told:
            listener(slot, True)
        self.slot = slot
        self._last = time.perf_counter()

    def leave(self, population: Population | None = None) -> None:
        """It is done; `population` holds its notes."""
        self.seconds[self.slot] = self.seconds.get(self.slot, 0.0) + time.perf_counter() - self._last
        for listener in _told:
            listener(self.slot, False)
        if population is not None and population.notes:
            self.notes[self.slot] = population.notes
