"""Boundaries and segmentation trees of COB, with weights that the user supplies.

Maninis, Pont-Tuset, Arbelaez, Van Gool: Convolutional Oriented Boundaries, ECCV 2016 and TPAMI 40(4), 2018.

>>> overrides = "proposal.boundary=cob", "proposal.boundary.weights=COB_BSDS500.caffemodel"
>>> filter = mstfilter.preset("mst", *overrides)                       # its contours below the tree of mst
>>> filter = mstfilter.preset("mst", "proposal.tree=cob", "proposal.tree.contours.weights=COB_BSDS500.caffemodel")

The authors distribute models for Caffe at https://github.com/kmaninis/COB; no licence of the models is stated. The
code here was checked against a plain reference with random weights. It was never run with the published ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mstfilter.base.errors import InputError, naming
from mstfilter.base.fields import NonNegativeFloat, PositiveInt
from mstfilter.base.trained import weights_file
from mstfilter.base.user_files import load_file
from mstfilter.mst.segmentation import BoundaryModel, Tree, TreeBuilder
from mstfilter.mst.segmentation.tree import linkage_tree, prune
from mstfilter.scene import Frame, Recording, UsesFiles, memo

_HERE = Path(__file__).parent
_SOURCE = "COB", "https://github.com/kmaninis/COB"
_MAX_PIXELS = 500 * 500  # larger images are resized to 500 x 500 (`cob_detect.m`)
_LEAST_CONFIDENCE, _LEAST_SECOND = 0.5, 0.01  # of the best and of the second bin (`trainedOrientation.m`)
_MEAN_COSINE = 2 / np.pi  # mean of |cos| over all angles


@dataclass(frozen=True)
class CobBoundary(BoundaryModel, UsesFiles):
    """P(contour) of COB.

    Parameters
    ----------
    weights : str
        Path of a ``.caffemodel``.
    scale : {"fine", "coarse", "mean"}
        Which output is the boundary map.
    """

    weights: str = ""
    scale: Literal["fine", "coarse", "mean"] = "fine"

    @property
    def bound_key(self) -> bytes:
        """Hash of the file of weights; empty without a file."""
        return weights_file(self.weights, *_SOURCE)[1].encode() if Path(self.weights).is_file() else b""

    def check_files(self, recording: Recording) -> None:
        """Load the weights."""
        self._network()

    def boundary(self, frame: Frame) -> np.ndarray:
        """(H, W) float32. Raises InputError if the weights are missing or of another network."""
        found = self.contours(frame)
        return {"fine": found[0], "coarse": found[1], "mean": (found[0] + found[1]) / 2}[self.scale]

    def contours(self, frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """P(contour) at the fine and at the coarse scale, and the angle of its normal, all (H, W) float32.

        The angle is in radians from x (right) to y (down), 0 to pi; NaN where no orientation is confident.
        """
        return memo("cob", (frame.key, self.bound_key), lambda: self._run(frame), shared=True)

    def _run(self, frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        network = self._network()
        import torch
        from torch.nn import functional

        data, size = load_file(_HERE / "cob_network.py").cob_input(frame.rgb), frame.depth.shape
        with torch.inference_mode():
            if size[0] * size[1] > _MAX_PIXELS:
                data = functional.interpolate(data[None], (500, 500), mode="bicubic", antialias=True)[0]
            found = torch.cat([part.reshape(-1, *data.shape[1:]) for part in network(data)])
            if found.shape[1:] != size:
                found = functional.interpolate(found[None], size, mode="nearest-exact")[0]
        maps = found.numpy()
        return maps[0], maps[1], decode_orientation(maps[2:])

    def _network(self) -> Any:
        path, digest = weights_file(self.weights, *_SOURCE)
        return _load(digest, path)


@lru_cache(maxsize=1)
def _load(digest: str, path: str) -> Any:
    """The network with the weights of a file; the last one is kept."""
    network = load_file(_HERE / "cob_network.py").CobNetwork()
    with naming(path):
        network.load_caffe(load_file(_HERE / "caffe.py").read_caffemodel(path))
    return network.eval()


def decode_orientation(confidence: np.ndarray) -> np.ndarray:
    """Angles (H, W) float32 of the normal, 0 to pi, from the confidence (8, H, W) of the bins k pi / 8.

    If the second best bin is a neighbour of the best one, the mean of both, weighted by confidence; else the best.
    NaN where the best confidence is below 0.5. (The authors draw a random angle there.)
    """
    n = len(confidence)
    order = np.argsort(-confidence, axis=0, kind="stable")[:2]
    best, second = np.take_along_axis(confidence, order, axis=0)
    first, other = order.astype(np.float64)
    # Bin 0 is also pi: next to the last bin it counts as n.
    first, other = (
        np.where((first == 0) & (other == n - 1), n, first),
        np.where((other == 0) & (first == n - 1), n, other),
    )
    near = (np.abs(first - other) == 1) & (second >= _LEAST_SECOND)
    mean = (best * first + second * other) / np.maximum(best + second, 1e-12)
    angle = np.where(near, mean, first) * np.pi / n
    return np.where(best >= _LEAST_CONFIDENCE, angle, np.nan).astype(np.float32)


@dataclass(frozen=True)
class CobTree(TreeBuilder):
    """COB's tree: oriented watershed and mean contour strength at two scales, combined.

    The boundary map that it is given is not used. The strength of a border between two watershed regions is the mean
    of P(contour) times the absolute cosine of the angle between the normal of the contour and that of the border,
    which consists of line segments. The coarse hierarchy is projected onto the regions of the fine one at height
    `align`; both are averaged and merged again; a logistic curve maps the height of a merge to P(boundary).

    Parameters
    ----------
    contours : CobBoundary
        The network.
    align, centre, slope : float
        0.05, 0.8 and 4 in the authors' program.
    tolerance : float
        Largest distance in pixels of a border from the line segments that approximate it (our choice).
    max_leaves : int
        Largest number of leaves.
    """

    contours: CobBoundary = field(default_factory=CobBoundary)
    align: NonNegativeFloat = 0.05
    centre: float = 0.8
    slope: float = 4.0
    tolerance: float = 1.5
    max_leaves: PositiveInt = 501

    def build(self, boundary: np.ndarray, frame: Frame | None = None, pixels: np.ndarray | None = None) -> Tree:
        """The tree of a frame; raises InputError without a frame or weights."""
        if frame is None:
            raise InputError("CobTree needs the frame of the boundary map", "tree.build(boundary, frame)")
        fine, coarse, angle = self.contours.contours(frame)
        parent, height, leaves = combine_scales(fine, coarse, angle, self.align, self.tolerance)
        parent, height, leaves = prune(parent, height, leaves, self.max_leaves)
        start = 1 / (1 + np.exp(-self.slope * (height - self.centre)))
        start[: int(leaves.max()) + 1] = 0
        return Tree(parent, leaves, start)


def combine_scales(
    fine: np.ndarray, coarse: np.ndarray, angle: np.ndarray, align: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The combined hierarchy of two contour maps (H, W): parents (N,), heights (N,), leaf image (H, W)."""
    import higra as hg

    shape = fine.shape
    graph = hg.get_4_adjacency_graph(shape)

    def hierarchy(contours: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray] | None:
        weights = hg.weight_graph(graph, contours.astype(np.float64), hg.WeightFunction.mean)
        return linkage_tree(
            graph, weights, shape, lambda arcs: oriented_strength(graph.edge_list(), arcs, contours, angle, tolerance)
        )

    first, second = hierarchy(fine), hierarchy(coarse)
    combined = None
    if first is not None and second is not None:
        tree, height, leaves = first
        regions = hg.labelisation_horizontal_cut_from_threshold(tree, height, align)[leaves]
        aligned = hg.align_hierarchies(graph, regions.ravel(), [second[:2]])[0]
        combined = linkage_tree(graph, (hg.saliency(tree, height) + aligned) / 2, shape)
    if combined is None:
        return np.array([0]), np.zeros(1), np.zeros(shape, np.int64)
    tree, height, leaves = combined
    return np.array(tree.parents(), dtype=np.int64), height, leaves


