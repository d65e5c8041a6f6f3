"""New hypotheses from one image: tree cuts, completed to 3-D (paper IV-B).

One boundary map and one tree a frame; each distinct segment of the sampled cuts is completed once; voxels that
several objects of a hypothesis claim are settled hypothesis by hypothesis.

>>> proposal = TreeCutProposal()
>>> population = proposal.sample(np.random.default_rng(0), clip, 10)
>>> population.particles[0].n_objects, population.notes["distinct_segments"]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mstfilter.completion import Completer, Completion, Extrude, arbitrate
from mstfilter.errors import InputError
from mstfilter.scene import Clip, Frame, Hypothesis, ObjectRecord, VoxelGrid, component_key, memo
from mstfilter.segmentation.boundary import ColourDepthBoundary
from mstfilter.segmentation.interfaces import BoundaryModel, CutSampler, CutValue, TreeBuilder
from mstfilter.segmentation.learned_tree import LearnedTree
from mstfilter.segmentation.mh import MetropolisHastingsCuts
from mstfilter.segmentation.optimal import optimal_cut
from mstfilter.segmentation.segments import ObjectRule, Segments
from mstfilter.segmentation.tree import Tree
from mstfilter.segmentation.value import MergeLogOdds
from mstfilter.smc import Population, Proposal, child

__all__ = ["TreeCutProposal", "hypothesis_of"]

WEIGHT_RULES = ("equal", "p")


@dataclass(frozen=True)
class TreeCutProposal(Proposal):
    """Hypotheses from cuts of the segmentation tree of the clip's last frame.

    Parameters
    ----------
    boundary : BoundaryModel
    tree : TreeBuilder
    value : CutValue
    sampler : CutSampler
        Its width must suit the value: a `temperature` for log odds, `sigma2` for `SceneCutObjectness`.
    objects : ObjectRule
        What of a cut is background.
    completer : Completer
    weight_rule : {"equal", "p"}
        "equal": draws from p carry p already. "p": log weight ``log p(c) - log p(c*)``, as the paper and the
        authors have it; the samples then count p twice.
    include_optimal : bool
        Put the optimal cut in place of the first sample.
    threshold : float
        Probability from which a completed voxel is occupied.
    """

    boundary: BoundaryModel = field(default_factory=ColourDepthBoundary)
    tree: TreeBuilder = field(default_factory=LearnedTree)
    value: CutValue = field(default_factory=MergeLogOdds)
    sampler: CutSampler = field(default_factory=lambda: MetropolisHastingsCuts(temperature=1.0))
    objects: ObjectRule = field(default_factory=ObjectRule)
    completer: Completer = field(default_factory=Extrude)
    weight_rule: str = "equal"
    include_optimal: bool = False
    threshold: float = 0.5

    properly_weighted: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.weight_rule not in WEIGHT_RULES:
            raise InputError(
                f"weight rule {self.weight_rule!r} is not known", f"there are: {', '.join(WEIGHT_RULES)}"
            )

    def tree_of(self, frame: Frame) -> tuple[Tree, np.ndarray]:
        """The tree of a frame and its node values (N,); computed once a frame."""

        def compute() -> tuple[Tree, np.ndarray]:
            tree = self.tree.build(self.boundary.boundary(frame), frame)
            return tree, self.value.values(tree, frame)

        return memo("segmentation_tree", (frame.key, component_key((self.boundary, self.tree, self.value))), compute)

    def label_image(self, frame: Frame, cut: np.ndarray | None = None) -> np.ndarray:
        """(H, W) int32 segments of a cut, 0 background, k + 1 its k-th node; the optimal cut by default."""
        tree, w = self.tree_of(frame)
        return self.objects.label_image(tree, optimal_cut(tree, w) if cut is None else cut, frame)

    def sample(self, rng: np.random.Generator, observation: Clip, n: int) -> Population:
        """Draw `n` hypotheses about the scene at the end of the clip."""
        frame, grid = observation.after, observation.grid
        tree, w = self.tree_of(frame)
        drawn = self.sampler.sample(rng, tree, w, n)
        cuts, log_p = list(drawn.cuts), drawn.log_p.copy()
        if self.include_optimal and n > 0:
            cuts[0], log_p[0] = optimal_cut(tree, w), 0.0
        found = memo(
            "segments",
            (frame.key, grid.key, tree.key, component_key(self.objects)),
            lambda: self.objects.segments(tree, frame, grid),
        )
        kept = [cut[found.is_object[cut]] for cut in cuts]
        completed = self._complete(rng, tree, found, frame, grid, kept)
        built: dict[bytes, Hypothesis] = {}
        for nodes in kept:
            if nodes.tobytes() not in built:
                chosen = [completed[node] for node in nodes.tolist()]
                built[nodes.tobytes()] = hypothesis_of(chosen, grid, observation.index, self.threshold)
        particles = tuple(built[nodes.tobytes()] for nodes in kept)
        notes = {
            "sampler": drawn.diagnostics,
            "tree_nodes": tree.n_nodes,
            "cut_sizes": [len(cut) for cut in cuts],
            "objects": [h.n_objects for h in particles],
            "distinct_segments": len(completed),
            "distinct_hypotheses": len(built),
        }
        log_weights = log_p if self.weight_rule == "p" else np.zeros(n)
        return Population(particles, log_weights, notes=notes)

    def _complete(
        self,
        rng: np.random.Generator,
        tree: Tree,
        found: Segments,
        frame: Frame,
        grid: VoxelGrid,
        kept: list[np.ndarray],
    ) -> dict[int, Completion]:
        """Completions of all nodes that occur, by node."""
        nodes = np.unique(np.concatenate([np.zeros(0, np.int64), *kept])).tolist()
        completed = {}
        for node in nodes:
            mask = tree.mask(node) & found.own
            # A stream of its own for each segment: which others were sampled changes nothing.
            stream = child(rng, "completion", node)
            completed[node] = self.completer.complete(stream, frame, [mask], grid)[0]
        return completed


def hypothesis_of(
    completions: Sequence[Completion], grid: VoxelGrid, birth: int = 0, threshold: float = 0.5
) -> Hypothesis:
    """Completed segments as one hypothesis: objects numbered 1 .. in order; those that fill no voxel get no record.

    Parameters
    ----------
    completions : sequence of Completion
        Of one frame; what several claim is settled by `mstfilter.completion.arbitration`.
    grid : VoxelGrid
    birth : int
        Index of the pause.
    threshold : float
        Probability from which a completed voxel is occupied.
    """
    labels = arbitrate(completions, grid, threshold)
    present = np.bincount(labels.ravel(), minlength=len(completions) + 1)
    records = tuple(ObjectRecord.born(k, birth, one.key) for k, one in enumerate(completions, start=1) if present[k])
    return Hypothesis(labels, grid, records)
