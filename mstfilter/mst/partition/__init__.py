"""The default measurement update: it partitions the image, and completes objects from all their views.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)     # candidates, with weights

Samples and predictions often disagree about which depth readings belong to one object. The update weighs what they
say and gives partitions of the readings their probabilities. Shapes come last, and only for what resampling selects.

=============  =========================================================================================
`update`       `PartitionUpdate`: the five steps, from free space to completed objects
`cells`        the common refinement of all partitions; how image and past are weighed (`PairEvidence`), and the
               probabilities of partitions that follow
`candidates`   choices of a prediction, a partition and the hidden objects that stay; products of probabilities
`motions`      which predicted objects have moved as one body
`association`  which segment of the image continues which predicted object
=============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"pairs": "PairOdds"}
__components__ = {"update": {"partition": "PartitionUpdate"}, "pairs": {"shares": "PairEvidence"}}
