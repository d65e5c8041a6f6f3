"""Do the borders of a hypothesis lie where the image has boundaries?

>>> BoundaryAgreement().log_score(hypotheses, clip)

Data used: the colour and depth of the clip's last frame, through the boundary map and the leaves of its
segmentation tree. A proposal whose samples are drawn from the same tree has used the same data; this term also
judges what the prediction brings into the mixture.

The hypothesis is projected, each leaf region takes the label most of it has, and every border between two
leaves is a piece of evidence: with mean strength m and probability P(m) of separating two objects it is worth
log P where the labels differ and log (1 - P) where they agree, per pixel of its length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mstfilter.scene import Clip, Evidence, Frame, Hypothesis, component_key, memo, project
from mstfilter.segmentation.boundary import ColourDepthBoundary
from mstfilter.segmentation.interfaces import BoundaryModel, TreeBuilder
from mstfilter.segmentation.ucm import UcmTree

__all__ = ["BoundaryAgreement"]


class _Borders(NamedTuple):
    """Leaf image (H, W), and for each border its two leaves, length in pixels and log odds of P."""

    leaves: np.ndarray
    first: np.ndarray
    second: np.ndarray
    length: np.ndarray
    log_p: np.ndarray
    log_not_p: np.ndarray


@dataclass(frozen=True)
class BoundaryAgreement(Evidence):
    """Log likelihood of the borders of the projected objects.

    Parameters
    ----------
    strength : float
        Nats for the mean log probability of a pixel of border, over all borders that belong to an object of any of
        the hypotheses. Pixels of one border are not independent, so this is far less than their number.
    centre, slope : float
        P(m) is a logistic function of the border's mean strength.
    boundary : BoundaryModel
        The boundary map; the same as the proposal's is computed once.
    tree : TreeBuilder
        Its leaves are the regions.
    """

    strength: float = 30.0
    centre: float = 0.35
    slope: float = 12.0
    boundary: BoundaryModel = field(default_factory=ColourDepthBoundary)
    tree: TreeBuilder = field(default_factory=UcmTree)

    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """`strength` times the mean log probability a pixel of border."""
        frame = clip.after
        key = (frame.key, component_key(self))
        borders = memo("borders", key, lambda: self._borders(frame))
        valid = frame.valid.ravel()
        n = int(borders.leaves.max()) + 1
        values, touched = [], np.zeros(len(borders.length), bool)
        for hypothesis in hypotheses:
            image = project(hypothesis, frame.camera).astype(np.int64).ravel()
            k = int(image.max(initial=0)) + 1
            votes = np.bincount((borders.leaves.ravel() * k + image)[valid], minlength=n * k).reshape(n, k)
            label = votes.argmax(axis=1)
            a, b = label[borders.first], label[borders.second]
            touched |= (a > 0) | (b > 0)
            values.append(np.where(a != b, borders.log_p, borders.log_not_p))
        # The same borders for all: a hypothesis does not gain by leaving objects out.
        weight = borders.length * touched
        return self.strength * (np.array(values) @ weight) / max(float(weight.sum()), 1.0)

    def _borders(self, frame: Frame) -> _Borders:
        strength = self.boundary.boundary(frame)
        leaves = np.asarray(self.tree.build(strength).leaves, dtype=np.int64)
        n, keys, values = int(leaves.max()) + 1, [], []
        for axis in (0, 1):
            low, high = (np.take(leaves, range(s, leaves.shape[axis] - 1 + s), axis) for s in (0, 1))
            edge = np.maximum(*(np.take(strength, range(s, leaves.shape[axis] - 1 + s), axis) for s in (0, 1)))
            differ = low != high
            keys.append(np.minimum(low, high)[differ] * n + np.maximum(low, high)[differ])
            values.append(edge[differ])
        found, inverse, length = np.unique(np.concatenate(keys), return_inverse=True, return_counts=True)
        mean = np.bincount(inverse, np.concatenate(values)) / length
        odds = self.slope * (mean - self.centre)
        bound = 4.0  # P between 0.02 and 0.98: no single border decides
        log_p = -np.log1p(np.exp(-np.clip(odds, -bound, bound)))
        log_not_p = -np.log1p(np.exp(np.clip(odds, -bound, bound)))
        return _Borders(leaves, found // n, found % n, length, log_p, log_not_p)
