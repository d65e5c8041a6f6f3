"""Scores of a weighted set of hypotheses against the ground truth.

*Quality* measures how good one hypothesis is (`quality`, `metrics`). The *recalibrated log loss* measures how
good the probabilities of the weighted set are (`questions`, `log_loss`).

>>> from mstfilter.scoring import ask, object_status, pause_metrics, score_belief
>>> truth, status = recording.truth(2), object_status(recording, 2)
>>> row, qualities = pause_metrics(labels, weights, truth)  # doctest: +SKIP
>>> belief = score_belief(ask(recording, 2), hypotheses, weights, truth)  # doctest: +SKIP
>>> row["quality"], belief.row["brier"]  # doctest: +SKIP
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
