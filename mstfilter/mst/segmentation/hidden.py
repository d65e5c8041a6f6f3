"""One object on both sides of another: joins of segments that do not touch in the image.

A cup in front of a box can divide what is seen of the box into two segments without a common border, so a tree of
merges has no node for the box. The two belong together if what lies between them is hidden by something nearer, and
if surfaces, heights and colours agree. `hidden_pairs` finds the pairs of segments that are divided in this way and
measures how much they disagree. `with_joins` adds a node for each pair that may be one object to the merges of a
tree:

>>> merges = BorderTree().merges(regions)
>>> merges = with_joins(merges, regions, frame)

The log odds that the two are different objects are a linear function of the disagreement, which was fitted to
simulated and real images (``experiments/segmentation_fit/hidden.py``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from mstfilter.mst.segmentation.boundary import filled_disparity
from mstfilter.mst.segmentation.pair_measures import NO_BORDER, PairMeasures
from mstfilter.mst.segmentation.regions import Regions
from mstfilter.mst.segmentation.tree import Merge
from mstfilter.scene import Frame, posed_camera, scaled_area, scaled_length

#: What the disagreement of a pair is: the largest of these measurements, each in units of the number here. The misfit
#: of one quadric surface to both segments, the difference of their heights in units of 10 cm, and the Bhattacharyya
#: distance of their colours.
DISAGREEMENT = {"misfit": 3.0, "height": 0.45, "texture": 0.9}
#: Log odds of different objects: slope times (disagreement - even).
SLOPE, EVEN = 3.2, 1.07
_MOST_DISAGREEMENT = 3.0
_STEP = 4.0  # sensor units of disparity: something this much nearer hides what is behind it
_NEARER = 2.0  # sensor units: a pixel between two segments hides what is there if it is this much nearer than both
_REACH = 2  # pixels on both sides of a border between which its step is measured, in an image 640 wide
_SHADOW = 40  # pixels without readings that there can be beside something nearer, in an image 640 wide
_LEAST_PIXELS = 200  # of a segment, in an image of 640 x 480
_LEAST_OUTLINE = 6  # pixels of a segment's outline that something nearer hides
_LINES, _SAMPLES = 60, 24  # lines across a gap from each side, and pixels of a line that are looked at
_HIDDEN, _NEAR = 0.8, 0.3  # least share of the readings and of the pixels of a hidden line that are nearer
_LEAST_HIDDEN = 0.4  # share of the lines of a pair
_MOST_GAP = 0.35  # metres
_MOST_ODDS = 4.0  # log odds of different objects: less probable pairs get no node


def hidden_pairs(segments: np.ndarray, sums: np.ndarray, frame: Frame) -> tuple[list[tuple[int, int]], np.ndarray]:
    """The pairs of segments that something nearer divides, and how they disagree (k, `DISAGREEMENT`), 0 .. 3.

    `segments` (H, W) int has the segment of every pixel, and 0 for the table; `sums` (S, C) the row of each segment
    (`Regions.sums`). Segments with a common border are no pairs.
    """
    width = segments.shape[1]
    disparity, shadow = filled_disparity(frame), ~frame.valid & (segments == 0)
    outline = _hidden_outline(segments, disparity, shadow)
    sizes = np.bincount(segments.ravel(), minlength=len(sums))
    touching = _touching(segments)
    own = {
        k: outline[k]
        for k in outline
        if len(outline[k]) >= _LEAST_OUTLINE and sizes[k] >= scaled_area(_LEAST_PIXELS, segments.size)
    }
    points = posed_camera(frame).unproject(frame.depth)
    pairs = [
        (a, b)
        for a, b in combinations(sorted(own), 2)
        if (a, b) not in touching and _divided(a, b, own[a], own[b], segments, disparity, shadow, points)
    ]
    first, second = np.array(pairs, dtype=int).reshape(-1, 2).T
    none = np.broadcast_to(NO_BORDER, (len(pairs), len(NO_BORDER)))
    pair = PairMeasures(sums[first], sums[second], none, none, none, scaled_length(1, width))
    measured = {"misfit": pair.misfit, "height": np.abs(pair.higher), "texture": pair.texture()}
    values = np.column_stack([measured[name] / unit for name, unit in DISAGREEMENT.items()])
    return pairs, np.minimum(values, _MOST_DISAGREEMENT)


def _hidden_outline(segments: np.ndarray, disparity: np.ndarray, shadow: np.ndarray) -> dict[int, np.ndarray]:
    """The pixels (n, 2) of each segment at which another, nearer segment begins.

    Between the two there can be a `shadow` (H, W) bool: pixels without readings, which are beside something near.
    """
    width = segments.shape[1]
    reach, most = (max(1, round(scaled_length(n, width))) for n in (_REACH, _SHADOW))
    found = []
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        # All directions are that of ascending columns of the turned images.
        own, d, dark = (_turned(image, axis, step) for image in (segments, disparity, shadow))
        columns = np.arange(own.shape[1])
        after = np.where(dark, own.shape[1], columns)[:, ::-1]
        after = np.minimum.accumulate(after, axis=1)[:, ::-1]  # the first pixel from here on that is not dark
        after = np.append(after[:, 1:], np.full((len(own), 1), own.shape[1]), axis=1)
        row, column = np.nonzero((own > 0) & (after <= columns + most) & (after < own.shape[1]))
        other = after[row, column]
        differs = (own[row, other] > 0) & (own[row, other] != own[row, column])
        row, column, other = row[differs], column[differs], other[differs]
        inside = np.minimum(other + reach, own.shape[1] - 1)
        nearer = d[row, inside] - d[row, np.maximum(column - reach, 0)] > _STEP
        row, column = row[nearer], column[nearer]
        column = column if step > 0 else own.shape[1] - 1 - column
        found.append(np.column_stack([row, column] if axis else [column, row]))
    at = np.unique(np.concatenate(found), axis=0)
    which = segments[at[:, 0], at[:, 1]]
    return {int(k): at[which == k] for k in np.unique(which)}


def _turned(image: np.ndarray, axis: int, step: int) -> np.ndarray:
    """An image (H, W) whose columns ascend in a direction along an axis."""
    image = image if axis else image.T
    return image if step > 0 else image[:, ::-1]


def _touching(segments: np.ndarray) -> set[tuple[int, int]]:
    """The pairs of segments, the lower number first, with a common border."""
    pairs = np.concatenate(
        [
            np.column_stack([segments[:, :-1].ravel(), segments[:, 1:].ravel()]),
            np.column_stack([segments[:-1].ravel(), segments[1:].ravel()]),
        ]
    )
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    return {(int(a), int(b)) for a, b in pairs}


def _divided(
    a: int,
    b: int,
    outline_a: np.ndarray,
    outline_b: np.ndarray,
    segments: np.ndarray,
    disparity: np.ndarray,
    shadow: np.ndarray,
    points: np.ndarray,
) -> bool:
    """Whether enough of the lines across the gap between two segments are hidden, and the gap is small enough.

    A line goes from a pixel of one outline to the nearest of the other.
    """
    starts, ends = [], []
    for one, other in ((outline_a, outline_b), (outline_b, outline_a)):
        some = one[np.linspace(0, len(one) - 1, min(len(one), _LINES)).astype(int)]
        starts.append(some)
        ends.append(other[cKDTree(other).query(some)[1]])
    start, end = np.concatenate(starts), np.concatenate(ends)
    t = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    at = np.rint(start[:, None] + t[:, None] * (end - start)[:, None]).astype(int)
    rows, columns = at[..., 0], at[..., 1]
    on = segments[rows, columns]
    between = (on != a) & (on != b)
    from_a, from_b = (disparity[one[:, 0], one[:, 1]] for one in (start, end))
    nearer = disparity[rows, columns] > np.maximum(from_a, from_b)[:, None] + _NEARER
    nearer &= between
    read = (between & ~shadow[rows, columns]).sum(axis=1)
    hidden = (nearer.sum(axis=1) > _HIDDEN * read) & (nearer.sum(axis=1) > _NEAR * between.sum(axis=1))
    if hidden.mean() < _LEAST_HIDDEN:
        return False
    gaps = np.linalg.norm(points[start[hidden, 0], start[hidden, 1]] - points[end[hidden, 0], end[hidden, 1]], axis=1)
    gaps = gaps[np.isfinite(gaps)]
    return bool(len(gaps)) and float(np.median(gaps)) <= _MOST_GAP


def with_joins(merges: Sequence[Merge], regions: Regions, frame: Frame) -> list[Merge]:
    """The merges of a tree (`MergedTree.merges`) with a node for each pair of segments that may be one object.

    Merges of segments keep their order and log odds. A join comes before the first merge with larger log odds.
    """
    inside, image, sums, nodes = likely_segments(merges, regions)
    pairs, values = hidden_pairs(image, sums, frame)
    odds = SLOPE * (values.max(axis=1, initial=0.0) - EVEN)
    joins = sorted(
        (float(value), nodes[a], nodes[b]) for value, (a, b) in zip(odds, pairs, strict=True) if value < _MOST_ODDS
    )
    return _inserted(merges, len(regions.sums), inside, joins)


def likely_segments(
    merges: Sequence[Merge], regions: Regions
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """The most probable segments: the largest nodes of a tree in which no merge joins different objects.

    Returns whether each merge (m,) is inside a segment, the segment (H, W) of every pixel with 0 for the table, the
    rows (S, C) of the segments (`Regions.sums`), and the node of each.
    """
    n = len(regions.sums)
    inside = np.zeros(len(merges), bool)
    rows = np.concatenate([regions.sums, np.zeros((len(merges), regions.sums.shape[1]))])
    for k, (a, b, odds) in enumerate(merges):
        inside[k] = odds <= 0 and all(one < n or inside[one - n] for one in (a, b))
        rows[n + k] = rows[a] + rows[b]
    top = np.arange(n + len(merges))
    for k in reversed(range(len(merges))):
        if inside[k]:
            top[list(merges[k][:2])] = top[n + k]
    nodes, segment = np.unique(top[1:n], return_inverse=True)
    number = np.concatenate([[0], segment + 1])
    sums = np.concatenate([rows[:1], rows[nodes]])
    return inside, number[regions.image], sums, [0, *nodes.tolist()]


def _inserted(
    merges: Sequence[Merge], n: int, inside: np.ndarray, joins: Sequence[tuple[float, int, int]]
) -> list[Merge]:
    """The merges with joins (log odds, node, node) of segments, in ascending order of log odds."""
    found: list[Merge] = []
    above: dict[int, int] = {}  # the merge of a node of the new tree

    def join(a: int, b: int, odds: float) -> int:
        a, b = (_last(above, node) for node in (a, b))
        if a == b:
            return a
        above[a] = above[b] = new = n + len(found)
        found.append((a, b, odds))
        return new

    node = list(range(n))  # of the new tree, of each old one
    waiting = list(reversed(joins))
    for k, (a, b, odds) in enumerate(merges):
        while waiting and not inside[k] and waiting[-1][0] < odds:
            value, first, second = waiting.pop()
            join(node[first], node[second], value)
        node.append(join(node[a], node[b], odds))
    for value, first, second in reversed(waiting):
        join(node[first], node[second], value)
    return found


def _last(above: Mapping[int, int], node: int) -> int:
    """The last node over a node."""
    while node in above:
        node = above[node]
    return node
