"""Metrics of the hypotheses at one pause of a run.

>>> row = measure_pause(run, recording, t=2)
>>> row["quality"], row["quality_hidden"], row["split"], row["brier"]

Unless stated otherwise, a metric is the unweighted mean over the hypotheses, measured in volume against the ground
truth.

``quality``: weighted coverage in the form ``objects``; missed, invented, split and merged objects reduce it.
``quality_paper``, ``quality_authors``: the other forms (see `mstfilter.scoring`).
``quality_top``, ``quality_weighted``, ``quality_best``: quality of the hypothesis of largest weight, weighted mean,
and maximum. The maximum can only be compared at equal numbers of hypotheses.
``quality_visible``, ``quality_hidden``, ``quality_unseen``: coverage of the true objects that are visible at this
pause, were visible at an earlier one only, or never were (`mstfilter.scoring.object_status`).
``quality_one_blob``, ``quality_components``: trivial baselines: the occupied voxels as one object, or as their
connected components.
``occupancy``: intersection over union of the occupied voxels. ``object_f``: F score of objects at IoU 0.5.
``split``, ``merged``, ``missed``, ``invented``: numbers of objects (see `object_errors`).
``diversity``: 1 - mean quality of one hypothesis against another; 0 if all are equal.
``brier``, ``disputed``: see `pair_brier`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mstfilter.runs.run_folder import RunFolder
from mstfilter.scene import Recording, occupied_box
from mstfilter.scoring import (
    FORMS,
    STATUSES,
    Overlap,
    connected_components,
    object_status,
    one_blob,
    overlap,
    quality_of,
    weighted_coverage,
)

_MOST = 0.5
_FRAGMENT = 0.1
_PAIRS_AT_ONCE = 2**22


def measure_pause(run: RunFolder, recording: Recording, t: int) -> dict[str, Any]:
    """The metrics of a run at pause `t`; without ground truth only those that need none.

    ``qualities`` is the list of the quality of each hypothesis; tables leave it out.
    """
    info, hypotheses = run.info(t), run.hypotheses(t)
    labels, weights = [h.labels for h in hypotheses], np.array(info["weights"], dtype=float)
    row: dict[str, Any] = {"pause": t, "time_s": recording.times[recording.pauses[t]], "n": info["n"]}
    row["n_objects"] = float(np.mean([h.n_objects for h in hypotheses]))
    truth = recording.truth(t)
    if truth is None:
        return {**row, "diversity": diversity(labels)}
    known = all(recording.instance(p) is not None for p in recording.pauses[: t + 1])
    found, q = pause_metrics(labels, weights, truth, object_status(recording, t) if known else {})
    return {**row, **found, "qualities": q.tolist()}


def pause_metrics(
    labels: Sequence[np.ndarray], weights: np.ndarray, truth: np.ndarray, status: Mapping[int, str]
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
    """
    (truth, *labels), n_free = _cropped([truth, *labels])
    distinct, which = _distinct(labels)
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
    row["occupancy"] = mean([occupancy_iou(table) for table in tables])
    row["object_f"] = mean([object_f(table) for table in tables])
    errors = [object_errors(table) for table in tables]
    for kind in errors[0]:
        row[kind] = mean([e[kind] for e in errors])
    row["true_objects"] = float(np.count_nonzero(tables[0].labels_b))
    row["diversity"] = diversity(labels)
    row["brier"], row["disputed"] = pair_brier(labels, weights, truth)
    return row, q


def _cropped(grids: Sequence[np.ndarray]) -> tuple[list[np.ndarray], int]:
    """The grids cropped to the voxels that any of them occupies, and the number of voxels removed.

    A layer of free voxels is kept at each side that is cropped, so that free space remains a region of every grid.
    """
    occupied = np.any([grid > 0 for grid in grids], axis=0)
    tight = occupied_box(occupied) or (slice(0, 0),) * occupied.ndim
    box = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in tight)
    cut = [np.ascontiguousarray(grid[box]) for grid in grids]
    return cut, occupied.size - cut[0].size


