"""The published measurement update: every sample is crossed with every prediction (paper, section IV-D).

>>> fused = CrossoverUpdate().update(rng, predicted, proposed, clip)     # candidates, with weights

=============  =========================================================================================
`update`       `CrossoverUpdate`: all pairs, with weights; `Crossover`: makes one hypothesis from two
`conflicts`    the conflict graph of two hypotheses (networkx), painting orders, merge probabilities
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
