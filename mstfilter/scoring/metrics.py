"""Metrics of the hypotheses at one pause against the ground truth.

>>> row, qualities = pause_metrics(labels, weights, recording.truth(2), object_status(recording, 2))
>>> row["quality"], row["quality_hidden"], row["split"], row["volume_invented"]

Unless stated otherwise, a metric is the unweighted mean over the hypotheses, and sizes are volumes.

=============================================  =======================================================================
``quality``                                    weighted coverage in the form ``objects``: missed, invented, split and
                                               merged objects reduce it
``quality_paper``, ``quality_authors``         the other forms (`mstfilter.scoring.quality`)
``quality_weighted``, ``quality_best``         mean by weight; maximum, comparable only for equal numbers of
                                               hypotheses
``quality_top``                                of the hypothesis of largest weight; if several have it, of the first,
                                               a random draw
``quality_estimate``                           of the one answer: `Belief.estimate`, or else the hypothesis of least
                                               expected loss (`least_loss`)
``quality_visible``, ``n_visible``             coverage and number of the true objects that are visible at this pause
``quality_hidden``, ``n_hidden``               of those that were visible only at earlier pauses
``quality_unseen``, ``n_unseen``               of those that never were visible (`mstfilter.scoring.object_status`)
``quality_one_blob``, ``quality_components``   trivial baselines: the occupied voxels as one object, or as their
                                               connected components
``occupancy``                                  intersection over union of the occupied voxels
``volume_missed``, ``volume_invented``         volume that is occupied only in the truth, only in the hypothesis,
                                               divided by the true volume; NaN if it is 0
``object_f``                                   F score of objects at IoU 0.5
``split``, ``merged``                          numbers of objects (`object_metrics`)
``missed``, ``invented``                       numbers of objects without a partner (`object_metrics`)
``true_objects``                               number of true objects
``diversity``                                  1 - mean quality over pairs of hypotheses, 0 if all are identical
=============================================  =======================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.scene import CommonRefinement, as_labels, common_refinement, occupied_box
from mstfilter.scoring.quality import (
    FORMS,
    STATUSES,
    Overlap,
    connected_components,
    one_blob,
    overlap,
    quality_of,
    weighted_coverage,
)
from mstfilter.smc import first_seen

_MOST = 0.5
_FRAGMENT = 0.1


def pause_metrics(
    labels: Sequence[np.ndarray],
    weights: np.ndarray,
    truth: np.ndarray,
    status: Mapping[int, str],
    answer: int | None = None,
) -> tuple[dict[str, float], np.ndarray]:
    """Metrics of hypotheses against the ground truth, and the quality (n,) of every hypothesis.

    Parameters
    ----------
    labels : n arrays (X, Y, Z) of int
        The hypotheses.
    weights : (n,) float
        Sum 1.
    truth : (X, Y, Z) int
    status : mapping
        True label -> visible, hidden or unseen; empty if unknown.
    answer : int, optional
        Index of the hypothesis that is the one answer. Default: that of `least_loss`.
    """
    (truth, *labels), n_free = _cropped(_checked([truth, *labels]))
    which = first_seen(one.tobytes() for one in labels)
    distinct = [labels[k] for k in np.unique(which, return_index=True)[1]]
    tables = [overlap(one, truth) for one in distinct]
    if n_free:  # the cropped grids have free voxels, too
        for table in tables:
            table.counts[0, 0] += n_free
    share = np.bincount(which, minlength=len(distinct)) / len(labels)

    def mean(values: Sequence[float] | np.ndarray) -> float:
        return float(share @ np.asarray(values, dtype=float))

    quality = {form: np.array([quality_of(table, form) for table in tables]) for form in FORMS}
    q = quality["objects"][which]
    row = {
        "quality": mean(quality["objects"]),
        "quality_paper": mean(quality["paper"]),
        "quality_authors": mean(quality["authors"]),
        "quality_top": float(q[int(np.argmax(weights))]),
        "quality_weighted": float(weights @ q),
        "quality_best": float(q.max()),
    }
    for one in STATUSES:
        chosen = [k for k, s in status.items() if s == one]
        row[f"quality_{one}"] = mean([coverage_of(table, chosen) for table in tables])
        row[f"n_{one}"] = float(len(chosen)) if status else np.nan
    row["quality_one_blob"] = mean([weighted_coverage(one_blob(one), truth) for one in distinct])
    row["quality_components"] = mean([weighted_coverage(connected_components(one), truth) for one in distinct])
    of_objects = [object_metrics(table) for table in tables]
    row |= {name: mean([one[name] for one in of_objects]) for name in of_objects[0]}
    row["true_objects"] = float(np.count_nonzero(tables[0].labels_b))
    between = pairwise_quality(distinct)[np.ix_(which, which)]
    row["quality_estimate"] = float(q[int(np.argmax(between @ weights)) if answer is None else answer])
    row["diversity"] = diversity(between)
    return row, q


def _checked(labels: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The labels as uint16. Raises InputError for invalid labels, or for shapes that differ."""
    found = [as_labels(one, "segmentation") for one in labels]
    if len({one.shape for one in found}) != 1:
        raise InputError(
            f"segmentations have shapes {[one.shape for one in found]}, expected at least one, all equal"
        )
    return found


