"""Forecasts of any event: Brier score, log loss, calibration, recalibration.

A forecast of an event is a probability p, and its outcome y is 0 or 1. Many forecasts are stored as a table, which
has the numbers of outcomes 0 and 1 for each value of p. Tables can be pooled.

>>> import numpy as np
>>> table = ForecastTable.of(p=[0.9, 0.9, 0.2, 0.2], y=[1, 1, 0, 1])
>>> round(table.brier, 4), round(table.log_loss(), 3)
(0.175, 0.511)
>>> fit = Recalibration.fit(table)                  # isotonic: how often the event occurs, given the forecast
>>> fit(np.array([0.2, 0.9])).tolist()
[0.5, 0.999]

A score is proper if the true probability has the lowest expected score. Brier score and log loss are proper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from mstfilter.base.errors import InputError

CLIP = 0.001  # recalibrated forecasts stay this far from 0 and 1
SOFTENING = 0.02  # e of p <- (1 - e) p + e / 2, so that a forecast of 0 or 1 has a finite log loss


@dataclass(frozen=True, eq=False)
class ForecastTable:
    """A table of the numbers of outcomes 0 and 1 of each distinct forecast.

    Parameters
    ----------
    p : (k,) float
        Distinct forecasts, ascending.
    no, yes : (k,) float
        Numbers of outcomes 0 and 1 of each forecast.
    """

    p: np.ndarray
    no: np.ndarray
    yes: np.ndarray

    @classmethod
    def of(cls, p: ArrayLike, y: ArrayLike, count: ArrayLike = 1.0) -> ForecastTable:
        """A table of forecasts p (m,) and outcomes or shares of outcome 1, y (m,), each counted `count` times."""
        p, y = np.asarray(p, dtype=np.float64), np.asarray(y, dtype=np.float64)
        if p.ndim != 1 or p.shape != y.shape:
            raise InputError(f"forecasts have shape {p.shape} and outcomes {y.shape}, expected (m,) twice")
        for name, values in (("forecast", p), ("outcome", y)):
            wrong = ~((values >= 0) & (values <= 1))
            if wrong.any():
                raise InputError(f"{name} {int(np.argmax(wrong))} is {values[wrong][0]}, expected a value in [0, 1]")
        count = np.broadcast_to(np.asarray(count, dtype=np.float64), p.shape)
        if not (np.isfinite(count) & (count >= 0)).all():
            raise InputError("counts of forecasts are negative, infinite or NaN")
        values, which = np.unique(p, return_inverse=True)
        yes, no = (np.bincount(which, count * share, len(values)) for share in (y, 1 - y))
        return cls(values, no.astype(np.float64), yes.astype(np.float64))  # of no forecasts, they are integers

    @classmethod
    def pooled(cls, tables: Sequence[ForecastTable]) -> ForecastTable:
        """A table in which the numbers of outcomes of several tables are summed."""
        every = cls(*(np.concatenate([getattr(t, name) for t in tables]) for name in ("p", "no", "yes")))
        return every.with_forecasts(every.p)

    @cached_property
    def count(self) -> np.ndarray:
        """Number of times that each distinct forecast was given, (k,)."""
        return self.no + self.yes

    @property
    def n(self) -> float:
        """Number of forecasts."""
        return float(self.count.sum())

    @property
    def brier(self) -> float:
        """Mean squared error (p - y)^2; NaN without forecasts."""
        return self._mean(self.no * self.p**2 + self.yes * (1 - self.p) ** 2)

    def log_loss(self, softening: float = 0.0) -> float:
        """Mean of -log of the forecast probability of the outcome, in nats; infinite if an outcome had probability 0.

        A `softening` e replaces p by (1 - e) p + e / 2.
        """
        p = (1 - softening) * self.p + softening / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            loss = np.where(self.no > 0, -self.no * np.log1p(-p), 0.0)
            loss += np.where(self.yes > 0, -self.yes * np.log(p), 0.0)
        return self._mean(loss)

    def with_forecasts(self, p: np.ndarray) -> ForecastTable:
        """A table in which new forecasts p (k,) replace the old forecasts of the same outcomes."""
        share = np.divide(self.yes, self.count, out=np.zeros_like(self.yes), where=self.count > 0)
        return ForecastTable.of(p, share, self.count)

    def reliability(self, n_bins: int = 10) -> Reliability:
        """The reliability diagram, with about equal numbers of forecasts in all bins.

        Equal forecasts are in the same bin, so the bins can have different sizes.
        """
        middle = np.cumsum(self.count) - self.count / 2  # rank of each forecast
        which = np.minimum((n_bins * middle / max(self.n, 1e-300)).astype(np.int64), n_bins - 1)
        count, yes, p = (np.bincount(which, v, n_bins) for v in (self.count, self.yes, self.count * self.p))
        kept = count > 0
        return Reliability(p[kept] / count[kept], yes[kept] / count[kept], count[kept])

    def _mean(self, total: np.ndarray) -> float:
        return float(total.sum() / self.n) if self.n else float("nan")


@dataclass(frozen=True, eq=False)
class Reliability:
    """A reliability diagram (DeGroot and Fienberg 1983).

    Parameters
    ----------
    forecast : (b,) float
        Mean forecast of each bin.
    frequency : (b,) float
        Share of the forecasts in the bin for which the event occurred.
    count : (b,) float
        Number of forecasts in each bin.
    """

    forecast: np.ndarray
    frequency: np.ndarray
    count: np.ndarray

    @property
    def error(self) -> float:
        """Calibration error: mean of ``|forecast - frequency|`` over the bins, weighted by their counts."""
        if not self.count.sum():
            return float("nan")
        return float(np.average(np.abs(self.forecast - self.frequency), weights=self.count))


@dataclass(frozen=True, eq=False)
class Recalibration:
    """A monotone map from forecasts to probabilities, by isotonic regression (Zadrozny and Elkan 2002).

    Forecasts between two fitted values are interpolated, and the result is clipped to [0.001, 0.999].

    Parameters
    ----------
    p : (k,) float
        Forecasts in ascending order.
    probability : (k,) float
        Probability that replaces each forecast, non-decreasing.
    """

    p: np.ndarray
    probability: np.ndarray

    @classmethod
    def fit(cls, table: ForecastTable) -> Recalibration:
        """The non-decreasing map with the least squared error. Each forecast is weighted by its `count`."""
        from scipy.optimize import isotonic_regression

        kept = table.count > 0
        if not kept.any():
            raise InputError("there are no forecasts to fit a recalibration to")
        p, count = table.p[kept], table.count[kept]
        fitted = np.asarray(isotonic_regression(table.yes[kept] / count, weights=count).x)
        flat = np.zeros(len(p), bool)  # inside a constant stretch: no effect on the interpolation
        flat[1:-1] = (fitted[1:-1] == fitted[:-2]) & (fitted[1:-1] == fitted[2:])
        return cls(p[~flat], fitted[~flat])

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Recalibrated forecasts, in the shape of `p`."""
        return np.clip(np.interp(p, self.p, self.probability), CLIP, 1 - CLIP)

    def log_loss(self, table: ForecastTable) -> float:
        """Mean log loss, in nats, of the forecasts in a table after their recalibration."""
        return table.with_forecasts(self(table.p)).log_loss()
