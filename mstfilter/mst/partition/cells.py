"""Readings and cells of a depth image, and how image and past are weighed: probabilities of partitions of the cells.

To change how much the past counts against the image, change `PairEvidence`, or write another `PairOdds`.

>>> readings = Readings.of(frame, grid)
>>> cells = Cells.of(readings, samples, predictions)
>>> log_odds = PairEvidence().log_odds(cells, weights, clip)      # (e,) of "one object", for cells.pairs (e, 2)
>>> component = cells.alternatives()[0]                           # the partitions of the cells of one component
>>> cells.probabilities(log_odds, component)                      # (p,) probability of each of these partitions

A sample groups the depth readings by segment, a prediction by the predicted object at each reading. Readings that no
sample and no prediction separates form a cell, so the cells are the common refinement of all these partitions, and a
partition need only be decided between cells. Cells that belong to one object in some sample or prediction are
connected; a component is a connected set of them, and is decided on its own.

Are two cells one object? Image and past both answer by a share. The image says f_image, the share of the samples in
which the two are one object. The past says f_prediction, the share by weight of those predictions that have an object
at both cells. A share becomes log odds by its logit, for which 0.02 is added to f and to 1 - f, so that no answer is
certain.

How much the past counts depends on how far it can be trusted. A prediction is *valid* if it shows the present scene,
and it counts with its weight times the probability that it is. Three sums of these products matter:

- R, of all predictions: the probability that any of them is valid;
- W <= R, of those with an object at both cells, which alone have an answer;
- M <= W, of those in which both cells have moved as one body.

If no prediction is valid, the image decides alone; else image and past add up. So the log odds of "one object" are

    ``l = (1 - R) (image_only_constant + image_only logit(f_image))
    + R (constant + image logit(f_image)) + W (prediction logit(f_prediction) + prediction_constant) + M together``

The update gives one prediction at a time a weight above 0, so there f_prediction is 0 or 1. The coefficients are the
fields of `PairEvidence`; by default, logit(f_image) is not scaled. That of the predictions was fitted to pairs of
cells, and the constants were chosen by a study (`experiments/weights` and the page of settled studies in the docs).

The alternatives of a component are its partitions in the samples and in the predictions. Where a prediction has no
object at a cell, each sample in turn says which predicted object the cell joins. The alternatives then get
probabilities such that their mixture agrees as well as possible with the log odds of all pairs: by least cross
entropy over the pairs of readings.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import expit

from mstfilter.base.results import Checked, check_array, returns
from mstfilter.scene import Clip, Frame, VoxelGrid, canonical, common_refinement, frame_points, scaled_area

_LEAST_READINGS = 60  # of a region in an image of 640 x 480 pixels, as `ObjectRule.min_points`
_SOFT = 0.02  # shares of samples and predictions are softened by as much
_LEAST_SHARE, _TOLERANCE, _STEPS = 1e-9, 1e-3, 200


@dataclass(frozen=True)
class Readings:
    """The depth readings of a frame inside the grid."""

    pixels: np.ndarray  #: (m,) flat pixels
    voxels: np.ndarray  #: (m, 3) voxels
    shape: tuple[int, int]  #: of the image

    @classmethod
    def of(cls, frame: Frame, grid: VoxelGrid) -> Readings:
        """The depth readings of a frame."""
        return cls(*frame_points(frame, grid), frame.depth.shape)

    @property
    def smallest_region(self) -> float:
        """Smallest number of readings of a separate region, for the size of this image."""
        return scaled_area(_LEAST_READINGS, self.shape[0] * self.shape[1])

    def mask(self, chosen: np.ndarray) -> np.ndarray:
        """Image (H, W) bool, True at the pixels of the chosen readings (m,) bool."""
        mask = np.zeros(self.shape, bool)
        mask.ravel()[self.pixels[chosen]] = True
        return mask

    def image(self, values: np.ndarray) -> np.ndarray:
        """Image (H, W) with a value (m,) int at the pixel of each reading, and 0 elsewhere."""
        found = np.zeros(self.shape, np.int64)
        found.ravel()[self.pixels] = values
        return found

    def of_image(self, image: np.ndarray) -> np.ndarray:
        """Value (m,) of an image (H, W) at each reading."""
        return np.asarray(image.ravel()[self.pixels])

    def labels(self, labels: np.ndarray, reach: float) -> np.ndarray:
        """Label (m,) of the nearest occupied voxel within `reach` voxels of each reading; 0 if there is none."""
        occupied = np.stack(np.unravel_index(np.flatnonzero(labels), labels.shape), axis=1)  # faster than argwhere
        voxels, of_reading = self._distinct
        found = labels[tuple(voxels.T)].astype(np.int64)
        beside = found == 0
        _, nearest = cKDTree(occupied).query(voxels[beside], distance_upper_bound=reach + 1e-6)
        found[beside] = np.append(labels[tuple(occupied.T)], 0)[nearest]  # the last one is that of no neighbour
        return found[of_reading]

    def share_voxel(self, chosen: np.ndarray) -> np.ndarray:
        """Whether the voxel of each reading (m,) contains a chosen reading (m,) bool."""
        of_reading = self._distinct[1]
        return (np.bincount(of_reading, chosen) > 0)[of_reading]

    @cached_property
    def _distinct(self) -> tuple[np.ndarray, np.ndarray]:
        """The distinct voxels (k, 3) with readings, and the voxel of each reading (m,)."""
        if not len(self.voxels):
            return self.voxels, np.zeros(0, np.int64)
        shape = tuple(self.voxels.max(axis=0) + 1)
        flat, of_reading = np.unique(np.ravel_multi_index(tuple(self.voxels.T), shape), return_inverse=True)
        return np.stack(np.unravel_index(flat, shape), axis=1), of_reading


class Alternatives(NamedTuple):
    """The partitions of a component."""

    cells: np.ndarray  #: (k,) cells of the component
    partitions: np.ndarray  #: (p, k) object of each cell in each partition, 1, 2, ...


def _share(marks: Sequence[np.ndarray] | np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Share (m,) of the samples that have a mark, from the marks (s, m) bool and the weights (s,), None if equal."""
    return np.mean(marks, axis=0) if weights is None else weights @ np.asarray(marks, dtype=float)