def _cropped(grids: Sequence[np.ndarray]) -> tuple[list[np.ndarray], int]:
    """The grids, cropped to the bounding box of all occupied voxels, and the number of removed voxels.

    A layer of free voxels is kept at each cropped side, so that free space remains a region of every grid.
    """
    occupied = np.any([grid > 0 for grid in grids], axis=0)
    tight = occupied_box(occupied) or (slice(0, 0),) * occupied.ndim
    box = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in tight)
    cut = [np.ascontiguousarray(grid[box]) for grid in grids]
    return cut, occupied.size - cut[0].size


def coverage_of(table: Overlap, labels: Sequence[int]) -> float:
    """Largest IoU of each true object in `labels` with an object, averaged by size; NaN without such objects."""
    _, _, sizes, jaccard = table.objects()
    chosen = np.isin(table.labels_b[table.labels_b > 0], np.asarray(labels, dtype=np.int64))
    if not chosen.any():
        return float("nan")
    best = jaccard.max(axis=0) if len(jaccard) else np.zeros(len(sizes))
    return float((sizes * best)[chosen].sum() / sizes[chosen].sum())


def object_metrics(table: Overlap) -> dict[str, float]:
    """Metrics of the objects of one hypothesis against the truth, by name. Labels a of `table` are the hypothesis.

    - *split*: true objects that contain more than half of each of two or more objects of the hypothesis. Only
      hypothesis objects with at least a tenth of the true object's size count.
    - *merged*: objects of the hypothesis that contain more than half of each of two or more true objects.
    - *missed*: true objects without a partner. A true object and a hypothesis object are partners if one of them
      contains more than half of the other (as in Hoover et al. 1996).
    - *invented*: hypothesis objects without a partner.

    For ``object_f``, objects are matched by an intersection over union above 0.5, so that no object matches twice
    (Kirillov et al. 2019). ``occupancy`` and ``object_f`` are 1 if neither the truth nor the hypothesis has objects.
    """
    counts, sizes_a, sizes_b, jaccard = table.objects()
    found, true, both = float(sizes_a.sum()), float(sizes_b.sum()), float(counts.sum())
    n = len(sizes_a) + len(sizes_b)
    lies = counts > _MOST * sizes_a[:, None]
    holds = counts > _MOST * sizes_b[None, :]
    fragment = sizes_a[:, None] >= _FRAGMENT * sizes_b[None, :]
    related = lies | holds
    return {
        "occupancy": both / (found + true - both) if found + true else 1.0,
        "volume_missed": (true - both) / true if true else float("nan"),
        "volume_invented": (found - both) / true if true else float("nan"),
        "object_f": float(2 * np.count_nonzero(jaccard > 0.5) / n) if n else 1.0,
        "split": float(((lies & fragment).sum(axis=0) >= 2).sum()),
        "merged": float((holds.sum(axis=1) >= 2).sum()),
        "missed": float((~related.any(axis=0)).sum()),
        "invented": float((~related.any(axis=1)).sum()),
    }


def pairwise_quality(labels: Sequence[np.ndarray]) -> np.ndarray:
    """Quality (n, n) of all pairs of label grids of one shape, in the form ``objects``; 1 on the diagonal."""
    return refined_quality(common_refinement(_checked(labels)))


def refined_quality(refined: CommonRefinement) -> np.ndarray:
    """`pairwise_quality` (n, n) of the n segmentations of a common refinement."""
    shared = refined.overlaps()
    sizes, jaccard = shared.diagonal()[1:].copy(), refined.jaccard(shared)[1:, 1:]
    objects = [slice(a, b) for a, b in pairwise(refined.first)]  # of each hypothesis
    best = np.stack([jaccard[:, k].max(axis=1, initial=0.0) for k in objects], axis=1)
    volumes = np.array([sizes[k].sum() for k in objects])
    covered = np.stack([sizes[k] @ best[k] for k in objects]) / np.maximum(volumes, 1)[:, None]
    quality = (covered + covered.T) / 2
    empty = volumes == 0
    quality[np.ix_(empty, empty)] = 1.0  # an empty and another hypothesis have quality 0
    return np.asarray(quality)


def least_loss(labels: Sequence[np.ndarray], weights: np.ndarray) -> int:
    """Index of the hypothesis of least expected loss, with the largest weighted mean quality against all hypotheses.

    ``argmax_i sum_j w_j q(h_i, h_j)``, where q is the quality in the form ``objects``. This hypothesis is
    the best single answer among the hypotheses if the truth is distributed as the weighted hypotheses.
    """
    return int(np.argmax(pairwise_quality(labels) @ np.asarray(weights, dtype=np.float64)))


def diversity(quality: np.ndarray) -> float:
    """1 - mean quality over all pairs of hypotheses, from `pairwise_quality` (n, n); NaN for a single hypothesis."""
    n = len(quality)
    return float((1 - quality).sum() / (n * (n - 1))) if n > 1 else float("nan")
