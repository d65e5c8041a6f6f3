"""Scores of hypotheses against the ground truth.

>>> from mstfilter.scoring import object_status, weighted_coverage
>>> weighted_coverage(hypothesis.labels, recording.truth(2))  # doctest: +SKIP
>>> object_status(recording, 2)  # doctest: +SKIP
"""

from mstfilter.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
