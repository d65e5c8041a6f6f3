"""All labelled configurations of a few cells, up to the names of the objects.

>>> states = all_states((3, 2))
>>> len(states)                        # partitions of 6 cells and "free": the Bell number of 7
877
>>> states.index([states.hypotheses[5]])
array([5])

A configuration gives each cell to an object or to free space. Two that differ by the names of objects alone are one
state; its name is the labelling whose objects are numbered by their first cell. Objects may be in several pieces,
since crossover can make such.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np

from mstfilter.errors import InputError
from mstfilter.scene import Hypothesis, VoxelGrid, read_only

__all__ = ["MAX_CELLS", "States", "all_states"]

MAX_CELLS = 7  # 4140 states; one more cell makes 21147


@dataclass(frozen=True, eq=False)
class States:
    """The state space of a miniature world.

    Parameters
    ----------
    grid : VoxelGrid
        (X, Y, 1) cells.
    labels : (S, X Y) uint8
        Label of each cell in each state, cell (x, y) at x Y + y; 0 is free.
    """

    grid: VoxelGrid
    labels: np.ndarray
    _seen: dict[bytes, int] = field(default_factory=dict, repr=False)  # raw labels met so far -> state

    def __len__(self) -> int:
        return len(self.labels)

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The states as particles."""
        return tuple(Hypothesis.from_labels(row.reshape(self.grid.shape), self.grid) for row in self.labels)

    @cached_property
    def _number(self) -> dict[bytes, int]:
        return {row.tobytes(): s for s, row in enumerate(self.labels)}

    def index(self, hypotheses: Iterable[Hypothesis]) -> np.ndarray:
        """(n,) int: the state of each hypothesis."""
        return np.array([self.index_of_labels(h.labels) for h in hypotheses], dtype=np.int64)

    def index_of_labels(self, labels: np.ndarray) -> int:
        """The state of a label grid, whatever its objects are called."""
        raw = np.asarray(labels, dtype=np.uint16).tobytes()
        found = self._seen.get(raw)
        if found is None:
            names: dict[int, int] = {0: 0}
            flat = np.asarray(labels).ravel().tolist()
            row = np.array([names.setdefault(int(k), len(names)) for k in flat], dtype=np.uint8)
            found = self._seen[raw] = self._number[row.tobytes()]
        return found

    def take(self, index: np.ndarray) -> tuple[Hypothesis, ...]:
        """Particles of the given states."""
        return tuple(self.hypotheses[int(s)] for s in index)

    @cached_property
    def n_objects(self) -> np.ndarray:
        """(S,) number of objects."""
        return self.labels.max(axis=1).astype(np.int64)

    @cached_property
    def occupied(self) -> np.ndarray:
        """(S, cells) bool."""
        return read_only(self.labels > 0)

    @cached_property
    def pairs(self) -> np.ndarray:
        """(P, 2) all pairs of cells."""
        return np.array(list(combinations(range(self.labels.shape[1]), 2)), dtype=np.int64)

    @cached_property
    def same_object(self) -> np.ndarray:
        """(S, P) bool: the two cells of a pair belong to one object."""
        a, b = self.labels[:, self.pairs[:, 0]], self.labels[:, self.pairs[:, 1]]
        return read_only((a == b) & (a > 0))

    @cached_property
    def extra_pieces(self) -> np.ndarray:
        """(S,) pieces (joined along edges of cells) beyond one an object."""
        from scipy.ndimage import label

        X, Y, _ = self.grid.shape
        extra = np.zeros(len(self), np.int64)
        for s, row in enumerate(self.labels):
            grid = row.reshape(X, Y)
            extra[s] = sum(label(grid == k)[1] - 1 for k in range(1, int(row.max()) + 1))
        return extra


@lru_cache(maxsize=16)
def all_states(shape: tuple[int, int]) -> States:
    """Every state of a table of X by Y cells.

    Raises
    ------
    InputError
        Where there are more cells than can be enumerated.
    """
    X, Y = shape
    if X < 1 or Y < 1 or X * Y > MAX_CELLS:
        raise InputError(
            f"a miniature world of {X} x {Y} cells, expected 1 to {MAX_CELLS} cells",
            "the number of states grows as the Bell numbers: 877 for 6 cells, 4140 for 7, 21147 for 8",
        )
    rows: list[tuple[int, ...]] = [()]
    for _ in range(X * Y):
        rows = [(*row, k) for row in rows for k in range(max(row, default=0) + 2)]
    return States(VoxelGrid((0.0, 0.0, 0.0), 0.1, (X, Y, 1)), read_only(np.array(rows, dtype=np.uint8)))  # type: ignore[arg-type]