def _distinct(labels: Sequence[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """The distinct arrays, and the index (n,) of each array among them."""
    found: dict[bytes, int] = {}
    which = np.array([found.setdefault(one.tobytes(), len(found)) for one in labels])
    return [labels[int(np.flatnonzero(which == k)[0])] for k in range(len(found))], which


def _objects(table: Overlap) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Intersections (na, nb), sizes (na,) and (nb,) and intersections over union, label 0 left out."""
    rows, columns = table.labels_a > 0, table.labels_b > 0
    box = np.ix_(rows, columns)
    return table.counts[box], table.sizes_a[rows], table.sizes_b[columns], table.jaccard()[box]


def coverage_of(table: Overlap, labels: Sequence[int]) -> float:
    """Coverage of some true objects: the largest intersection over union of each with an object of the hypothesis,
    averaged by size; NaN if there are none."""
    _, _, sizes, jaccard = _objects(table)
    chosen = np.isin(table.labels_b[table.labels_b > 0], np.asarray(labels, dtype=np.int64))
    if not chosen.any():
        return float("nan")
    best = jaccard.max(axis=0) if len(jaccard) else np.zeros(len(sizes))
    return float((sizes * best)[chosen].sum() / sizes[chosen].sum())


def occupancy_iou(table: Overlap) -> float:
    """Intersection over union of the occupied voxels; 1 if both are empty."""
    counts, sizes_a, sizes_b, _ = _objects(table)
    union = sizes_a.sum() + sizes_b.sum() - counts.sum()
    return float(counts.sum() / union) if union else 1.0


def object_f(table: Overlap) -> float:
    """F score of objects, matched by an intersection over union above 0.5, so that no object matches twice (Kirillov
    et al. 2019); 1 if both are empty."""
    _, sizes_a, sizes_b, jaccard = _objects(table)
    total = len(sizes_a) + len(sizes_b)
    return float(2 * np.count_nonzero(jaccard > 0.5) / total) if total else 1.0


def object_errors(table: Overlap) -> dict[str, float]:
    """Numbers of split, merged, missed and invented objects (as in Hoover et al. 1996).

    *split*: true objects that contain more than half of each of two or more objects of the hypothesis, which have at
    least a tenth of its size. *merged*: objects of the hypothesis that contain more than half of each of two or more
    true objects. *missed*: true objects of which no object of the hypothesis contains more than half, and that
    contain more than half of none. *invented*: the same with the roles exchanged.
    """
    counts, sizes_a, sizes_b, _ = _objects(table)
    lies = counts > _MOST * sizes_a[:, None]
    holds = counts > _MOST * sizes_b[None, :]
    fragment = sizes_a[:, None] >= _FRAGMENT * sizes_b[None, :]
    related = lies | holds
    return {
        "split": float(((lies & fragment).sum(axis=0) >= 2).sum()),
        "merged": float((holds.sum(axis=1) >= 2).sum()),
        "missed": float((~related.any(axis=0)).sum()),
        "invented": float((~related.any(axis=1)).sum()),
    }


def diversity(labels: Sequence[np.ndarray]) -> float:
    """1 - mean quality over all pairs of hypotheses, equal ones included; NaN for a single hypothesis."""
    n = len(labels)
    if n < 2:
        return float("nan")
    distinct, which = _distinct(labels)
    share = np.bincount(which, minlength=len(distinct))
    total = 0.0
    for a in range(len(distinct)):
        for b in range(a):
            total += share[a] * share[b] * (1 - weighted_coverage(distinct[a], distinct[b]))
    return float(total / (n * (n - 1) / 2))


def pair_brier(labels: Sequence[np.ndarray], weights: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Brier score of the statement "these two voxels belong to the same object", over pairs that are disputed.

    The forecast for a pair is the total weight of the hypotheses in which both voxels belong to one object.

    Parameters
    ----------
    labels : n arrays (X, Y, Z) of int
    weights : (n,) float
        Sum 1.
    truth : (X, Y, Z) int

    Returns
    -------
    (float, float)
        Mean squared error over the disputed pairs, which some but not all hypotheses put into one object (NaN if
        there are none), and their share of the pairs that any hypothesis puts into one object.
    """
    # Voxels with equal labels in all hypotheses and in the truth form a pattern; pairs of patterns are counted.
    stacked = np.stack([np.asarray(one).ravel() for one in labels])
    occupied = (stacked > 0).any(axis=0)
    names, sizes = _patterns(np.vstack([stacked[:, occupied], np.asarray(truth).ravel()[occupied]]))
    n, m = len(labels), names.shape[1]
    error = disputed = joined = 0.0
    rows = max(1, _PAIRS_AT_ONCE // max(m, 1))
    for begin in range(0, m, rows):
        block = slice(begin, min(begin + rows, m))
        forecast = np.zeros((block.stop - begin, m), np.float32)
        times = np.zeros(forecast.shape, np.int32)
        for name, weight in zip(names[:n], weights, strict=True):
            same = (name[block, None] == name[None, :]) & (name[block, None] > 0)
            times += same
            forecast += np.float32(weight) * same
        true = (names[n, block, None] == names[n][None, :]) & (names[n, block, None] > 0)
        pairs = np.outer(sizes[block], sizes)
        rows_here = np.arange(block.stop - begin)
        pairs[rows_here, rows_here + begin] -= sizes[block]  # no pair of a voxel with itself
        joined += float(pairs[times > 0].sum())
        doubt = (times > 0) & (times < n)
        disputed += float(pairs[doubt].sum())
        error += float((pairs[doubt] * (forecast[doubt] - true[doubt]) ** 2).sum())
    if not joined:
        return float("nan"), float("nan")
    return (error / disputed if disputed else float("nan")), disputed / joined


def _patterns(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct columns of (k, m) small integers, and the number of times that each occurs."""
    code = np.zeros(columns.shape[1], np.int64)
    for row in columns:  # renumbered after each row to keep the code small
        code = code * (int(row.max(initial=0)) + 1) + row
        _, code = np.unique(code, return_inverse=True)
    _, first, sizes = np.unique(code, return_index=True, return_counts=True)
    return columns[:, first], sizes.astype(np.float64)