def oriented_strength(
    edges: tuple[np.ndarray, np.ndarray],
    arcs: np.ndarray,
    contours: np.ndarray,
    angle: np.ndarray,
    tolerance: float,
) -> np.ndarray:
    """Mean strength (n_arcs,) of the arcs between watershed regions.

    `edges` are the two flat pixels (E,) of every pair of neighbours, and `arcs` (E,) the arc that separates them, -1
    within a region.
    """
    kept = np.flatnonzero(arcs >= 0)
    first, second, arc = np.asarray(edges[0])[kept], np.asarray(edges[1])[kept], arcs[kept]
    width = contours.shape[1]
    rows, columns = second // width, second % width
    # The side of a pixel between two neighbours, from one corner of the pixel grid (row, column) to the other.
    across = first // width == rows
    begin = np.stack([rows, columns], axis=1)
    end = begin + np.where(across[:, None], [1, 0], [0, 1])
    normal = _normals(begin, end, arc, tolerance)
    strength = np.zeros(len(kept))
    for pixel in (first, second):
        factor = np.abs(np.cos(angle.ravel()[pixel] - normal))
        strength += contours.ravel()[pixel] * np.where(np.isnan(factor), _MEAN_COSINE, factor) / 2
    return np.bincount(arc, weights=strength) / np.bincount(arc)


