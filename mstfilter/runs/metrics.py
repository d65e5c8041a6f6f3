"""Figures of a run at a pause: what the protocol of the studies asks for.

>>> row = measure_pause(run, recording, t=2)
>>> row["quality"], row["quality_hidden"], row["split"], row["brier"]

All are means over the hypotheses, each counting the same, unless they say otherwise; truth is volumetric.

``quality``: weighted coverage, form ``objects``: missing, invented, split and merged objects all cost;
``quality_paper``, ``quality_authors``: its other forms (`mstfilter.scoring.quality`).
``quality_top``, ``quality_weighted``, ``quality_best``: of the heaviest hypothesis; mean by weight; of the best one
(to be compared between equal n only).
``quality_visible``, ``_hidden``, ``_unseen``: coverage of the true objects of that status alone (`coverage_of`).
``quality_one_blob``, ``quality_components``: floors; the same occupied voxels as one object, and as components.
``occupancy``: intersection over union of all that is occupied. ``object_f``: F score of objects at IoU 0.5.
``split``, ``merged``, ``missed``, ``invented``: numbers of objects (`errors_of`).
``diversity``: 1 - mean quality of one hypothesis against another; 0 if all are alike.
``brier``, ``disputed``: see `pair_brier`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mstfilter.runs.run_folder import RunFolder
from mstfilter.scene import Recording
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

MOST = 0.5
FRAGMENT = 0.1
_PAIRS_AT_ONCE = 2**22


def measure_pause(run: RunFolder, recording: Recording, t: int) -> dict[str, Any]:
    """One row: the figures of the hypotheses of a run at pause `t`; without true volumes only what needs none.

    The list ``qualities``, one a hypothesis, is for figures; tables leave it out.
    """
    info, hypotheses = run.info(t), run.hypotheses(t)
    labels, weights = [h.labels for h in hypotheses], np.array(info["weights"], dtype=float)
    row: dict[str, Any] = {"pause": t, "time_s": recording.times[recording.pauses[t]], "n": info["n"]}
    row["n_objects"] = float(np.mean([h.n_objects for h in hypotheses]))
    truth = recording.truth(t)
    if truth is None:
        return {**row, "diversity": diversity(labels)}
    known = all(recording.instance(p) is not None for p in recording.pauses[: t + 1])
    found, q = _figures(labels, weights, truth, object_status(recording, t) if known else {})
    return {**row, **found, "qualities": q.tolist()}


def figures(
    labels: Sequence[np.ndarray], weights: np.ndarray, truth: np.ndarray, status: Mapping[int, str]
) -> dict[str, float]:
    """The figures of hypotheses against the truth.

    Parameters
    ----------
    labels : n arrays (X, Y, Z) of int
        The hypotheses.
    weights : (n,) float
        Sum 1.
    truth : (X, Y, Z) int
    status : mapping
        True label -> visible, hidden or unseen; empty where not known.
    """
    return _figures(labels, weights, truth, status)[0]


def _figures(
    labels: Sequence[np.ndarray], weights: np.ndarray, truth: np.ndarray, status: Mapping[int, str]
) -> tuple[dict[str, float], np.ndarray]:
    """The figures, and the quality of every hypothesis (n,)."""
    (truth, *labels), n_free = _cropped([truth, *labels])
    distinct, which = _distinct(labels)
    tables = [_with_free(overlap(one, truth), n_free) for one in distinct]
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
    errors = [errors_of(table) for table in tables]
    for kind in errors[0]:
        row[kind] = mean([e[kind] for e in errors])
    row["true_objects"] = float(np.count_nonzero(tables[0].labels_b))
    row["diversity"] = diversity(labels)
    row["brier"], row["disputed"] = pair_brier(labels, weights, truth)
    return row, q


def _cropped(grids: Sequence[np.ndarray]) -> tuple[list[np.ndarray], int]:
    """The grids cut to where any of them is occupied, and how many voxels were cut away, which are free in all.

    A layer of free voxels stays wherever something is cut, so that free space is still a region of every grid.
    """
    occupied = np.any([grid > 0 for grid in grids], axis=0)
    box = []
    for axis in range(occupied.ndim):
        hit = np.flatnonzero(occupied.any(axis=tuple(a for a in range(occupied.ndim) if a != axis)))
        box.append(slice(max(hit[0] - 1, 0), hit[-1] + 2) if len(hit) else slice(0, 1))
    cut = [np.ascontiguousarray(grid[tuple(box)]) for grid in grids]
    return cut, occupied.size - cut[0].size


def _with_free(table: Overlap, n_free: int) -> Overlap:
    """The table of the whole grids."""
    counts = table.counts.copy()
    if n_free:
        counts[0, 0] += n_free
    return Overlap(table.labels_a, table.labels_b, counts)


def _distinct(labels: Sequence[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """The different ones, and which of them each is (n,)."""
    found: dict[bytes, int] = {}
    which = np.array([found.setdefault(one.tobytes(), len(found)) for one in labels])
    return [labels[int(np.flatnonzero(which == k)[0])] for k in range(len(found))], which


def _objects(table: Overlap) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Intersections (na, nb), sizes (na,) and (nb,) and intersections over union, label 0 left out."""
    rows, columns = table.labels_a > 0, table.labels_b > 0
    box = np.ix_(rows, columns)
    return table.counts[box], table.sizes_a[rows], table.sizes_b[columns], table.jaccard()[box]


