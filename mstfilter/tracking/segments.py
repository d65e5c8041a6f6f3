"""What is tracked: the visible part of each object, once for all hypotheses that agree on it.

Hypotheses share most of their objects, so distinct segments are far fewer than hypotheses times objects.
A `Segment` is named by the content of its projected mask and of its voxels.

>>> segments = segments_of(hypothesis, clip.before)      # doctest: +SKIP
>>> segments[label].key                                  # doctest: +SKIP
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mstfilter.scene import Frame, Hypothesis, content_key, render_hypothesis

__all__ = ["Segment", "segments_of"]


@dataclass(frozen=True, eq=False)
class Segment:
    """The visible part of one object.

    Attributes
    ----------
    key : content name; equal keys are the same tracking problem.
    pixels : (M,) int64 sorted flat pixels of the projected mask.
    support : (S,) int64 sorted flat pixels among them whose measured depth agrees with the object: the
        mask of a voxel object reaches a little beyond the object itself.
    """

    key: bytes
    pixels: NDArray[np.int64]
    support: NDArray[np.int64]


def segments_of(hypothesis: Hypothesis, frame: Frame, slack: float = 2.0, floor: float = 0.004) -> dict[int, Segment]:
    """The segments of a hypothesis in a frame, by label; invisible objects have none.

    Parameters
    ----------
    slack : measured and rendered depth may differ by this many voxels in the support.
    floor : metres; points lower than this belong to the table, not to the support.
    """
    labels, depth = render_hypothesis(hypothesis, frame.camera)
    flat_labels = labels.ravel()
    seen = np.flatnonzero(flat_labels)
    with np.errstate(invalid="ignore"):
        agrees = np.abs(frame.depth - depth) < slack * hypothesis.grid.voxel_size
        agrees &= frame.points[..., 2] > floor
    agrees &= frame.valid
    # Mixed pixels on the rim of a mask carry the depth and colour of what is behind.
    interior = _interior(labels)
    order = seen[np.argsort(flat_labels[seen], kind="stable")]
    values, starts = np.unique(flat_labels[order], return_index=True)
    bounds = [*starts.tolist(), len(order)]
    voxel_keys = _voxel_keys(hypothesis)
    out = {}
    for k, label in enumerate(values.tolist()):
        pixels = order[bounds[k] : bounds[k + 1]]
        support = pixels[agrees.ravel()[pixels]]
        inner = support[interior.ravel()[support]]
        support = inner if len(inner) >= 60 else support
        out[label] = Segment(content_key(pixels, voxel_keys[label]), pixels, support)
    return out


def _interior(labels: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Pixels all of whose four neighbours carry the same label."""
    padded = np.pad(labels, 1)
    centre = padded[1:-1, 1:-1]
    return (
        (padded[:-2, 1:-1] == centre)
        & (padded[2:, 1:-1] == centre)
        & (padded[1:-1, :-2] == centre)
        & (padded[1:-1, 2:] == centre)
    )


def _voxel_keys(hypothesis: Hypothesis) -> dict[int, bytes]:
    """A content name of each object's voxels."""
    flat = hypothesis.labels.ravel()
    occupied = np.flatnonzero(flat)
    order = occupied[np.argsort(flat[occupied], kind="stable")]
    values, starts = np.unique(flat[order], return_index=True)
    bounds = [*starts.tolist(), len(order)]
    return {int(v): content_key(order[bounds[k] : bounds[k + 1]]) for k, v in enumerate(values)}