def _normals(begin: np.ndarray, end: np.ndarray, arc: np.ndarray, tolerance: float) -> np.ndarray:
    """Angle (E,) of the normal of the line segment that approximates the arc at each of its pixel sides."""
    normal = np.zeros(len(arc))
    order = np.argsort(arc, kind="stable")
    begins, ends = list(map(tuple, begin[order].tolist())), list(map(tuple, end[order].tolist()))
    bounds = np.flatnonzero(np.diff(arc[order], prepend=-1, append=arc.max() + 1))
    for low, high in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        for path, sides in _chains(begins[low:high], ends[low:high]):
            points = np.array(path, dtype=np.float64)
            for a, b in _segments(points, tolerance):
                rows, columns = points[b] - points[a]
                normal[order[low + np.array(sides[a:b])]] = np.arctan2(rows, columns) + np.pi / 2
    return normal


_Corner = tuple[int, int]


def _chains(begins: list[_Corner], ends: list[_Corner]) -> list[tuple[list[_Corner], list[int]]]:
    """Chains of the sides of one arc: corners in order, and the sides between them."""
    at: dict[_Corner, list[int]] = {}
    for side, corners in enumerate(zip(begins, ends, strict=True)):
        for corner in corners:
            at.setdefault(corner, []).append(side)
    chains: list[tuple[list[_Corner], list[int]]] = []
    used = [False] * len(begins)
    # Open chains start where they end or branch; what is left then are loops.
    for start in [corner for corner, sides in at.items() if len(sides) != 2] + begins:
        for first in at[start]:
            if used[first]:
                continue
            path, sides, side, corner = [start], [], first, start
            while True:
                used[side] = True
                corner = ends[side] if begins[side] == corner else begins[side]
                path.append(corner)
                sides.append(side)
                following = [k for k in at[corner] if not used[k]]
                if len(at[corner]) != 2 or not following:
                    break
                side = following[0]
            chains.append((path, sides))
    return chains


def _segments(points: np.ndarray, tolerance: float) -> list[tuple[int, int]]:
    """Index pairs of line segments that approximate a chain of points (n, 2) (Douglas and Peucker 1973)."""
    found, stack = [], [(0, len(points) - 1)]
    while stack:
        a, b = stack.pop()
        direction = points[b] - points[a]
        inner = points[a + 1 : b] - points[a]
        length = np.hypot(*direction)
        if len(inner) == 0:
            found.append((a, b))
            continue
        if length > 0:
            distance = np.abs(inner[:, 0] * direction[1] - inner[:, 1] * direction[0]) / length
        else:
            distance = np.hypot(inner[:, 0], inner[:, 1])  # a loop
        farthest = int(distance.argmax())
        if distance[farthest] <= tolerance and length > 0:
            found.append((a, b))
        else:
            stack += [(a, a + 1 + farthest), (a + 1 + farthest, b)]
    return found
