"""Scores of forecasts against sums written out, and against the theory of proper scores by enumeration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mstfilter.base.errors import InputError
from mstfilter.scoring.forecasts import ForecastTable, Recalibration

FORECASTS = st.lists(st.tuples(st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.9, 1.0]), st.booleans()), min_size=1)


@settings(max_examples=60, deadline=None)
@given(FORECASTS, FORECASTS)
def test_a_table_against_sums(first, second):
    p, y = np.array(first).T
    table = ForecastTable.of(p, y)
    assert table.brier == pytest.approx(np.mean((p - y) ** 2))
    soft = 0.98 * p + 0.01
    assert table.log_loss(0.02) == pytest.approx(np.mean(-np.log(np.where(y == 1, soft, 1 - soft))))
    both = ForecastTable.pooled([table, ForecastTable.of(*np.array(second).T)])
    direct = ForecastTable.of(*np.array(first + second).T)
    for name in ("p", "no", "yes"):
        np.testing.assert_allclose(getattr(both, name), getattr(direct, name))


@pytest.mark.parametrize(
    ("p", "y", "message"), [([1.1], [1], "forecast 0"), ([0.5], [2], "outcome 0"), ([0.5], [], "shape")]
)
def test_wrong_forecasts_are_named(p, y, message):
    with pytest.raises(InputError, match=message):
        ForecastTable.of(p, y)


def test_reliability_of_a_calibrated_and_an_overconfident_forecaster():
    rng = np.random.default_rng(1)
    p = rng.choice(np.linspace(0, 1, 41), size=100_000)
    honest = ForecastTable.of(p, rng.random(len(p)) < p).reliability()
    assert honest.error < 0.01  # the standard error of a bin is .005
    assert honest.count.sum() == len(p) and len(honest.count) == 10
    bold = ForecastTable.of(np.round(p), rng.random(len(p)) < p).reliability()
    assert bold.error == pytest.approx(0.25, abs=0.01)  # E|p - round(p)|
    np.testing.assert_allclose(bold.frequency, [0.25, 0.75], atol=0.02)


@settings(max_examples=50, deadline=None)
@given(FORECASTS)
def test_recalibration_is_the_best_monotone_map(pairs):
    """No map with another level of one block has a smaller squared error, and the map never decreases."""
    table = ForecastTable.of(*np.array(pairs).T)
    fit = Recalibration.fit(table)
    values = np.interp(table.p, fit.p, fit.probability)
    assert (np.diff(values) >= -1e-12).all()
    # Isotonic regression by its max-min formula.
    m = np.array(
        [
            max(
                min(table.yes[i : j + 1].sum() / table.count[i : j + 1].sum() for j in range(k, len(values)))
                for i in range(k + 1)
            )
            for k in range(len(values))
        ]
    )
    np.testing.assert_allclose(values, m, atol=1e-9)


def test_tables_without_forecasts_can_be_pooled():
    empty = ForecastTable.of([], [])
    assert ForecastTable.pooled([empty, empty]).n == 0
    assert ForecastTable.pooled([empty, ForecastTable.of([0.5], [1])]).n == 1
