"""The common refinement of several partitions of a depth image, and draws of partitions by its pairs of cells.

>>> cells = Cells.of(pixels, shape, samples, predictions)
>>> log_odds = PairEvidence().log_odds(cells, weights, clip)      # (e,) of "one object"
>>> labels = cells.draw(rng, log_odds, 20)                  # (20, K) object of each cell in each draw

A cell is a set of readings that all partitions treat alike. Cells that some partition joins form a component. For two
cells of a component, the samples of the image and the predictions say in how many of them both belong to one object.
If the past is right, the log odds of "same object" are

    l = constant + image logit(f_image) + past logit(f_past) + past_constant,

with shares f softened by 2 %; the last two terms count by the weight of the predictions that explain both cells. If
it is wrong, l = alone_constant + alone_image logit(f_image). The sum of the weights of the predictions, which is the
probability that the past is right, mixes both. `experiments/partition_fit` fits the coefficients.

The alternatives of a component are the partitions that the samples and the predictions give it. A cell that a
prediction does not explain joins a predicted object as each sample has it. The probabilities of the alternatives are
those whose probabilities of pairs are nearest to the fitted ones (least cross entropy over the pairs of readings).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import connected_components
from scipy.special import expit

from mstfilter.results import Checked, check_array, returns
from mstfilter.scene import Clip, canonical, common_refinement
from mstfilter.smc import Systematic

_SOFT = 0.02
_LEAST_SHARE, _TOLERANCE, _STEPS = 1e-9, 1e-3, 200
LEAST = 60  # readings of a cell, as `ObjectRule.min_points`; in an image of 640 x 480 pixels


class PairOdds(Checked, ABC):
    """How likely two cells of an image belong to one object."""

    @returns(lambda self, found, cells, weights, clip: check_array(found, (len(cells.pairs),), finite=False))
    @abstractmethod
    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        """Log odds (e,) of "one object" for ``cells.pairs`` (e, 2), all pairs of cells of one component.

        Parameters
        ----------
        cells : Cells
            The common refinement of the samples and the predictions, with the label of every cell in each of them.
        weights : (n,) ndarray
            Weights of the predictions. What their sum lacks of 1 is the probability that all of them are wrong.
        clip : Clip
            Its last frame is the image.
        """


@dataclass(frozen=True)
class PairEvidence(PairOdds):
    """Log odds by the shares of the samples and of the predictions in which two cells belong to one object."""

    alone_constant: float = -0.78
    alone_image: float = 0.64
    constant: float = -0.87
    image: float = 0.51
    past: float = 0.62
    past_constant: float = 0.96

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        return self.terms(cells, weights) @ np.array(astuple(self))

    def terms(self, cells: Cells, weights: np.ndarray) -> np.ndarray:
        """What each field is multiplied by, (e, 6) in the order of the fields."""
        a, b = cells.pairs.T
        image = softened_logit(
            np.mean((cells.samples[:, a] == cells.samples[:, b]) & (cells.samples[:, a] > 0), axis=0)
        )
        both = (cells.predictions[:, a] > 0) & (cells.predictions[:, b] > 0)
        explained = weights @ both
        same = weights @ (both & (cells.predictions[:, a] == cells.predictions[:, b]))
        share = np.divide(same, explained, out=np.full(len(a), 0.5), where=explained > 0)
        alone, known = np.full(len(a), 1 - weights.sum()), np.full(len(a), weights.sum())
        past = explained * softened_logit(share)
        return np.column_stack([alone, alone * image, known, known * image, past, explained])


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
    component: np.ndarray  #: (K,) component of each cell
    pairs: np.ndarray  #: (e, 2) cells of one component

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
        code = common_refinement([*rows[: len(samples)]]).cells
        for row in rows[len(samples) :]:
            row[:] = _explained(code, row)
        exact = common_refinement([code, *rows[len(samples) :]]).cells
        code = _without_slivers(exact, pixels[kept], shape)
        own = np.flatnonzero(code == exact)  # the other readings are of slivers
        labels = rows[:, own[np.unique(code[own], return_index=True)[1]]]
        of_reading = np.full(len(kept), -1)
        of_reading[kept] = np.unique(code, return_inverse=True)[1]
        same = (labels[:, :, None] == labels[:, None]) & (labels[:, :, None] > 0)
        _, component = connected_components(same.any(axis=0), directed=False)
        pairs = np.argwhere(np.triu(component[:, None] == component, 1))
        return cls(pixels, of_reading, labels[: len(samples)], labels[len(samples) :], component, pairs)

    @cached_property
    def sizes(self) -> np.ndarray:
        """Readings (K,) of each cell."""
        return np.bincount(self.of_reading[self.of_reading >= 0], minlength=self.samples.shape[1])

    def counts(self, image: np.ndarray) -> np.ndarray:
        """Readings (K, m) of each cell with each label of an image (H, W) int."""
        inside = self.of_reading >= 0
        found = np.zeros((len(self.sizes), int(image.max()) + 1), np.int64)
        np.add.at(found, (self.of_reading[inside], image.ravel()[self.pixels[inside]]), 1)
        return found

    def alternatives(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each component its cells (k,) and its distinct partitions (p, k)."""
        found = []
        for c in range(int(self.component.max(initial=-1)) + 1):
            cells = np.flatnonzero(self.component == c)
            own = self.samples[:, cells]
            samples = np.unique(np.where(own > 0, own, -1 - np.arange(len(cells))), axis=0)
            rows = [*samples]
            for past in np.unique(self.predictions[:, cells], axis=0):
                rows += [past] if past.all() else [_filled(past, sample, self.sizes[cells]) for sample in samples]
            named = np.array([canonical(np.unique(row, return_inverse=True)[1] + 1) for row in rows])
            found.append((cells, np.unique(named, axis=0).astype(np.int64)))
        return found

    def probabilities(self, log_odds: np.ndarray, cells: np.ndarray, partitions: np.ndarray) -> np.ndarray:
        """Probabilities (p,) of the partitions (p, k) of a component."""
        if len(partitions) == 1:
            return np.ones(1)
        inside = self.component[self.pairs[:, 0]] == self.component[cells[0]]
        place = np.searchsorted(cells, self.pairs[inside])
        joined = (partitions[:, place[:, 0]] == partitions[:, place[:, 1]]).astype(float)
        weights = self.sizes[self.pairs[inside]].prod(axis=1).astype(float)
        return _matched(joined, expit(log_odds[inside]), weights / weights.sum())

    def draw(self, rng: np.random.Generator, log_odds: np.ndarray, n: int) -> np.ndarray:
        """n partitions (n, K). Components are independent.

        In each, the alternatives are drawn by systematic selection: as often as their probabilities say, up to
        rounding.
        """
        drawn = np.zeros((n, self.samples.shape[1]), np.int64)
        used = 0
        for cells, partitions in self.alternatives():
            log_weights = np.log(np.maximum(self.probabilities(log_odds, cells, partitions), 1e-300))
            chosen = rng.permutation(Systematic().select(rng, log_weights, n)[0])
            drawn[:, cells] = partitions[chosen] + used
            used += int(partitions.max())
        return drawn


