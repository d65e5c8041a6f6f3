"""Hypotheses and boundary maps from instance masks of another program.

>>> filter = mstfilter.preset("mst_rules", "proposal=mask_folder", "proposal.folder=masks")
>>> MaskProposal("masks").sample(np.random.default_rng(0), clip, 10)

`mstfilter.frontends.mask_files` describes the folder. A sampled segmentation has one alternative of each region and a
cut of the tree of its masks. Alternatives are drawn by weight, independently for each region. Combinations are not
enumerated. Only drawn alternatives cost time, and each distinct mask is completed once.

The same masks can also be boundaries of a segmentation tree:

>>> overrides = "proposal.boundary=mask_folder", "proposal.boundary.folder=masks", "proposal.tree=ucm"
>>> filter = mstfilter.preset("mst", *overrides)
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Protocol

import numpy as np

from mstfilter.completion import Completer, Extrude
from mstfilter.errors import InputError
from mstfilter.fields import Share
from mstfilter.frontends.mask_files import MaskRegion, PauseMasks, read_masks, write_masks
from mstfilter.frontends.mask_trees import nested_masks, node_values
from mstfilter.scene import Clip, Frame, Recording, UsesFiles, component_key, content_key, memo
from mstfilter.segmentation import (
    BoundaryModel,
    ClipBoundary,
    CutSampler,
    ExactCuts,
    ObjectRule,
    Tree,
    complete_segments,
)
from mstfilter.smc import Population, Proposal, child


@dataclass(frozen=True)
class MaskProposal(Proposal, UsesFiles):
    """Hypotheses from a folder of instance masks with alternatives.

    Parameters
    ----------
    folder : str
        The folder of masks.
    sampler : CutSampler
        Draws the level of nested masks. At temperature 1 the sampler has the distribution of
        `mstfilter.frontends.mask_trees`.
    objects : ObjectRule
        Decides which masks are objects. Other masks, such as that of the table, are background. If background masks
        contain masks, their parts are always used.
    completer : Completer
    threshold : float
        Smallest probability of an occupied voxel.
    """

    folder: str = ""
    sampler: CutSampler = field(default_factory=lambda: ExactCuts(temperature=1.0))
    objects: ObjectRule = field(default_factory=ObjectRule)
    completer: Completer = field(default_factory=Extrude)
    threshold: float = 0.5

    properly_weighted: ClassVar[bool] = False

    def check_files(self, recording: Recording) -> None:
        """Read the masks of all pauses."""
        for clip in recording.clips():
            read_masks(self.folder, clip.index, clip.after.depth.shape, clip.after.rgb)

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        """`n` hypotheses about the scene at the end of the clip, with equal weights."""
        frame, grid = observation.after, observation.grid
        masks = read_masks(self.folder, observation.index, frame.depth.shape, frame.rgb)
        chosen: list[list[int]] = [[] for _ in range(n)]
        pixels: dict[int, np.ndarray] = {}
        alternatives = {}
        for region in masks.regions:
            drawn = child(rng, "region", _number(region.name.encode())).choice(
                len(region.weights), n, p=region.weights
            )
            alternatives[region.name] = np.bincount(drawn, minlength=len(region.weights)).tolist()
            for k in np.unique(drawn).tolist():
                tree = region.trees[k]
                rows = np.flatnonzero(drawn == k)
                stream = child(rng, "cuts", _number(region.name.encode()), k)
                found = memo(
                    "segments",
                    (frame.key, grid.key, tree.key, component_key(self.objects)),
                    partial(self.objects.segments, tree, frame, grid),
                )
                w = node_values(tree, _stops_at_objects(tree, region.stops[k], found.is_object))
                cuts = self.sampler.sample(stream, tree, w, len(rows)).cuts
                numbers: dict[int, int] = {}
                for row, cut in zip(rows.tolist(), cuts, strict=True):
                    for node in cut[found.is_object[cut] & (cut > 0)].tolist():  # leaf 0 is the rest of the image
                        if node not in numbers:
                            mask = tree.mask(node) & found.object_pixels
                            # Equal masks of several alternatives have the same number, and share the completion.
                            numbers[node] = _number(np.packbits(mask).tobytes())
                            pixels[numbers[node]] = mask
                        chosen[row].append(numbers[node])
        samples = [np.array(row, dtype=np.int64) for row in chosen]
        particles, counts = complete_segments(
            rng, observation, samples, pixels.__getitem__, self.completer, self.threshold
        )
        notes = {"masks": masks.key.hex(), "alternatives": alternatives, **counts}
        return Population(particles, notes=notes)


def _stops_at_objects(tree: Tree, stop: np.ndarray, is_object: np.ndarray) -> np.ndarray:
    """Probabilities (N,) to stop, which are 0 at masks that contain masks and are not objects, such as the table."""
    inner = np.arange(tree.n_nodes) >= tree.n_leaves
    return np.where(inner & ~is_object, 0.0, stop)


def _number(content: bytes) -> int:
    """A number of 62 bits that identifies a content in random streams."""
    return int.from_bytes(content_key(content)[:8], "big") >> 2


@dataclass(frozen=True)
class MaskBoundary(ClipBoundary, UsesFiles):
    """The probability that a segmentation drawn from a folder of masks has a border at a pixel.

    The distribution is that of `MaskProposal` with `ExactCuts` at temperature 1. The borders are borders of masks, so
    they do not have the statistics of image gradients. Combine the model with the tree ``ucm``. The weights of the
    tree ``learned`` were fitted to `ColourDepthBoundary`.

    Parameters
    ----------
    folder : str
        The folder of masks.
    weight : float
        Factor of the probability, 0 to 1.
    objects : ObjectRule
        Decides which masks are objects, as in `MaskProposal`.
    other : BoundaryModel, optional
        A second model. The result is the maximum of both models.
    """

    folder: str = ""
    weight: Share = 1.0
    objects: ObjectRule = field(default_factory=ObjectRule)
    other: BoundaryModel | None = None

    def check_files(self, recording: Recording) -> None:
        """Read the masks of all pauses."""
        MaskProposal(self.folder).check_files(recording)

    def at(self, clip: Clip) -> MaskBoundary:
        """The model with the masks of the pause at the end of the clip."""
        bound = copy.copy(self)
        masks = read_masks(self.folder, clip.index, clip.after.depth.shape, clip.after.rgb)
        other = self.other.at(clip) if isinstance(self.other, ClipBoundary) else self.other
        for name, value in (("_masks", masks), ("other", other)):
            object.__setattr__(bound, name, value)  # components are frozen
        return bound

    @property
    def bound_key(self) -> bytes:
        """Key of the masks; empty before `at`."""
        masks = self.__dict__.get("_masks")
        return b"" if masks is None else masks.key

    def boundary(self, frame: Frame) -> np.ndarray:
        """(H, W) float32; raises InputError before `at`."""
        masks: PauseMasks | None = self.__dict__.get("_masks")
        if masks is None:
            raise InputError("MaskBoundary does not know the pause of a frame", "call MaskBoundary.at(clip) first")
        edge = self.weight * border_probability(masks.regions, frame, self.objects)
        if self.other is not None:
            edge = np.maximum(edge, self.other.boundary(frame))
        return edge.astype(np.float32)


def border_probability(regions: Iterable[MaskRegion], frame: Frame, objects: ObjectRule) -> np.ndarray:
    """(H, W) largest probability of a border between a pixel and one of its four neighbours."""
    shape = frame.depth.shape
    joined = np.ones((shape[0], shape[1] - 1)), np.ones((shape[0] - 1, shape[1]))
    for region in regions:
        apart = np.zeros_like(joined[0]), np.zeros_like(joined[1])
        for weight, tree, stop in zip(region.weights, region.trees, region.stops, strict=True):
            stop = _stops_at_objects(tree, stop, objects.segments(tree, frame).is_object)
            below, position = _split_probability(tree, stop), tree.leaf_position[tree.leaves]
            for p, a, b in ((apart[0], position[:, :-1], position[:, 1:]), (apart[1], position[:-1], position[1:])):
                pairs = a != b
                low, high = np.minimum(a[pairs], b[pairs]), np.maximum(a[pairs], b[pairs])
                p[pairs] += weight * below[tree.lowest_common(low, high)]
        for total, p in zip(joined, apart, strict=True):
            total *= 1 - p
    out = np.zeros(shape)
    across, down = 1 - joined[0], 1 - joined[1]
    for part, p in ((out[:, 1:], across), (out[:, :-1], across), (out[1:], down), (out[:-1], down)):
        np.maximum(part, p, out=part)
    return out


def _split_probability(tree: Tree, stop: np.ndarray) -> np.ndarray:
    """(N,) probability that a walk continues below the node, if it stops with probabilities `stop` (N,)."""
    below = np.ones(tree.n_nodes)
    for node in range(tree.n_nodes - 1, -1, -1):
        above = 1.0 if node == tree.root else below[tree.parent[node]]
        below[node] = above * (1 - stop[node])
    return below


class MaskGenerator(Protocol):
    """A mask generator as in SAM (`SamAutomaticMaskGenerator`) and SAM 2 (`SAM2AutomaticMaskGenerator`)."""

    def generate(self, image: np.ndarray) -> list[dict[str, Any]]:
        """Masks of an image (H, W, 3) uint8 RGB; each has `segmentation` (H, W) bool and `predicted_iou`."""


def write_automatic_masks(folder: str, clips: Iterable[Clip], generator: MaskGenerator, share: float = 0.9) -> None:
    """Run a mask generator on the last frame of each clip, and write its masks as nested sets.

    `share` is the argument of `nested_masks`.
    """
    for clip in clips:
        found = generator.generate(clip.after.rgb.copy())
        masks = np.array([one["segmentation"] for one in found], dtype=bool).reshape(-1, *clip.after.depth.shape)
        scores = np.clip([one.get("predicted_iou", 1.0) for one in found], 0, None)
        write_masks(folder, clip.index, [nested_masks(masks, scores, share)], rgb=clip.after.rgb)
