"""Charts of filters: collected quantities with bands, and differences between filters.

>>> history.plot(band=0.9, x=states)                 # the quantiles that were collected as x, and the true states
>>> runs.plot()                                      # medians and bands over the seeds of `run_many`
>>> draw_differences(found)                          # what `compare_arms` or `History.compare` found

The functions need matplotlib and numpy alone. They return a figure, which a notebook shows; ``figure.savefig(path)``
stores it.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from mstfilter.base.errors import InputError, check_number

_MOST_PANELS = 8


class Drawing(Figure):
    """A matplotlib figure that a notebook shows as a picture, with or without pyplot."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=110, bbox_inches="tight")
        return file.getvalue()


@matplotlib.style.context("mstfilter.app.report.figures")
def plot_history(history: Any, band: float = 0.9, **truth: Any) -> Drawing:
    """Collected quantities over time, one panel for each entry, at most eight.

    Parameters
    ----------
    history : History
        Of one run: lines, and for collected `quantiles` the median with a band. Of `run_many`: for each filter the
        median over the seeds and a band.
    band : float
        Share of the distribution in a band, between 0 and 1. One run needs the quantiles (1 - band) / 2 and
        (1 + band) / 2.
    **truth : (T,) or (T, ...) array_like
        Values to draw as points, by the name of the collected quantity; None where unknown.

    Raises
    ------
    InputError
        If a quantile of the band was not collected, or if `truth` names a quantity that was not collected.
    """
    check_number("band", band)
    if not 0 < band < 1:
        raise InputError(f"band is {band}, expected a share between 0 and 1, such as 0.9")
    for name in truth.keys() - history.keys():
        raise InputError(f"there are no collected values {name!r}", f"there are: {', '.join(history) or 'none'}")
    panels = [panel for name in history for panel in _panels(history, name, band, truth.get(name))][:_MOST_PANELS]
    if not panels:
        raise InputError("the history has no values to plot", "collect(filter.iterate(observations), x=quantiles())")
    figure = Drawing(figsize=(6.6, 0.6 + 1.7 * len(panels)), layout="constrained")
    times = np.asarray(history.coords["time"])
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    for axis, (label, series, points) in zip(axes, panels, strict=True):
        for k, (arm, (low, middle, high)) in enumerate(series.items()):
            axis.plot(times, middle, color=f"C{k}", label=arm)
            if low is not None:
                axis.fill_between(times, low, high, color=f"C{k}", alpha=0.25, linewidth=0)
        if points is not None:
            axis.plot(times, points, ".", color="0.2", markersize=4, label="true")
        axis.set_ylabel(label)
        if (axis is axes[0] and len(series) > 1) or points is not None:
            axis.legend(loc="best")
    if "seed" in history.dims:
        axes[0].set_title(f"median over {len(history.coords['seed'])} seeds, and {band:.0%} of them")
    elif any(low is not None for _, series, _ in panels for low, _, _ in series.values()):
        axes[0].set_title(f"median, and a band of {band:.0%}")
    axes[-1].set_xlabel("time")
    return figure


def _panels(history: Any, name: str, band: float, truth: Any) -> list[tuple[str, dict[str, Any], Any]]:
    """For each entry of a quantity: its label, (low, middle, high) of each filter, and true values."""
    values, levels = np.asarray(history[name], np.float64), history.levels.get(name)
    arms = [str(arm) for arm in history.coords["arm"]] if "arm" in history.dims else [name]
    values = values if "arm" in history.dims else values[None]
    edges = ((1 - band) / 2, (1 + band) / 2)
    if "seed" in history.dims:
        if levels is not None:  # the spread of the median over seeds
            values = values[:, :, :, int(np.argmin(np.abs(np.subtract(levels, 0.5))))]
        values = np.where(np.isfinite(values), values, np.nan)  # without lost runs
        lost: Any = np.isnan(values).all(axis=1, keepdims=True)
        drawn = np.nanquantile(np.where(lost, 0.0, values), [edges[0], 0.5, edges[1]], axis=1)
        low, middle, high = np.where(lost[:, 0], np.nan, drawn)
    elif levels is not None:
        low, middle, high = (_level(values, name, levels, level) for level in (edges[0], 0.5, edges[1]))
    else:
        low, middle, high = None, values, None
    given = None if truth is None else _true_values(name, truth, middle.shape[1:])
    panels = []
    for entry in np.ndindex(middle.shape[2:]):
        rows = (slice(None), *entry)
        series = {
            arm: (None if low is None else low[k][rows], middle[k][rows], None if high is None else high[k][rows])
            for k, arm in enumerate(arms)
        }
        label = name + "".join(f"[{i}]" for i in entry)
        panels.append((label, series, None if given is None else given[rows]))
    return panels


def _level(values: np.ndarray, name: str, levels: tuple[float, ...], level: float) -> np.ndarray:
    """Collected quantiles of one level."""
    found = int(np.argmin(np.abs(np.subtract(levels, level))))
    if abs(levels[found] - level) > 1e-6:
        edges = sorted({round(min(level, 1 - level), 6), 0.5, round(max(level, 1 - level), 6)})
        raise InputError(
            f"the quantile {level:g} of {name!r} was not collected, there are {', '.join(map(str, levels))}",
            f"collect {name}=quantiles({', '.join(f'{edge:g}' for edge in edges)})",
        )
    return values[:, :, found]


def _true_values(name: str, truth: Any, shape: tuple[int, ...]) -> np.ndarray:
    """True values (T, ...) as floats; NaN for None."""
    given = np.asarray(truth, np.float64)
    if given.shape != shape:
        raise InputError(f"true values of {name!r} have shape {given.shape}, expected {shape}")
    return given


@matplotlib.style.context("mstfilter.app.report.figures")
def draw_differences(found: Mapping[str, Any], label: str = "") -> Drawing:
    """Mean differences with their 95 % intervals, one row for each compared method; claims are filled points.

    `found` is the result of `mstfilter.scoring.compare_arms` or `History.compare`, and `label` what differs.
    """
    if not found:
        raise InputError("there are no differences to plot", "compare at least two filters")
    figure = Drawing(figsize=(6.6, 1.0 + 0.36 * len(found)), layout="constrained")
    axes = figure.subplots()
    for row, d in enumerate(found.values()):
        reach = np.abs([[d.mean - d.low], [d.high - d.mean]])
        axes.errorbar(d.mean, row, xerr=reach, fmt="o", color="C0", mfc="C0" if d.is_claim else "white")
    axes.axvline(0.0, color="0.6", linewidth=1)
    axes.set_yticks(range(len(found)), list(found))
    axes.set_ylim(len(found) - 0.5, -0.5)
    what = label or getattr(found, "label", "") or "difference"
    axes.set_xlabel(f"{what}, minus {getattr(found, 'reference', 'the reference')}; 95 % interval, filled if claimed")
    return figure