def _filled(past: np.ndarray, sample: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """A prediction (k,) of cells of these sizes (k,), with objects for the cells that it does not explain.

    Such a cell joins the predicted object with most readings in its segment of the sample (k,). Without one, the
    segment is an object.
    """
    filled = past.copy()
    for segment in np.unique(sample[past == 0]):
        inside = sample == segment
        readings = np.bincount(past[inside], sizes[inside])
        readings[0] = 0
        filled[inside & (past == 0)] = readings.argmax() or past.max() + 1 + np.flatnonzero(inside)[0]
    return filled


def _matched(joined: np.ndarray, same: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The mixture (p,) of partitions that forecasts pairs best.

    It has the least cross entropy between the probabilities `same` (e,) that the objects of a pair are one and the
    total probability of the partitions that join the pair, `joined` (p, e); pairs count by `weights` (e,). The
    problem is convex; this is expectation maximisation for the proportions of a mixture.
    """
    q = np.full(len(joined), 1 / len(joined))
    for _ in range(_STEPS):
        together = np.clip(q @ joined, _LEAST_SHARE, 1 - _LEAST_SHARE)
        factor = joined @ (weights * same / together) + (1 - joined) @ (weights * (1 - same) / (1 - together))
        q = q * factor
        q /= q.sum()
        if np.abs(factor - 1)[q > _LEAST_SHARE].max() < _TOLERANCE:
            break
    return q


def _explained(cells: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels (m,) of a prediction, with the most frequent label of the cell (m,) where there is none.

    This holds for cells of which the prediction explains at least half.
    """
    table = np.zeros((int(cells.max(initial=-1)) + 1, int(labels.max(initial=0)) + 1), np.int64)
    np.add.at(table, (cells, labels), 1)
    unexplained, table[:, 0] = table[:, 0].copy(), 0
    usual = np.where(table.sum(axis=1) >= unexplained, table.argmax(axis=1), 0)
    return np.where(labels > 0, labels, usual[cells])


def _without_slivers(code: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cells (m,) after the readings of small ones have joined the nearest large cell, if one is near."""
    least = LEAST * shape[0] * shape[1] / 307200
    large = np.bincount(code, minlength=1)[code] >= least
    if not large.any():
        return code
    image = np.full(shape, -1)
    image.ravel()[pixels[large]] = code[large]
    distance, nearest = distance_transform_edt(image < 0, return_indices=True)
    return np.where(distance.ravel()[pixels] <= np.sqrt(least), image[tuple(nearest)].ravel()[pixels], code)
