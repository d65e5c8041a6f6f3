"""What the driver makes once a process and shares between all steps."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mstfilter.smc.streams import Key

__all__ = ["identity", "keep_memory", "unused"]


@lru_cache(maxsize=1)
def keep_memory() -> None:
    """Once a process: hand a large block back to the C library.

    glibc learns from it to keep freed memory. Else it gives the arrays of every step back to the system and asks for
    them again, which costs a filter of 10,000 particles a fifth of its time. Where it is another library: nothing.
    """
    np.empty(1 << 21, np.uint8)


@lru_cache(maxsize=8)
def identity(n: int) -> np.ndarray:
    """0 .. n-1, read-only and shared: the parents of particles that stayed in place."""
    index = np.arange(n)
    index.flags.writeable = False
    return index


@lru_cache(maxsize=1)
def unused() -> np.random.Generator:
    """For components that draw nothing: making a stream for them would be for nothing too."""
    return Key(0).child("unused").generator()
