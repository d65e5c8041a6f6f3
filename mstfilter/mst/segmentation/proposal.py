"""Hypotheses from one image: cuts of a segmentation tree, completed to 3-D (paper IV-B).

>>> proposal = TreeCutProposal()
>>> population = proposal.sample(np.random.default_rng(0), clip, 10)
>>> population.particles[0].n_objects, population.notes["distinct_segments"]

All samples share one boundary map and one tree, and a segment that occurs in several cuts is completed only once. If
several shapes contain a voxel, it is given to one of the objects.

An `ObjectRule` decides which regions of a cut are objects:

>>> labels = ObjectRule().label_image(tree, cut, frame)      # (H, W): 0 background, k + 1 for node k of the cut
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import cv2
import numpy as np

from mstfilter.base.fields import Share
from mstfilter.mst.completion import Completer, Completion, Extrude, arbitrate, occupancy_of
from mstfilter.mst.segmentation.boundary import BoundaryModel, ClipBoundary, ColourDepthBoundary
from mstfilter.mst.segmentation.cuts import CutSampler, CutValue, MergeLogOdds, optimal_cut
from mstfilter.mst.segmentation.learned_tree import LearnedTree
from mstfilter.mst.segmentation.mh import MetropolisHastingsCuts
from mstfilter.mst.segmentation.tree import Tree, TreeBuilder
from mstfilter.scene import (
    Clip,
    Foreground,
    Frame,
    Hypothesis,
    ObjectRecord,
    VoxelGrid,
    component_key,
    foreground,
    memo,
    readings_above_table,
    scaled_area,
    scaled_length,
)
from mstfilter.smc import Population, Proposal, child

# Limits of `ObjectRule`; pixels are those of a 640 x 480 image.
_MIN_RAISED = 0.5  # fraction of a region's readings that are above the table and in the workspace
#: Pixels that remain after an erosion by `_CORE_RADIUS` pixels. Removes slivers along the borders of objects (the
#: authors erode by 5 x 5 and require more than 25 points).
_MIN_CORE = 25
_CORE_RADIUS = 2
_MIN_READINGS = 0.004  # fraction of a region's pixels with a depth reading (the authors' value)


@dataclass(frozen=True, eq=False)
class Segments:
    """Object pixels of an image, and the nodes of its tree that are objects."""

    object_pixels: np.ndarray  #: (H, W) bool, pixels that can belong to an object
    is_object: np.ndarray  #: (N,) bool, whether the node is an object if it is part of a cut


@dataclass(frozen=True)
class ObjectRule:
    """Decides which regions are objects.

    A region is background if most of its depth readings are on the table, behind it or outside the workspace, or if
    fewer than `min_points` of them are above the table and in the workspace.

    Parameters
    ----------
    min_points : int
        Smallest number of depth readings of an object in an image of 640 x 480 pixels. It is scaled by the area of
        the image.
    mend : bool
        Whether noise is removed and missing readings of objects are estimated (`mstfilter.scene.foreground`). If
        False, every reading above the table can belong to an object, as published.
    """

    min_points: int = 60
    mend: bool = True

    def foreground(self, frame: Frame, grid: VoxelGrid | None = None) -> Foreground:
        """The pixels that can belong to an object, and the frame with measured or estimated depth."""
        return foreground(frame, grid) if self.mend else Foreground(readings_above_table(frame, grid), frame)

    def segments(self, tree: Tree, frame: Frame, grid: VoxelGrid | None = None) -> Segments:
        """Test which nodes of a tree are objects. Without a grid, the workspace is all space above the table."""
        found = self.foreground(frame, grid)
        pixels, frame = found.pixels, found.frame
        readings = tree.accumulate_pixels(frame.valid)
        points = tree.accumulate_pixels(pixels)
        core = _core(tree, pixels, max(1, round(scaled_length(_CORE_RADIUS, frame.camera.width))))
        is_object = (
            (points >= max(1.0, scaled_area(self.min_points, pixels.size)))
            & (core >= scaled_area(_MIN_CORE, pixels.size))
            & (points >= _MIN_RAISED * readings)
            & (readings >= _MIN_READINGS * tree.area)
        )
        return Segments(pixels, is_object)

    def cached_segments(self, tree: Tree, frame: Frame, grid: VoxelGrid) -> Segments:
        """The result of `segments`, which is computed once for a tree, a frame and a workspace."""
        key = (frame.key, grid.key, tree.key, component_key(self))
        return memo("segments", key, lambda: self.segments(tree, frame, grid))

    def label_image(self, tree: Tree, cut: np.ndarray, frame: Frame, grid: VoxelGrid | None = None) -> np.ndarray:
        """(H, W) int32 label image of a cut: 0 is background, and k + 1 is the k-th node of the cut."""
        segments = self.segments(tree, frame, grid)
        cut = np.asarray(cut)
        numbers = np.where(segments.is_object[cut], np.arange(1, len(cut) + 1), 0)
        return np.where(segments.object_pixels, numbers[tree.label_image(cut)], 0).astype(np.int32)


def _core(tree: Tree, pixels: np.ndarray, radius: int) -> np.ndarray:
    """For each node, number (N,) of pixels with a square neighbourhood inside the node and inside `pixels`.

    A neighbourhood lies in the lowest node that contains all its leaves, and in the ancestors of this node, so one
    pass over the pixels is sufficient. The lowest node is found from the first and the last leaf of the neighbourhood
    in depth-first order.
    """
    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    # First fill single missing readings inside an object.
    closed = cv2.morphologyEx(pixels.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    inside = (cv2.erode(closed, square, borderValue=0) > 0) & pixels
    position = tree.leaf_position[tree.leaves].astype(np.float32)
    first = cv2.erode(position, square)[inside].astype(np.int64)
    last = cv2.dilate(position, square)[inside].astype(np.int64)
    pairs, counts = np.unique(first * tree.n_leaves + last, return_counts=True)
    lowest = tree.lowest_common(pairs // tree.n_leaves, pairs % tree.n_leaves)
    return tree.accumulate_nodes(np.bincount(lowest, weights=counts, minlength=tree.n_nodes).astype(np.int64))


@dataclass(frozen=True)
class TreeCutProposal(Proposal):
    """Hypotheses from cuts of the segmentation tree of the clip's last frame.

    Parameters
    ----------
    sampler : CutSampler
        Draws the cuts. It needs a `temperature` for log odds, or `sigma2` for `SceneCutObjectness`.
    objects : ObjectRule
        Decides which regions of a cut are objects.
    weight_rule : {"equal", "p"}
        With "equal", all weights are equal, which is correct for cuts drawn from p. With "p", as in the paper and the
        authors' program, the log weight is ``log p(c) - log p(c*)``, so the probability of a cut counts twice.
    threshold : float
        Voxels with at least this probability are occupied.
    """

    boundary: BoundaryModel = field(default_factory=ColourDepthBoundary)
    tree: TreeBuilder = field(default_factory=LearnedTree)
    value: CutValue = field(default_factory=MergeLogOdds)
    sampler: CutSampler = field(default_factory=lambda: MetropolisHastingsCuts(temperature=1.0))
    objects: ObjectRule = field(default_factory=ObjectRule)
    completer: Completer = field(default_factory=Extrude)
    weight_rule: Literal["equal", "p"] = "equal"
    threshold: Share = 0.45

    properly_weighted: ClassVar[bool] = False

    def tree_of(self, frame: Frame, grid: VoxelGrid | None = None) -> tuple[Tree, np.ndarray]:
        """The tree of a frame in a workspace, and the node values (N,) of the tree. The result is cached."""

        def compute() -> tuple[Tree, np.ndarray]:
            found = self.objects.foreground(frame, grid)
            tree = self.tree.build(self.boundary.boundary(found.frame), found.frame, found.pixels)
            return tree, self.value.values(tree, found.frame)

        parts = component_key((self.boundary, self.tree, self.value, self.objects))
        key = (frame.key, None if grid is None else grid.key, parts)
        return memo("segmentation_tree", key, compute, shared=True)

    def of_clip(self, clip: Clip) -> TreeCutProposal:
        """The same proposal with the boundary model for a clip, if the model depends on the clip."""
        return replace(self, boundary=self.boundary.at(clip)) if isinstance(self.boundary, ClipBoundary) else self

    def label_image(self, frame: Frame, grid: VoxelGrid | None = None, cut: np.ndarray | None = None) -> np.ndarray:
        """(H, W) int32 label image of a cut (default: optimal). 0 is background, and k + 1 is the k-th node."""
        tree, w = self.tree_of(frame, grid)
        return self.objects.label_image(tree, optimal_cut(tree, w) if cut is None else cut, frame, grid)

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        frame, grid = observation.after, observation.grid
        tree, w = self.of_clip(observation).tree_of(frame, grid)
        drawn = self.sampler.sample(rng, tree, w, n)
        segments = self.objects.cached_segments(tree, frame, grid)
        particles, counts = complete_segments(
            rng,
            Clip((self.objects.foreground(frame, grid).frame,), grid, observation.index),
            [cut[segments.is_object[cut]] for cut in drawn.cuts],
            lambda node: tree.mask(node) & segments.object_pixels,
            self.completer,
            self.threshold,
        )
        notes = {
            "sampler": drawn.diagnostics,
            "tree_nodes": tree.n_nodes,
            "cut_sizes": [len(cut) for cut in drawn.cuts],
            **counts,
        }
        log_weights = drawn.log_p if self.weight_rule == "p" else np.zeros(n)
        return Population(particles, log_weights, notes=notes)


def complete_segments(
    rng: np.random.Generator,
    clip: Clip,
    samples: Sequence[np.ndarray],
    mask_of: Callable[[int], np.ndarray],
    completer: Completer,
    threshold: float = 0.5,
) -> tuple[tuple[Hypothesis, ...], dict[str, Any]]:
    """Hypotheses from sampled segmentations of the last frame of a clip, and counts of objects and segments.

    Each sample is an int64 array of segments, of which ``mask_of(segment)`` returns the masks (H, W) bool. Each
    distinct segment is completed to a 3-D shape once, with the random stream ``"completion", segment``, whatever the
    other segments are. If the completer is stochastic, each further sample k of a segment gets a new shape, with the
    random stream ``"completion", segment, k``.
    """
    completer = completer.at(clip)
    times: Counter[int] = Counter()
    keys: list[tuple[tuple[int, ...], ...]] = []
    for segments in samples:
        keys.append(tuple((s, times[s]) if times[s] else (s,) for s in segments.tolist()))
        times.update(segments.tolist() if completer.stochastic else ())
    draws = list(dict.fromkeys(draw for key in keys for draw in key))
    masks = {segment: mask_of(segment) for segment in dict.fromkeys(draw[0] for draw in draws)}
    streams = [child(rng, "completion", *draw) for draw in draws]
    found = completer.complete_each(streams, clip.after, [masks[draw[0]] for draw in draws], clip.grid)
    completed = dict(zip(draws, found, strict=True))
    built = {
        key: hypothesis_of([completed[draw] for draw in key], clip.grid, clip.index, threshold)
        for key in dict.fromkeys(keys)
    }
    particles = tuple(built[key] for key in keys)
    counts = {
        "objects": [h.n_objects for h in particles],
        "distinct_segments": len(masks),
        "distinct_hypotheses": len(built),
    }
    return particles, counts


def hypothesis_of(
    completions: Sequence[Completion], grid: VoxelGrid, birth: int = 0, threshold: float = 0.5
) -> Hypothesis:
    """One hypothesis from the 3-D shapes of the segments of a frame, at the pause `birth`.

    Segments get the labels 1, 2, ... in order, but one without voxels gets no `ObjectRecord`. Voxels with probability
    `threshold` or more are occupied, and those in several shapes are assigned by
    `mstfilter.mst.completion.arbitrate`.
    """
    labels = arbitrate(completions, grid, threshold)
    present = np.bincount(labels.ravel(), minlength=len(completions) + 1)
    records = tuple(ObjectRecord.born(k, birth, one.key) for k, one in enumerate(completions, start=1) if present[k])
    return Hypothesis(labels, grid, records, occupancy_of(completions, labels, grid))
