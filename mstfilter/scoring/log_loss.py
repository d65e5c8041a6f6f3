"""Scores of a weighted set of hypotheses, from the probabilities with which it answers the `questions`.

>>> belief = score_belief(ask(recording, t), hypotheses, weights, recording.truth(t))
>>> belief.row["brier"], belief.row["log_loss"]                # as the hypotheses come
>>> found = {scene: counts}                                    # counts: belief.counts, summed over pauses
>>> leave_one_out(found)["scene-3"].log_loss(found["scene-3"]) # recalibrated, in nats

**Log loss.** A proper score without recalibration rewards noise. Hypotheses that consist only of labels have no
uncertainty of shape, and noise at the borders makes wrong forecasts less certain. Forecasts are therefore
recalibrated by isotonic regression, fitted to other scenes. The score is the mean log loss in nats; lower is
better. Before recalibration, the score itself adds noise at the borders if noise lowers the loss on the other
scenes. So a method gains nothing by adding noise at the borders (docs/history.md has a study of all methods). The
score measures how well forecasts distinguish the answers yes and no. Noise of another kind, or noise at a higher
rate than the largest of `NOISE_RATES`, can still give a small gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.scene import Hypothesis, read_only
from mstfilter.scoring.forecasts import SOFTENING, ForecastTable, Recalibration
from mstfilter.scoring.questions import NOISE_RATES, Questions

LOG_LOSS = "recalibrated_log_loss"  # name of the score in tables
N_LEVELS = 1001  # forecasts are counted to a thousandth

#: No forecasts: numbers (1001, 2) of questions by forecast and outcome, no and yes.
NO_COUNTS = read_only(np.zeros((N_LEVELS, 2), np.int64))


class BeliefScore(NamedTuple):
    """Scores of the hypotheses at one pause.

    Parameters
    ----------
    row : dict
        ``brier``: mean squared error of the forecasts p. ``log_loss``: mean log loss of .98 p + .01, in nats.
        ``calibration_error``: calibration error on ten bins of equal numbers of questions.
    counts : (r, 1001, 2) int32
        Number of questions for each rate of noise, each forecast in thousandths, and each outcome.
    """

    row: dict[str, float]
    counts: np.ndarray

    @property
    def base_rate_loss(self) -> float:
        """Log loss, in nats, of a constant forecast that equals the share of questions with the answer yes."""
        table = forecast_table(self.counts[0].astype(np.int64))
        if not table.n:
            return float("nan")
        return table.with_forecasts(np.full(len(table.p), table.yes.sum() / table.n)).log_loss()


def check_normalised(weights: np.ndarray, n: int, where: str) -> None:
    """Raise InputError unless there are `n` > 0 weights that are not negative and have the sum 1."""
    w = np.asarray(weights, dtype=np.float64)
    if n == 0 or w.shape != (n,) or not (w >= 0).all() or not np.isclose(w.sum(), 1):
        raise InputError(f"{where}: {n} with the weights {w.tolist()}", "give one weight for each, with the sum 1")


def score_belief(
    questions: Questions, hypotheses: Sequence[np.ndarray | Hypothesis], weights: np.ndarray, truth: np.ndarray
) -> BeliefScore:
    """Score hypotheses by their answers to questions.

    Parameters
    ----------
    questions : Questions
    hypotheses : n hypotheses, or label grids (X, Y, Z) of int
    weights : (n,) float
        Sum 1.
    truth : (X, Y, Z) int
    """
    weights = np.asarray(weights, dtype=np.float64)
    check_normalised(weights, len(hypotheses), "hypotheses")
    if not len(questions):
        unknown = dict.fromkeys(("brier", "log_loss", "calibration_error"), float("nan"))
        return BeliefScore(unknown, np.zeros((len(NOISE_RATES), *NO_COUNTS.shape), np.int32))
    outcome = questions.outcomes(truth)
    forecasts = questions.forecasts(hypotheses, weights, NOISE_RATES)
    table = ForecastTable.of(np.round(forecasts[0], 12), outcome)  # weights sum to 1 up to rounding
    row = {
        "brier": table.brier,
        "log_loss": table.log_loss(SOFTENING),
        "calibration_error": table.reliability().error,
    }
    level = np.rint(forecasts * (N_LEVELS - 1)).astype(np.int64)
    code = (np.arange(len(level))[:, None] * N_LEVELS + level) * 2 + outcome
    counts = np.bincount(code.ravel(), minlength=len(level) * NO_COUNTS.size)
    return BeliefScore(row, counts.reshape(len(level), *NO_COUNTS.shape).astype(np.int32))


def forecast_table(counts: np.ndarray) -> ForecastTable:
    """The table of forecasts 0, .001, ... 1 from the number (1001, 2) of "no" and "yes" answers to each."""
    kept = counts.any(axis=1)
    no, yes = counts[kept].T.astype(float)
    return ForecastTable(np.flatnonzero(kept) / (N_LEVELS - 1), no, yes)


@dataclass(frozen=True, eq=False)
class FittedForecasts:
    """A fitted transformation of the forecasts of a method: noise at the borders of objects, and recalibration.

    Parameters
    ----------
    rate : float
        Rate of noise, one of `NOISE_RATES`.
    recalibration : Recalibration
    """

    rate: float
    recalibration: Recalibration

    @classmethod
    def fit(cls, counts: np.ndarray) -> FittedForecasts:
        """Fit the noise rate and the recalibration to counts (r, 1001, 2), by minimising the log loss."""
        tables = [forecast_table(one) for one in counts]
        fits = [Recalibration.fit(table) for table in tables]
        best = int(np.argmin([fit.log_loss(table) for fit, table in zip(fits, tables, strict=True)]))
        return cls(NOISE_RATES[best], fits[best])

    def log_loss(self, counts: np.ndarray) -> float:
        """Mean log loss in nats of the transformed forecasts of counts (r, 1001, 2); NaN without questions."""
        return self.recalibration.log_loss(forecast_table(counts[NOISE_RATES.index(self.rate)]))


def leave_one_out(counts: Mapping[Any, np.ndarray]) -> dict[Any, FittedForecasts]:
    """For each scene, the transformation fitted to all other scenes; `counts` maps scenes to counts (r, 1001, 2).

    A scene is omitted if the other scenes have no questions.
    """
    total = sum((one.astype(np.int64) for one in counts.values()), np.zeros(1, np.int64))
    return {scene: FittedForecasts.fit(rest) for scene, one in counts.items() if (rest := total - one).any()}
