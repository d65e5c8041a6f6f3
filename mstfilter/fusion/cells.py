"""The common refinement of several partitions of a depth image, and draws of partitions by its pairs of cells.

>>> cells = Cells.of(pixels, shape, samples, predictions)
>>> log_odds = PairEvidence().log_odds(cells, weights, clip)      # (e,) of "one object" for neighbouring cells
>>> labels = cells.draw(rng, log_odds, 20)                  # (20, K) object of each cell in each draw

A cell is a set of readings that all partitions treat alike. The borders of a prediction are inexact, so it splits a
cell of the samples only into parts of at least a quarter. For two neighbouring cells, the samples of the image and
the predictions say in how many of them both belong to one object. If the past is right, the log odds of "same object"
are

    l = constant + image logit(f_image) + past logit(f_past) + past_constant,

with shares f softened by 2 %; the last two terms count by the weight of the predictions that explain both cells. If
it is wrong, l = alone_constant + alone_image logit(f_image). The sum of the weights of the predictions, which is the
probability that the past is right, mixes both. `experiments/partition_fit` fits the coefficients.

Cells that some partition joins form a component. The alternatives of a component are the partitions that the samples
and predictions give it. The weight of an alternative is the product over its pairs of neighbouring cells of the
probability of "same" or "different", as the alternative has it. This is a heuristic: pairs on a cycle are not
independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mstfilter.fusion.interfaces import PairOdds
from mstfilter.fusion.similarity import canonical
from mstfilter.scene import Clip
from mstfilter.smc import Systematic

_SOFT = 0.02
_REACH = 2  # pixels between two readings of neighbouring cells, at most
_PART = 0.25  # share of a cell of the image that a prediction may split off
LEAST = 20  # readings of a cell in an image of 640 x 480 pixels; smaller ones join a neighbour


@dataclass(frozen=True)
class PairEvidence(PairOdds):
    """Log odds by the shares of the samples and of the predictions in which two cells belong to one object."""

    alone_constant: float = 0.47
    alone_image: float = 0.74
    constant: float = -0.34
    image: float = 0.51
    past: float = 0.52
    past_constant: float = 0.62

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        a, b = cells.pairs.T
        image = np.mean((cells.samples[:, a] == cells.samples[:, b]) & (cells.samples[:, a] > 0), axis=0)
        right, logit = weights.sum(), softened_logit(image)
        found = (1 - right) * (self.alone_constant + self.alone_image * logit)
        found = found + right * (self.constant + self.image * logit)
        if len(cells.predictions):
            both = (cells.predictions[:, a] > 0) & (cells.predictions[:, b] > 0)
            explained = weights @ both
            same = weights @ (both & (cells.predictions[:, a] == cells.predictions[:, b]))
            share = np.divide(same, explained, out=np.full(len(same), 0.5), where=explained > 0)
            found = found + explained * (self.past * softened_logit(share) + self.past_constant)
        return found


def softened_logit(p: np.ndarray) -> np.ndarray:
    """Log odds of shares, which are softened by 2 %."""
    return np.log((p + _SOFT) / (1 - p + _SOFT))


@dataclass(frozen=True, eq=False)
class Cells:
    """The common refinement of samples and predictions."""

    pixels: np.ndarray  #: (m,) flat pixels of the readings
    of_reading: np.ndarray  #: (m,) cell of each reading, -1 for readings of no object
    samples: np.ndarray  #: (s, K) label of each cell in each sample
    predictions: np.ndarray  #: (n, K) label of each cell in each prediction, 0 is none
    pairs: np.ndarray  #: (e, 2) neighbouring cells

    @classmethod
    def of(
        cls,
        pixels: np.ndarray,
        shape: tuple[int, int],
        samples: Sequence[np.ndarray],
        predictions: Sequence[np.ndarray],
    ) -> Cells:
        """From labels (m,) of the readings at flat `pixels` (m,) of an image; 0 is no object.

        Readings that most samples give to no object belong to no cell.
        """
        kept = np.mean([labels > 0 for labels in samples], axis=0) >= 0.5
        rows = np.stack([labels[kept] for labels in (*samples, *predictions)])
        code = _refinement(rows[: len(samples)])
        for row in rows[len(samples) :]:
            row[:] = _snapped(code, row)
        code = _refinement(np.concatenate([code[None], rows[len(samples) :]]))
        code = _without_slivers(code, pixels[kept], shape)
        # Every cell has one label in each partition, but for the readings of slivers.
        example = [_usual_reading(rows, code, c) for c in range(int(code.max(initial=-1)) + 1)]
        labels = rows[:, np.array(example, np.int64)]
        of_reading = np.full(len(kept), -1)
        of_reading[kept] = code
        pairs = _borders(code, pixels[kept], shape)[0]
        return cls(pixels, of_reading, labels[: len(samples)], labels[len(samples) :], pairs)

    def alternatives(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each component its cells (k,) and its distinct partitions (p, k)."""
        k = self.samples.shape[1]
        every = np.concatenate([self.samples, self.predictions])
        a, b = self.pairs.T
        joined = ((every[:, a] == every[:, b]) & (every[:, a] > 0)).any(axis=0)
        links = coo_array((np.ones(int(joined.sum())), (a[joined], b[joined])), shape=(k, k))
        n, component = connected_components(links, directed=False)
        found = []
        for c in range(n):
            cells = np.flatnonzero(component == c)
            rows = every[:, cells]  # a cell that a prediction does not explain is an object of its own
            rows = np.where(rows > 0, rows, -1 - np.arange(len(cells)))
            named = np.array([canonical(np.unique(row, return_inverse=True)[1] + 1) for row in rows])
            found.append((cells, np.unique(named, axis=0).astype(np.int64)))
        return found

    def scores(self, log_odds: np.ndarray, cells: np.ndarray, partitions: np.ndarray) -> np.ndarray:
        """Log weights (p,) of the partitions (p, k) of a component."""
        place = np.full(self.samples.shape[1], -1)
        place[cells] = np.arange(len(cells))
        a, b = place[self.pairs].T
        inside = (a >= 0) & (b >= 0)
        same = partitions[:, a[inside]] == partitions[:, b[inside]]
        sign = np.where(same, 1.0, -1.0)
        return -np.logaddexp(0, -sign * log_odds[inside]).sum(axis=1)

    def draw(self, rng: np.random.Generator, log_odds: np.ndarray, n: int) -> np.ndarray:
        """n partitions (n, K). Components are independent.

        In each, the alternatives are drawn by systematic selection: as often as their weights say, up to rounding.
        """
        drawn = np.zeros((n, self.samples.shape[1]), np.int64)
        used = 0
        for cells, partitions in self.alternatives():
            score = self.scores(log_odds, cells, partitions)
            chosen = rng.permutation(Systematic().select(rng, score, n)[0])
            drawn[:, cells] = partitions[chosen] + used
            used += int(partitions.max())
        return drawn


