"""Merging regions best first, by a judgement that may change as they grow."""

from __future__ import annotations

import heapq
from collections.abc import Callable

import numpy as np

from mstfilter.segmentation.regions import BORDER, REGION, Regions

__all__ = ["Agglomeration"]

#: Log odds (k,) that the regions of k pairs belong to different objects:
#: (rows of a, rows of b, borders, table borders of a, of b).
Judge = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]

_NONE = np.zeros(len(BORDER))


class Agglomeration:
    """Regions that merge one pair after another.

    Parameters
    ----------
    regions : Regions
        Region 0, the table, takes no part.
    judge : callable
        Log odds that pairs belong to different objects.
    """

    def __init__(self, regions: Regions, judge: Judge) -> None:
        n = len(regions.sums)
        self.judge = judge
        self.n_regions = n
        self.sums = np.zeros((2 * n, regions.sums.shape[1]))
        self.sums[:n] = regions.sums
        self.borders: list[dict[int, np.ndarray]] = [dict(near) for near in regions.borders]
        self.table = [near.pop(0, _NONE) for near in self.borders]
        self.alive = set(range(1, n))
        self.merges: list[tuple[int, int, float]] = []
        self.heap: list[tuple[float, int, int]] = []
        for i in range(1, n):
            self._push(i, [j for j in self.borders[i] if j > i])

    def _push(self, i: int, others: list[int]) -> None:
        if not others:
            return
        borders = np.array([self.borders[i][j] for j in others])
        table = np.array([self.table[j] for j in others])
        mine = np.broadcast_to(self.sums[i], (len(others), self.sums.shape[1]))
        odds = self.judge(mine, self.sums[others], borders, np.broadcast_to(self.table[i], table.shape), table)
        for j, value in zip(others, odds.tolist(), strict=True):
            heapq.heappush(self.heap, (value, min(i, j), max(i, j)))

    def pop(self) -> tuple[float, int, int] | None:
        """The pair that is most likely one object; None when none is left."""
        while self.heap:
            odds, i, j = heapq.heappop(self.heap)
            if i in self.alive and j in self.alive and j in self.borders[i]:
                return odds, i, j
        return None

    def forget(self, i: int, j: int) -> None:
        """Take a border away: the pair is never offered again, nor counts it for what they merge into."""
        del self.borders[i][j], self.borders[j][i]

    def merge(self, i: int, j: int, odds: float) -> int:
        """Merge two regions; the number of the new one."""
        new = self.n_regions + len(self.merges)
        self.merges.append((i, j, odds))
        self.sums[new] = self.sums[i] + self.sums[j]
        common = self.borders[i].pop(j, _NONE)
        self.borders[j].pop(i, None)
        self.sums[new, REGION["perimeter"].start] -= 2 * common[0]
        near = {k: row for k, row in self.borders[i].items() if k in self.alive}
        for k, row in self.borders[j].items():
            if k in self.alive:
                near[k] = near[k] + row if k in near else row
        self.borders.append(near)
        self.table.append(self.table[i] + self.table[j])
        self.alive -= {i, j}
        self.alive.add(new)
        for k in near:
            back = self.borders[k].pop(i, _NONE) + self.borders[k].pop(j, _NONE)
            self.borders[k][new] = back
        self._push(new, list(near))
        return new
