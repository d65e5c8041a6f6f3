"""How likely two cells of an image belong to one object.

>>> log_odds = PairEvidence().log_odds(cells, weights, clip)      # (e,) of "one object", for cells.pairs (e, 2)

For two cells, the samples of the image and the predictions say in how many of them both belong to one object. If the
predictions hold, the log odds of "one object" are

    l = constant + image logit(f_image) + prediction logit(f_prediction) + prediction_constant,

with shares f softened by 2 %; the last two terms count by the weight of the predictions that explain both cells. If
no prediction holds, l = image_only_constant + image_only logit(f_image). The two are mixed by the probability that a
prediction holds, which is the sum of the weights. `experiments/partition_fit` fits the coefficients.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np

from mstfilter.partition.cells import Cells
from mstfilter.results import Checked, check_array, returns
from mstfilter.scene import Clip

_SOFT = 0.02


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
            Weight of each prediction times the probability that it holds. What their sum lacks of 1 is the
            probability that no prediction holds.
        clip : Clip
            Its last frame is the image.
        """


class PairTerms(NamedTuple):
    """What each field of `PairEvidence` is multiplied by: arrays (e,), one number for each pair of cells."""

    image_only_constant: np.ndarray  #: probability that no prediction holds
    image_only: np.ndarray  #: the same, times the logit of the share of samples
    constant: np.ndarray  #: probability that a prediction holds
    image: np.ndarray  #: the same, times the logit of the share of samples
    prediction: np.ndarray  #: weight of the predictions that explain both cells, times the logit of their share
    prediction_constant: np.ndarray  #: weight of the predictions that explain both cells


@dataclass(frozen=True)
class PairEvidence(PairOdds):
    """Log odds by the shares of the samples and of the predictions in which two cells belong to one object."""

    image_only_constant: float = -0.78
    image_only: float = 0.64
    constant: float = -0.87
    image: float = 0.51
    prediction: float = 0.62
    prediction_constant: float = 0.96

    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        return np.column_stack(self.terms(cells, weights)) @ np.array(astuple(self))

    def terms(self, cells: Cells, weights: np.ndarray) -> PairTerms:
        """The terms of the sum, without the coefficients."""
        in_samples = _labels_of_pairs(cells.samples, cells.pairs)
        image = softened_logit(np.mean(in_samples.same, axis=0))
        in_predictions = _labels_of_pairs(cells.predictions, cells.pairs)
        explained, same = weights @ in_predictions.both, weights @ in_predictions.same
        share = np.divide(same, explained, out=np.full(len(image), 0.5), where=explained > 0)
        fails, holds = (np.full(len(image), p) for p in (1 - weights.sum(), weights.sum()))
        prediction = explained * softened_logit(share)
        return PairTerms(fails, fails * image, holds, holds * image, prediction, explained)


class _PairLabels(NamedTuple):
    """Labels of pairs of cells in n partitions."""

    both: np.ndarray  #: (n, e) bool, both cells belong to an object
    same: np.ndarray  #: (n, e) bool, both cells belong to one object


def _labels_of_pairs(labels: np.ndarray, pairs: np.ndarray) -> _PairLabels:
    """Of labels (n, K) of the cells, 0 is no object."""
    a, b = (labels[:, cell] for cell in pairs.T)
    both = (a > 0) & (b > 0)
    return _PairLabels(both, both & (a == b))


def softened_logit(p: np.ndarray) -> np.ndarray:
    """Log odds of shares, which are softened by 2 %."""
    return np.log((p + _SOFT) / (1 - p + _SOFT))