@dataclass(frozen=True, eq=False)
class Cells:
    """The common refinement of samples and predictions."""

    readings: Readings
    of_reading: np.ndarray  #: (m,) cell of each reading, -1 for readings of no object
    samples: np.ndarray  #: (s, K) label of each cell in each sample
    predictions: np.ndarray  #: (n, K) label of each cell in each prediction, 0 is none
    weights: np.ndarray | None = None  #: (s,) weights of the samples; None if they are equal
    #: For each prediction, the body of each of its labels (`common_motions`); empty if that is not known.
    bodies: tuple[np.ndarray, ...] = ()

    @classmethod
    def of(
        cls,
        readings: Readings,
        samples: Sequence[np.ndarray],
        predictions: Sequence[np.ndarray],
        weights: np.ndarray | None = None,
        bodies: Sequence[np.ndarray] = (),
    ) -> Cells:
        """Cells from the labels (m,) of the readings in each sample and each prediction; 0 means no object.

        Readings that most samples, by weight, assign to no object belong to no cell.
        """
        kept = _share([labels > 0 for labels in samples], weights) >= 0.5
        segments = [labels[kept] for labels in samples]
        in_segments = common_refinement(segments).cells
        objects = [_extended(in_segments, labels[kept]) for labels in predictions]
        exact = common_refinement([in_segments, *objects]).cells
        cell = _without_slivers(exact, readings, kept)
        of_reading = np.full(len(kept), -1)
        of_reading[kept] = np.unique(cell, return_inverse=True)[1]
        example = _examples(cell, exact)
        labels = np.stack([*segments, *objects])[:, example]
        samples_of, predictions_of = labels[: len(segments)], labels[len(segments) :]
        return cls(readings, of_reading, samples_of, predictions_of, weights, tuple(bodies))

    @cached_property
    def sizes(self) -> np.ndarray:
        """Number (K,) of depth readings of each cell."""
        return np.bincount(self.of_reading[self.of_reading >= 0], minlength=self.samples.shape[1])

    @cached_property
    def component(self) -> np.ndarray:
        """Component (K,) of each cell. Cells of one object in a sample or a prediction are in one component."""
        labels = np.concatenate([self.samples, self.predictions])
        same = (labels[:, :, None] == labels[:, None]) & (labels[:, :, None] > 0)
        return np.asarray(connected_components(same.any(axis=0), directed=False)[1])

    @cached_property
    def pairs(self) -> np.ndarray:
        """All pairs (e, 2) of cells in the same component."""
        return np.argwhere(np.triu(self.component[:, None] == self.component, 1))

    def alternatives(self) -> list[Alternatives]:
        """The distinct partitions of each component."""
        found = []
        for c in range(int(self.component.max(initial=-1)) + 1):
            cells = np.flatnonzero(self.component == c)
            rows = self._partitions_of(cells)
            named = np.array([canonical(np.unique(row, return_inverse=True)[1] + 1) for row in rows])
            found.append(Alternatives(cells, np.unique(named, axis=0).astype(np.int64)))
        return found

    def _partitions_of(self, cells: np.ndarray) -> list[np.ndarray]:
        """Partitions (k,) of cells (k,) by each sample, and by each prediction with its gaps filled by a sample."""
        labels = self.samples[:, cells]
        # A cell without a segment is a part by itself.
        samples = np.unique(np.where(labels > 0, labels, -1 - np.arange(len(cells))), axis=0)
        rows = [*samples]
        for prediction in np.unique(self.predictions[:, cells], axis=0):
            if prediction.all():
                rows.append(prediction)
            else:
                rows += [_filled(prediction, sample, self.sizes[cells]) for sample in samples]
        return rows

    def probabilities(self, log_odds: np.ndarray, component: Alternatives) -> np.ndarray:
        """Probabilities (p,) of the partitions of a component, from the log odds (e,) of all pairs."""
        cells, partitions = component
        if len(partitions) == 1:
            return np.ones(1)
        inside = self.component[self.pairs[:, 0]] == self.component[cells[0]]
        place = np.searchsorted(cells, self.pairs[inside])
        joined = (partitions[:, place[:, 0]] == partitions[:, place[:, 1]]).astype(float)
        weights = self.sizes[self.pairs[inside]].prod(axis=1).astype(float)
        return _fitted_mixture(joined, expit(log_odds[inside]), weights / weights.sum())

    @staticmethod
    def joined(components: Sequence[Alternatives], chosen: np.ndarray) -> np.ndarray:
        """Segment number (K,) of each cell, from 1, for the chosen alternative (C,) of each component."""
        partition, used = np.zeros(sum(len(one.cells) for one in components), np.int64), 0
        for one, k in zip(components, chosen.tolist(), strict=True):
            partition[one.cells] = one.partitions[k] + used
            used += int(one.partitions.max())
        return partition

    def counts(self, labels: np.ndarray) -> np.ndarray:
        """Number of readings (K, m) of each cell with each label, from the labels (readings,) of all readings."""
        inside = self.of_reading >= 0
        found = np.zeros((self.samples.shape[1], int(labels[inside].max(initial=0)) + 1), np.int64)
        np.add.at(found, (self.of_reading[inside], labels[inside]), 1)
        return found

    def to_readings(self, of_cells: np.ndarray) -> np.ndarray:
        """Labels (..., m) of the readings, from labels (..., K) of the cells; 0 for readings without a cell."""
        padded = np.pad(of_cells, [(0, 0)] * (of_cells.ndim - 1) + [(0, 1)])  # the last column is no cell
        return np.asarray(padded[..., self.of_reading])


