"""The published measurement update: every sample is crossed with every prediction (paper, section IV-D).

>>> fused = CrossoverUpdate().update(rng, predicted, proposed, clip)     # candidates, with weights

A sample and a prediction share voxels where their objects overlap. The conflict graph has these overlaps as edges,
and along each edge two objects are merged, or one is painted over the other, at random.

=============  =========================================================================================
`update`       `CrossoverUpdate`: all pairs, with weights; `Crossover`: makes one hypothesis of two
`conflicts`    the conflict graph (networkx), painting orders, merge probabilities
`mode_filter`  `ModeFilter`: smooths the result
=============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"crossover": "Crossover", "structure": "Structure", "mode_filter": "ModeFilter"}
__components__ = {
    "update": {"crossover": "CrossoverUpdate"},
    "crossover": {"conflict_graph": "Crossover"},
    "structure": {"random_order": "RandomOrder", "spanning_tree": "SpanningTree"},
    "mode_filter": {"majority": "ModeFilter"},
}