def coverage_of(table: Overlap, labels: Sequence[int]) -> float:
    """Coverage of some true objects: how well the best object of the hypothesis overlaps each (intersection over
    union), averaged by size; NaN if there are none of them."""
    _, _, sizes, jaccard = _objects(table)
    chosen = np.isin(table.labels_b[table.labels_b > 0], np.asarray(labels, dtype=np.int64))
    if not chosen.any():
        return float("nan")
    best = jaccard.max(axis=0) if len(jaccard) else np.zeros(len(sizes))
    return float((sizes * best)[chosen].sum() / sizes[chosen].sum())


def occupancy_iou(table: Overlap) -> float:
    """Intersection over union of all occupied voxels, whatever object they belong to; 1 if both are empty."""
    counts, sizes_a, sizes_b, _ = _objects(table)
    union = sizes_a.sum() + sizes_b.sum() - counts.sum()
    return float(counts.sum() / union) if union else 1.0


def object_f(table: Overlap) -> float:
    """F score of objects; a match is an intersection over union above 0.5, so nothing can match twice (Kirillov et
    al. 2019). 1 if both are empty."""
    _, sizes_a, sizes_b, jaccard = _objects(table)
    total = len(sizes_a) + len(sizes_b)
    return float(2 * np.count_nonzero(jaccard > 0.5) / total) if total else 1.0


def errors_of(table: Overlap) -> dict[str, float]:
    """Counts of what is wrong, in the manner of Hoover et al. 1996.

    *split*: true objects in which two or more objects of the hypothesis mostly lie, each at least a tenth of the true
    one's size. *merged*: objects of the hypothesis that hold most of two or more true ones. *missed*: true objects
    that neither lie mostly in an object of the hypothesis nor hold most of one. *invented*: the same the other way
    round. Most is more than half.
    """
    counts, sizes_a, sizes_b, _ = _objects(table)
    lies = counts > MOST * sizes_a[:, None]
    holds = counts > MOST * sizes_b[None, :]
    fragment = sizes_a[:, None] >= FRAGMENT * sizes_b[None, :]
    related = lies | holds
    return {
        "split": float(((lies & fragment).sum(axis=0) >= 2).sum()),
        "merged": float((holds.sum(axis=1) >= 2).sum()),
        "missed": float((~related.any(axis=0)).sum()),
        "invented": float((~related.any(axis=1)).sum()),
    }


def diversity(labels: Sequence[np.ndarray]) -> float:
    """1 - mean quality over all pairs of different hypotheses (by number, so two equal ones count); NaN for one."""
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
    """Brier score of "these two voxels belong to the same object", where the hypotheses disagree about it.

    The forecast for a pair is the weight of the hypotheses in which both belong to one object.

    Parameters
    ----------
    labels : n arrays (X, Y, Z) of int
    weights : (n,) float
        Sum 1.
    truth : (X, Y, Z) int

    Returns
    -------
    (float, float)
        Mean squared error over the pairs that some hypotheses have in one object and others not (NaN if there is
        none); their share among the pairs that any hypothesis has in one object.
    """
    # Voxels with the same labels in all hypotheses and in the truth behave alike: count them once.
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
        own = np.arange(block.stop - begin)
        pairs[own, own + begin] -= sizes[block]  # no voxel with itself; every other pair is met twice
        joined += float(pairs[times > 0].sum())
        doubt = (times > 0) & (times < n)
        disputed += float(pairs[doubt].sum())
        error += float((pairs[doubt] * (forecast[doubt] - true[doubt]) ** 2).sum())
    if not joined:
        return float("nan"), float("nan")
    return (error / disputed if disputed else float("nan")), disputed / joined


def _patterns(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Different columns of (k, m) small whole numbers, and how often each occurs."""
    code = np.zeros(columns.shape[1], np.int64)
    for row in columns:  # renumbered after every row, so that the code stays small
        code = code * (int(row.max(initial=0)) + 1) + row
        _, code = np.unique(code, return_inverse=True)
    _, first, sizes = np.unique(code, return_index=True, return_counts=True)
    return columns[:, first], sizes.astype(np.float64)
