"""Hypotheses from instance masks: those of a segmenter of your own, or those in a folder.

A segmenter is a class with one method, for example around a network. Each label image is one possible segmentation:

>>> class Mine(Segmenter):
...     def segment(self, frame: Frame) -> list[np.ndarray]:
...         return [my_network(frame.rgb)]
>>> filter = replace(mstfilter.preset("mst"), proposal=Mine())     # or preset("mst", "proposal=./mine.py:Mine")

Masks that another program has written are read from a folder (`mstfilter.mst.frontends.mask_files`):

>>> filter = mstfilter.preset("mst", "proposal=mask_folder", "proposal.folder=masks")

For each sample, an alternative segmentation of the image is drawn by weight, and then a cut of the tree of its masks.
Each distinct mask is extended to a 3-D volume once.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from mstfilter.base.errors import warn_user
from mstfilter.base.fields import Share
from mstfilter.mst.completion import Completer, Extrude
from mstfilter.mst.frontends.mask_files import PauseMasks, alternatives_of, has_masks, read_masks, write_masks
from mstfilter.mst.frontends.mask_trees import nested_masks, node_values
from mstfilter.mst.segmentation import CutSampler, ExactCuts, ObjectRule, complete_segments
from mstfilter.scene import Clip, Frame, Recording, UsesFiles, content_key
from mstfilter.smc import Population, Proposal, child


class _OfMasks(Proposal):
    """Draws hypotheses from the alternatives of an image."""

    sampler: CutSampler
    objects: ObjectRule
    completer: Completer
    threshold: float

    properly_weighted: ClassVar[bool] = False

    @abstractmethod
    def _masks(self, clip: Clip) -> PauseMasks:
        """The alternatives of the last image of a clip."""

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        """Sample `n` hypotheses for the scene at the end of the clip, with equal weights."""
        frame, grid = observation.after, observation.grid
        masks = self._masks(observation)
        chosen: list[list[int]] = [[] for _ in range(n)]
        pixels: dict[int, np.ndarray] = {}
        whole = _number(b"")  # names the random streams of the whole image
        drawn = child(rng, "region", whole).choice(len(masks.weights), n, p=masks.weights)
        for k in np.unique(drawn).tolist():
            tree, rows = masks.trees[k], np.flatnonzero(drawn == k)
            found = self.objects.cached_segments(tree, frame, grid)
            # Background masks (such as the table) that contain other masks have the stop probability 0.
            inner = np.arange(tree.n_nodes) >= tree.n_leaves
            w = node_values(tree, np.where(inner & ~found.is_object, 0.0, masks.stops[k]))
            cuts = self.sampler.sample(child(rng, "cuts", whole, k), tree, w, len(rows)).cuts
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
        mended = Clip((self.objects.foreground(frame, grid).frame,), grid, observation.index)
        particles, counts = complete_segments(
            rng, mended, samples, pixels.__getitem__, self.completer, self.threshold
        )
        alternatives = np.bincount(drawn, minlength=len(masks.weights)).tolist()
        notes = {"masks": masks.key.hex(), "alternatives": alternatives, **counts}
        return Population(particles, notes=notes)


@dataclass(frozen=True)
class Segmenter(_OfMasks):
    """Hypotheses from a segmentation of the image in Python: inherit it, and define `segment`.

    Its fields are those of `MaskProposal`, without the folder.
    """

    sampler: CutSampler = field(default_factory=lambda: ExactCuts(temperature=1.0))
    objects: ObjectRule = field(default_factory=ObjectRule)
    completer: Completer = field(default_factory=Extrude)
    threshold: Share = 0.45

    @abstractmethod
    def segment(self, frame: Frame) -> Sequence[np.ndarray | tuple[np.ndarray, Sequence[float] | np.ndarray]]:
        """Segmentations of an image, each an alternative; one is enough. Called once for each pause.

        An alternative is a label image (H, W) of integers, 0 where there is no object; or disjoint or nested masks
        (n, H, W) bool; or a pair of such an array and its scores. `frame` has `rgb` (H, W, 3), `depth` (H, W) in
        metres, NaN without a reading, and `camera`. Samples are drawn as `MaskProposal` draws them.
        """

    def _masks(self, clip: Clip) -> PauseMasks:
        return alternatives_of(self.segment(clip.after), clip.after.depth.shape)


@dataclass(frozen=True)
class MaskProposal(_OfMasks, UsesFiles):
    """Hypotheses from a folder of instance masks with alternative segmentations.

    Parameters
    ----------
    folder : str
        The folder of masks, of one recording.
    sampler : CutSampler
        Sampler of cuts of the tree of nested masks. At temperature 1, the cuts have the distribution that
        `mstfilter.mst.frontends.mask_trees` defines.
    objects : ObjectRule
        Decides which masks are objects. The others, such as that of the table, are background; one that contains
        further masks is always split into its parts.
    completer : Completer
    threshold : float
        Smallest probability of an occupied voxel.
    """

    folder: str = ""
    sampler: CutSampler = field(default_factory=lambda: ExactCuts(temperature=1.0))
    objects: ObjectRule = field(default_factory=ObjectRule)
    completer: Completer = field(default_factory=Extrude)
    threshold: Share = 0.45

    of_one_recording: ClassVar[bool] = True

    def check_files(self, recording: Recording) -> None:
        """Read the masks of all pauses."""
        for clip in recording.clips():
            read_masks(self.folder, clip.index, clip.after.depth.shape)
        n = len(recording.pauses)
        if has_masks(self.folder, n):
            text = f"folder {self.folder} has masks with numbers above {n - 1}, but {recording.name} has {n} pauses"
            warn_user(text, "masks are numbered by pause, from 0, and not by frame")

    def _masks(self, clip: Clip) -> PauseMasks:
        return read_masks(self.folder, clip.index, clip.after.depth.shape)


def _number(content: bytes) -> int:
    """A 62-bit number from a hash of a mask's content, which identifies the random streams of the mask."""
    return int.from_bytes(content_key(content)[:8], "big") >> 2


class MaskGenerator(Protocol):
    """Interface of `SamAutomaticMaskGenerator` (SAM) and `SAM2AutomaticMaskGenerator` (SAM 2)."""

    def generate(self, image: np.ndarray) -> list[dict[str, Any]]:
        """Masks of an image (H, W, 3) uint8 RGB: mappings with `segmentation` (H, W) bool and `predicted_iou`."""


def write_automatic_masks(folder: str, clips: Iterable[Clip], generator: MaskGenerator, share: float = 0.9) -> None:
    """Run a mask generator on the last frame of each clip, and write its masks into a folder.

    `nested_masks` makes the masks disjoint or nested, with the argument `share`.
    """
    for clip in clips:
        found = generator.generate(clip.after.rgb.copy())
        masks = np.array([one["segmentation"] for one in found], dtype=bool).reshape(-1, *clip.after.depth.shape)
        scores = np.clip([one.get("predicted_iou", 1.0) for one in found], 0, None)
        write_masks(folder, clip.index, [nested_masks(masks, scores, share)])
