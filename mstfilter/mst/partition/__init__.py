"""The default measurement update: `PartitionUpdate` partitions the image, and completes objects from all their views.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)     # candidates, with weights

=============  =========================================================================================
`update`       `PartitionUpdate`: weighted candidates, shapes completed from all views
`candidates`   descriptions of candidates with their probabilities, before anything is completed
`cells`        the common refinement of partitions, odds of pairs of cells, and probabilities of partitions
`association`  which segment of the image continues which predicted object
=============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"pairs": "PairOdds"}
__components__ = {"update": {"partition": "PartitionUpdate"}, "pairs": {"shares": "PairEvidence"}}
