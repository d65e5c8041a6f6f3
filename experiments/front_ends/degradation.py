"""Masks degraded to a given quality: objects split, touching objects merged, borders displaced.

>>> from degradation import degrade
>>> worse = degrade(rng, labels, quality=0.8, over=0.35, under=0.35)
>>> abs(weighted_coverage(worse, labels) - 0.8) < 0.01
True

The loss 1 - quality has three parts, in this order: splits of objects by random lines (a share `over` of the loss),
merges of touching objects (a share `under`), and a smooth random displacement of all borders (the rest). The sizes of
splits and displacements are found by bisection. The quality is not reached where objects fill the image or have few
pixels. The loss of a merge is fixed; merges that cost too much are not made. With more than about 30 objects, more of
the loss is due to displacement. Pieces of one object are not merged again.

Random streams have keys: the objects that a draw is about, and for the displacement the position in the image. So the
same generator makes similar errors in similar images, and errors can persist while a scene changes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from mstfilter.scene import scaled_length
from mstfilter.scoring import weighted_coverage
from mstfilter.smc import child

_TRIES = 30
_TOLERANCE = 0.01  # distance from the quality at which the search ends
_REACH = 120.0  # largest displacement in pixels of a 640 px wide image
_SMOOTH = 15.0  # of the displacement, pixels of a 640 px wide image

_Names = dict[int, tuple[int, ...]]


def degrade(
    rng: np.random.Generator,
    labels: np.ndarray,
    quality: float,
    over: float = 0.35,
    under: float = 0.35,
) -> np.ndarray:
    """Degrade a label image (H, W) of true objects, 0 elsewhere. It is unchanged if there are no objects.

    `quality` is the weighted coverage (form ``objects``) of the result against `labels`; `over` and `under` are the
    shares of the loss due to splits and merges. `rng` is the source of the streams (`mstfilter.smc.child`); its state
    does not change.
    """
    labels = np.asarray(labels, dtype=np.int32)
    if quality >= 1 or not labels.any():
        return labels
    inside = np.nonzero(labels)
    margin = 8
    box = tuple(slice(max(int(k.min()) - margin, 0), int(k.max()) + margin + 1) for k in inside)
    true = labels[box]
    worse, names = _split(rng, true, 1 - over * (1 - quality))
    worse = _merge(rng, true, worse, names, 1 - (over + under) * (1 - quality))
    if over + under < 1 or weighted_coverage(worse, true) > quality + _TOLERANCE:
        worse = _displace(rng, true, worse, quality, labels.shape, box)
    out = np.zeros_like(labels)
    out[box] = worse
    return out


def _split(rng: np.random.Generator, true: np.ndarray, target: float) -> tuple[np.ndarray, _Names]:
    """Cut objects in two until the quality is `target`; the last cut is as small as needed.

    Returns the labels and the name of each: the true object, then the side of each cut.
    """

    def draw(name: tuple[int, ...]) -> np.ndarray:
        """For choosing an object, and for the angle of its cut."""
        return child(rng, "split", *name).random(2)

    labels = true
    names: _Names = {int(k): (int(k),) for k in np.unique(true) if k > 0}
    draws = {k: draw(name) for k, name in names.items()}
    for _ in range(_TRIES):
        if weighted_coverage(labels, true) <= target + _TOLERANCE / 2:
            break
        sizes = np.bincount(labels.ravel())
        # Exponential race: the piece with least -log(1 - u) / size, so a piece is chosen in proportion to its size.
        chosen = min(names, key=lambda k: -np.log1p(-draws[k][0]) / sizes[k])
        where = np.nonzero(labels == chosen)
        angle = np.pi * draws[chosen][1]
        along = np.cos(angle) * where[1] + np.sin(angle) * where[0]
        rank = np.argsort(np.argsort(along, kind="stable"), kind="stable") / max(len(along), 1)
        fresh = max(names) + 1

        cut = partial(_cut, labels, where, rank, fresh)
        share = 0.5
        if weighted_coverage(cut(share), true) < target - _TOLERANCE / 2:
            share = _bisect(cut, true, 0.0, 0.5, target)
        labels = cut(share)
        if (labels == fresh).any():
            names[fresh], names[chosen] = (*names[chosen], 1), (*names[chosen], 0)
            draws |= {k: draw(names[k]) for k in (fresh, chosen)}
        else:
            break  # the cut is empty: no smaller loss is possible
    return labels, names


def _cut(labels: np.ndarray, where: tuple[np.ndarray, ...], rank: np.ndarray, fresh: int, share: float) -> np.ndarray:
    """Give the label `fresh` to the pixels `where` whose rank, 0 to 1, is below `share`."""
    new = labels.copy()
    new[where[0][rank < share], where[1][rank < share]] = fresh
    return new


def _merge(
    rng: np.random.Generator, true: np.ndarray, labels: np.ndarray, names: _Names, target: float
) -> np.ndarray:
    """Join touching objects while the quality stays at `target` or above."""

    @cache
    def turn(pair: tuple[int, int]) -> float:
        """Random rank of a pair."""
        x, y = sorted(names[k] for k in pair)
        return float(child(rng, "merge", len(x), *x, *y).random())

    refused: set[tuple[int, int]] = set()
    roots = {k: {name[0]} for k, name in names.items()}
    for _ in range(_TRIES):
        if weighted_coverage(labels, true) <= target + _TOLERANCE / 2:
            break
        # Merging two pieces of one object would undo a split.
        pairs = {(a, b) for a, b in _touching(labels) - refused if not roots[a] & roots[b]}
        if not pairs:
            break
        a, b = min(pairs, key=lambda pair: (turn(pair), pair))
        new = np.where(labels == b, a, labels)
        if weighted_coverage(new, true) < target - _TOLERANCE / 2:
            refused.add((a, b))
        else:
            labels = new
            roots[a] |= roots[b]
    return labels


def _touching(labels: np.ndarray, gap: int = 3) -> set[tuple[int, int]]:
    """Pairs (a, b), a < b, of objects at most `gap` pixels apart along a row or a column."""
    found: set[tuple[int, int]] = set()
    for image in (labels, labels.T):
        for step in range(1, gap + 1):
            a, b = image[:, :-step].ravel(), image[:, step:].ravel()
            touch = (a != b) & (a > 0) & (b > 0)
            found.update(zip(np.minimum(a, b)[touch].tolist(), np.maximum(a, b)[touch].tolist(), strict=True))
    return found


def _displace(
    rng: np.random.Generator,
    true: np.ndarray,
    labels: np.ndarray,
    target: float,
    image: tuple[int, ...],
    box: tuple[slice, ...],
) -> np.ndarray:
    """Move the label of every pixel along a smooth random field, as far as the target quality requires."""
    from scipy.ndimage import gaussian_filter

    noise = child(rng, "displace").standard_normal((2, *image))
    field = np.stack([gaussian_filter(one, max(1.0, scaled_length(_SMOOTH, image[1])))[box] for one in noise])
    field /= field.std()
    rows, columns = np.indices(true.shape)
    objects = true > 0

    def moved(reach: float) -> np.ndarray:
        r = np.clip(np.rint(rows + reach * field[0]), 0, true.shape[0] - 1).astype(int)
        c = np.clip(np.rint(columns + reach * field[1]), 0, true.shape[1] - 1).astype(int)
        return np.where(objects, labels[r, c], 0)  # only these pixels can belong to an object

    return moved(_bisect(moved, true, 0.0, scaled_length(_REACH, image[1]), target))


def _bisect(
    degraded: Callable[[float], np.ndarray], true: np.ndarray, low: float, high: float, target: float
) -> float:
    """The argument at which the decreasing quality of `degraded` is closest to the target, of all that were tried."""
    best, closest = low, np.inf
    for k in range(24):
        at = high if k == 0 else (low + high) / 2
        value = weighted_coverage(degraded(at), true)
        if abs(value - target) < closest:
            best, closest = at, abs(value - target)
        if closest <= _TOLERANCE / 2:
            break
        if k == 0:
            if value > target:
                break  # the largest argument does not reach the target
            continue
        low, high = (at, high) if value > target else (low, at)
    return best