def _extended(cells: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels (m,) of a prediction. A reading without an object gets the most frequent label of its cell (m,).

    Only cells with an object at half of their readings or more are filled.
    """
    table = np.zeros((int(cells.max(initial=-1)) + 1, int(labels.max(initial=0)) + 1), np.int64)
    np.add.at(table, (cells, labels), 1)
    unexplained, table[:, 0] = table[:, 0].copy(), 0
    usual = np.where(table.sum(axis=1) >= unexplained, table.argmax(axis=1), 0)
    return np.where(labels > 0, labels, usual[cells])


def _without_slivers(cell: np.ndarray, readings: Readings, kept: np.ndarray) -> np.ndarray:
    """Cells of the kept readings, where readings of a small cell join the nearest large cell, if one is near."""
    pixels, least = readings.pixels[kept], readings.smallest_region
    large = np.bincount(cell, minlength=1)[cell] >= least
    if not large.any():
        return cell
    image = np.full(readings.shape, -1)
    image.ravel()[pixels[large]] = cell[large]
    distance, nearest = distance_transform_edt(image < 0, return_indices=True)
    return np.where(distance.ravel()[pixels] <= np.sqrt(least), image[tuple(nearest)].ravel()[pixels], cell)


def _examples(cell: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Index (K,) of one reading of each cell, outside the small cells that were joined to the cell."""
    own = np.flatnonzero(cell == exact)
    return own[np.unique(cell[own], return_index=True)[1]]


def _filled(prediction: np.ndarray, sample: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """A prediction (k,) with an object for every cell. `sizes` (k,) are the numbers of depth readings of the cells.

    A cell without an object joins the predicted object with most readings in the cell's segment of the sample (k,).
    If no predicted object has readings in the segment, the segment is a new object.
    """
    filled = prediction.copy()
    for segment in np.unique(sample[prediction == 0]):
        inside = sample == segment
        readings = np.bincount(prediction[inside], sizes[inside])
        readings[0] = 0
        new = prediction.max() + 1 + np.flatnonzero(inside)[0]
        filled[inside & (prediction == 0)] = readings.argmax() or new
    return filled


def _fitted_mixture(joined: np.ndarray, same: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The proportions (p,) of the mixture of partitions with the best forecasts for pairs of cells.

    `same` (e,) are the probabilities that the cells of a pair belong to one object. `joined` (p, e) states which
    partitions join each pair. The mixture minimises the cross entropy between `same` and the total probability of the
    partitions that join each pair. `weights` (e,) are the weights of the pairs. At most `_STEPS` steps of expectation
    maximisation start at equal proportions. If most pairs are joined by all partitions, or by none, the steps are
    small, and the result lies between equal proportions and the minimum.
    """
    q = np.full(len(joined), 1 / len(joined))
    divided, one_object, two_objects = 1 - joined, weights * same, weights * (1 - same)
    for _ in range(_STEPS):
        together = np.clip(q @ joined, _LEAST_SHARE, 1 - _LEAST_SHARE)
        factor = joined @ (one_object / together) + divided @ (two_objects / (1 - together))
        q = q * factor
        q /= q.sum()
        if np.abs(factor - 1)[q > _LEAST_SHARE].max() < _TOLERANCE:
            break
    return q


# Odds of pairs ------------------------------------------------------------------------------------------------------


class PairOdds(Checked, ABC):
    """The log odds that two cells of an image belong to one object."""

    @returns(lambda self, found, cells, weights, clip: check_array(found, (len(cells.pairs),), finite=False))
    @abstractmethod
    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        """Log odds (e,) of "one object" for each pair of cells in ``cells.pairs`` (e, 2).

        Parameters
        ----------
        cells : Cells
            The common refinement of the samples and the predictions.
        weights : (n,) ndarray
            Weight of each prediction times the probability that the prediction is valid. One minus the sum of the
            weights is the probability that no prediction is valid.
        clip : Clip
            Clip whose last frame is the image.
        """


class PairTerms(NamedTuple):
    """The terms that the fields of `PairEvidence` multiply: arrays (e,) with one number for each pair of cells."""

    image_only_constant: np.ndarray  #: probability that no prediction is valid
    image_only: np.ndarray  #: probability that no prediction is valid, times the logit of f_image
    constant: np.ndarray  #: probability that a prediction is valid
    image: np.ndarray  #: probability that a prediction is valid, times the logit of f_image
    prediction: np.ndarray  #: weight of the predictions with an object at both cells, times the logit of f_prediction
    prediction_constant: np.ndarray  #: weight of the predictions with an object at both cells
    together: np.ndarray  #: weight of the predictions in which both cells have moved as one body


@dataclass(frozen=True)
class PairEvidence(PairOdds):
    """Log odds from the shares of the samples and of the predictions in which two cells belong to one object.

    It is the default of the field `pairs` of the update. (The field `evidence` holds other things, terms of a score.)
    The fields are the coefficients of the formula above, which `PairTerms` explains.
    """

    image_only_constant: float = 0.0
    image_only: float = 1.0
    constant: float = -0.5
    image: float = 1.0
    prediction: float = 0.62
    prediction_constant: float = 0.0
    together: float = 0.0

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        return np.column_stack(self.terms(cells, weights)) @ np.array(astuple(self))

    def terms(self, cells: Cells, weights: np.ndarray) -> PairTerms:
        """The terms of the log odds, not yet multiplied by the coefficients."""
        in_samples = _labels_of_pairs(cells.samples, cells.pairs)
        image = softened_logit(_share(in_samples.same, cells.weights))
        in_predictions = _labels_of_pairs(cells.predictions, cells.pairs)
        explained, same = weights @ in_predictions.both, weights @ in_predictions.same
        share = np.divide(same, explained, out=np.full(len(image), 0.5), where=explained > 0)
        fails, holds = (np.full(len(image), p) for p in (1 - weights.sum(), weights.sum()))
        prediction = explained * softened_logit(share)
        together = np.zeros(len(image))
        if cells.bodies:
            bodies = np.stack([of[row] for of, row in zip(cells.bodies, cells.predictions, strict=True)])
            a, b = (bodies[:, cell] for cell in cells.pairs.T)
            together = weights @ ((a == b) & (a > 0))
        return PairTerms(fails, fails * image, holds, holds * image, prediction, explained, together)


class _PairLabels(NamedTuple):
    """Labels of the two cells of each pair, in n partitions."""

    both: np.ndarray  #: (n, e) bool, both cells belong to an object
    same: np.ndarray  #: (n, e) bool, both cells belong to one object


def _labels_of_pairs(labels: np.ndarray, pairs: np.ndarray) -> _PairLabels:
    """Compare the labels (n, K) of the cells of each pair; label 0 is no object."""
    a, b = (labels[:, cell] for cell in pairs.T)
    both = (a > 0) & (b > 0)
    return _PairLabels(both, both & (a == b))


def softened_logit(p: np.ndarray) -> np.ndarray:
    """Log odds of shares p, after 0.02 is added to p and to 1 - p."""
    return np.log((p + _SOFT) / (1 - p + _SOFT))
