"""Scores of weighted hypotheses against the truth, and paired differences between methods.

Two figures judge a filter. *Quality* says how good its segmentations are; the *recalibrated log loss* says how good
the probabilities are that its weighted set gives.

>>> from mstfilter.scoring import ask, object_status, pause_metrics, score_belief
>>> truth, status = recording.truth(2), object_status(recording, 2)
>>> row, qualities = pause_metrics(labels, weights, truth)  # doctest: +SKIP
>>> belief = score_belief(ask(recording, 2), hypotheses, weights, truth)  # doctest: +SKIP
>>> row["quality"], belief.row["brier"]  # doctest: +SKIP

============  =========================================================================================
`quality`     weighted coverage of two segmentations; visibility of objects
`metrics`     all figures of one pause
`questions`   "do these two voxels belong to one object?", fixed by the recording
`log_loss`    the log loss of the answers, recalibrated on other scenes
`forecasts`   Brier score, calibration and recalibration of any forecasts
`own`         metrics of your own, for studies
`pauses`      all pauses of a recording
`statistics`  paired differences: intervals, p values, conclusions
============  =========================================================================================
"""

from mstfilter.base.lazy import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
