"""From a cut to objects: which regions are objects at all, and what pixels are theirs.

>>> rule = ObjectRule()
>>> labels = rule.label_image(tree, cut, frame)      # (H, W): 0 background, k + 1 for the k-th node of the cut
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.scene import Frame, VoxelGrid
from mstfilter.segmentation.background import above_table
from mstfilter.segmentation.tree import Tree

__all__ = ["ObjectRule", "Segments"]


@dataclass(frozen=True, eq=False)
class Segments:
    """What every node of a tree shows.

    Parameters
    ----------
    own : (H, W) bool
        Pixels that can belong to an object: a depth reading, not the robot, above the table, in the workspace.
    readings : (N,) int
        Depth readings of each node.
    points : (N,) int
        Pixels of `own` in each node.
    core : (N,) int
        Pixels of each node whose whole neighbourhood belongs to it and to `own`.
    is_object : (N,) bool
        Whether the node, if a cut holds it, is an object.
    """

    own: np.ndarray
    readings: np.ndarray
    points: np.ndarray
    core: np.ndarray
    is_object: np.ndarray


@dataclass(frozen=True)
class ObjectRule:
    """Which regions are objects.

    A region is background if most of its readings lie on or behind the table or outside the workspace, or if
    too few are left to make an object of.

    Parameters
    ----------
    table_tolerance : float
        Readings up to this much above the table are table, in sensor disparity units (1/8 px at f = 525 px;
        one is 3.2 mm of depth at 1 m).
    object_share : float
        Smallest share of a region's readings that must lie above the table and in the workspace.
    min_points : int
        Smallest number of such readings, in pixels of a 640 x 480 image; scales with the image's area.
    min_core : int
        Smallest number of pixels that survive an erosion by `core_radius`, in pixels of a 640 x 480 image: slivers
        along the borders of objects have none (the authors erode by 5 x 5 and want more than 25 points).
    core_radius : int
        Radius of that erosion in pixels of a 640 px wide image.
    min_readings : float
        Smallest share of a region's pixels with a depth reading (the authors' 0.004).
    """

    table_tolerance: float = 2.0
    object_share: float = 0.5
    min_points: int = 60
    min_core: int = 25
    core_radius: int = 2
    min_readings: float = 0.004

    def own(self, frame: Frame, grid: VoxelGrid | None = None) -> np.ndarray:
        """(H, W) bool: pixels that can belong to an object, as `Segments.own`."""
        with np.errstate(invalid="ignore"):
            own = frame.valid & (above_table(frame) > self.table_tolerance)
        if grid is not None:
            own &= grid.contains(grid.index_of(frame.points))
        return own

    def segments(self, tree: Tree, frame: Frame, grid: VoxelGrid | None = None) -> Segments:
        """Judge every node of a tree. Without a grid the workspace is everything above the table."""
        own = self.own(frame, grid)
        readings = tree.accumulate_pixels(frame.valid)
        points = tree.accumulate_pixels(own)
        core = _core(tree, own, max(1, round(self.core_radius * frame.camera.width / 640)))
        resize = own.size / 307200
        is_object = (
            (points >= max(1.0, self.min_points * resize))
            & (core >= self.min_core * resize)
            & (points >= self.object_share * readings)
            & (readings >= self.min_readings * tree.area)
        )
        return Segments(own, readings, points, core, is_object)

    def label_image(self, tree: Tree, cut: np.ndarray, frame: Frame, grid: VoxelGrid | None = None) -> np.ndarray:
        """(H, W) int32 segments of a cut: 0 is background, k + 1 the k-th node of the cut."""
        found = self.segments(tree, frame, grid)
        cut = np.asarray(cut)
        numbers = np.where(found.is_object[cut], np.arange(1, len(cut) + 1), 0)
        return np.where(found.own, numbers[tree.label_image(cut)], 0).astype(np.int32)


def _core(tree: Tree, own: np.ndarray, radius: int) -> np.ndarray:
    """(N,) for each node, the pixels whose square neighbourhood lies in the node and in `own`.

    A neighbourhood lies in exactly the ancestors of the lowest node that holds all of it, so one pass over the
    pixels serves all nodes. In depth-first order of the leaves that lowest node is the one that spans the first
    and the last leaf of the neighbourhood.
    """
    import cv2

    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    # Single missing readings inside an object are no border.
    closed = cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    inside = (cv2.erode(closed, square, borderValue=0) > 0) & own
    place = tree.leaf_place[tree.leaves].astype(np.float32)
    first = cv2.erode(place, square)[inside].astype(np.int64)
    last = cv2.dilate(place, square)[inside].astype(np.int64)
    pairs, counts = np.unique(first * tree.n_leaves + last, return_counts=True)
    lowest = tree.lowest_common(pairs // tree.n_leaves, pairs % tree.n_leaves)
    total = np.bincount(lowest, weights=counts, minlength=tree.n_nodes).astype(np.int64).tolist()
    parent = tree.parent.tolist()
    for node in range(tree.n_nodes - 1):
        total[parent[node]] += total[node]
    return np.array(total)
