"""Segmentations of one image, sampled: boundaries -> tree -> cuts -> hypotheses (paper, section IV-B).

>>> from mstfilter.mst.segmentation import ColourDepthBoundary, LearnedTree, MergeLogOdds, MetropolisHastingsCuts
>>> boundary = ColourDepthBoundary().boundary(frame)                                  # doctest: +SKIP
>>> tree = LearnedTree().build(boundary, frame)                                       # doctest: +SKIP
>>> w = MergeLogOdds().values(tree, frame)                                            # doctest: +SKIP
>>> cuts = MetropolisHastingsCuts(temperature=1).sample(rng, tree, w, 10).cuts        # doctest: +SKIP

A boundary map says where the image may be divided. Small regions between the boundaries are merged in pairs into a
tree, and each cut of the tree is a segmentation. Where the image is ambiguous, sampled cuts differ. `TreeCutProposal`
does all this and completes the segments to 3-D shapes.

================  ====================================================================
`boundary`        boundary maps from colour and depth
`tree`            the tree and its helpers; the ultrametric contour map
`regions`         measurements of regions and of their borders
`pair_measures`   measurements of pairs of regions
`learned_tree`    trees from learned log odds
`border_network`  the trained network that corrects these log odds
`hidden`          joins of segments on both sides of something nearer
`divisions`       ways to divide a region, which a tree of borders may not contain
`seam_measures`   what is measured of a division
`seam_network`    the judge: one object, or two that touch?
`seams`           the tree that contains both readings
`cuts`            node values, the optimal cut, exact samples
`mh`              Metropolis-Hastings samples
`proposal`        which regions are objects; the proposal of the filter
================  ====================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"boundary": "BoundaryModel", "tree": "TreeBuilder", "value": "CutValue", "sampler": "CutSampler"}
__components__ = {
    "proposal": {"tree_cuts": "TreeCutProposal"},
    "boundary": {"colour_depth": "ColourDepthBoundary"},
    "tree": {"learned": "LearnedTree", "ucm": "UcmTree", "border": "BorderTree", "seams": "SeamTree"},
    "value": {"scenecut": "SceneCutObjectness", "merge_log_odds": "MergeLogOdds"},
    "sampler": {"mh": "MetropolisHastingsCuts", "exact": "ExactCuts", "optimal": "OptimalCut"},
}
