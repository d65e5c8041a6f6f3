"""A codec: how particles of a user's class are stored in a checkpoint.

mstfilter check ./codec.py:MyCodec
python codec.py
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.smc import Codec, Population


@dataclass(frozen=True)
class Shelf:
    """A particle: boxes on a shelf, in order. Particles that are no arrays need a codec."""

    boxes: tuple[str, ...]


@dataclass(frozen=True)
class MyCodec(Codec):
    """Stores shelves as a list of all boxes and the number of boxes on each shelf."""

    def encode(self, particles: Any) -> Mapping[str, np.ndarray]:
        """Named arrays of any shape; numbers and strings, no Python objects."""
        boxes = [box for shelf in particles for box in shelf.boxes]
        return {"boxes": np.array(boxes, dtype="U"), "lengths": np.array([len(s.boxes) for s in particles], np.int64)}

    def decode(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """The particles that were encoded, bit by bit, also in another process."""
        ends = np.cumsum(arrays["lengths"])
        boxes = arrays["boxes"].tolist()
        return tuple(Shelf(tuple(boxes[e - n : e])) for e, n in zip(ends, arrays["lengths"], strict=True))


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """Input for the contract: n particles; the observation is not used."""
    shelves = tuple(Shelf(tuple(rng.choice(["a", "bb", "c"], rng.integers(4)).tolist())) for _ in range(n))
    return Population(shelves), None


if __name__ == "__main__":
    # In a run: save_state("run.npz", state, MyCodec())
    particles = example(np.random.default_rng(0), 4)[0].particles
    arrays = MyCodec().encode(particles)
    print(arrays, MyCodec().decode(arrays) == particles)
