"""The default measurement update: the image is partitioned, and objects are completed from all their views.

>>> update = PartitionUpdate(completer=NetworkCompleter())
>>> fused = update.update(rng, predicted, proposed, clip)     # candidates, with weights

============  ==========================================================================================
`update`      `PartitionUpdate`: partitions of the image are drawn, shapes completed from all views
`cells`       the common refinement of partitions, and draws of partitions by its pairs of cells
`division`    splits objects whose parts move apart in a clip
============  ==========================================================================================
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

__interfaces__ = {"pairs": "PairOdds", "division": "Division"}
__components__ = {
    "update": {"partition": "PartitionUpdate"},
    "pairs": {"shares": "PairEvidence"},
    "division": {"none": "NoDivision", "rigid_motions": "RigidMotions"},
}