def _refinement(rows: np.ndarray) -> np.ndarray:
    """The common refinement (m,) of partitions (p, m) of non-negative labels, numbered 0, 1, ..."""
    code = np.zeros(rows.shape[1], np.int64)
    for row in rows:
        _, code = np.unique(code * (int(row.max(initial=0)) + 1) + row, return_inverse=True)
    return code


def _snapped(cells: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels (m,) without those that fill only a small part of a cell (m,), which get the most frequent label there.

    The borders of a prediction are inexact, those of the image are not.
    """
    shape = int(cells.max(initial=-1)) + 1, int(labels.max(initial=0)) + 1
    table = np.bincount(cells * shape[1] + labels, minlength=shape[0] * shape[1]).reshape(shape)
    large = table >= _PART * table.sum(axis=1, keepdims=True)
    return np.where(large[cells, labels], labels, table.argmax(axis=1)[cells]) if len(cells) else labels


def _usual_reading(rows: np.ndarray, code: np.ndarray, cell: int) -> int:
    """A reading with the most frequent labels of a cell."""
    inside = np.flatnonzero(code == cell)
    _, first, counts = np.unique(rows[:, inside], axis=1, return_index=True, return_counts=True)
    return int(inside[first[counts.argmax()]])


def _borders(code: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (e, 2) of neighbouring cells and the lengths (e,) of their borders."""
    image = np.full(shape, -1)
    image.ravel()[pixels] = code
    found = []
    for step in range(1, _REACH + 1):
        for a, b in ((image[:, step:], image[:, :-step]), (image[step:], image[:-step])):
            different = (a != b) & (a >= 0) & (b >= 0)
            found.append(np.sort(np.stack([a[different], b[different]], axis=1), axis=1))
    pairs, lengths = np.unique(np.concatenate(found), axis=0, return_counts=True)
    return pairs, lengths


def _without_slivers(code: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cells renumbered 0, 1, ..., after small ones have joined the neighbour with the longest border."""
    least = LEAST * shape[0] * shape[1] / 307200
    for _ in range(20):
        sizes = np.bincount(code) if len(code) else np.zeros(0, int)
        small = np.flatnonzero((sizes > 0) & (sizes < least))
        if not len(small):
            break
        pairs, lengths = _borders(code, pixels, shape)
        target = np.arange(len(sizes))
        for c in small:
            touching = (pairs == c).any(axis=1)
            if touching.any():
                k = np.flatnonzero(touching)[lengths[touching].argmax()]
                target[c] = int(pairs[k].sum() - c)
        # Only small cells move, and never in a cycle: a cell joins one that is larger or has a smaller number.
        moved = [c for c in small if (sizes[target[c]], -target[c]) > (sizes[c], -c)]
        if not moved:
            break
        code = np.where(np.isin(code, moved), target[code], code)
    return np.unique(code, return_inverse=True)[1]
