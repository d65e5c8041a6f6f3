"""What goes on inside a step: which slot is at work, its wall time and its notes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from mstfilter.smc.population import Population

__all__ = ["Watch"]


class Watch:
    """Times the parts of a step, collects their notes, and knows which part is at work."""

    def __init__(self) -> None:
        self.slot = ""
        self.seconds: dict[str, float] = {}
        self.notes: dict[str, Mapping[str, Any]] = {}
        self._last = time.perf_counter()

    def enter(self, slot: str) -> None:
        """A slot starts to work."""
        self.slot = slot
        self._last = time.perf_counter()

    def leave(self, population: Population | None = None) -> None:
        """It is done; `population` holds its notes."""
        self.seconds[self.slot] = self.seconds.get(self.slot, 0.0) + time.perf_counter() - self._last
        if population is not None and population.notes:
            self.notes[self.slot] = population.notes
