"""Figures over time as inline SVG: quality, effective sample size and ancestors, genealogy.

>>> svg = quality_figure(times, qualities, weights, {"one blob": [...], "connected components": [...]})

Every function returns the text of an ``<svg>`` element that takes its colours and fonts from the page it stands
in, so that it follows a light or a dark theme. The same values give the same text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mstfilter.report.svg import ACCENT, FLOOR, INK, LINE, MUTED, new_figure, style, svg_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["genealogy_figure", "health_figure", "quality_figure"]

_MOST_NAMED = 24  # particles of a pause that are still named in a genealogy


def _pauses(axes: Axes, times: Sequence[int]) -> None:
    axes.set_xlim(min(times) - 0.5, max(times) + 0.5)
    step = max(1, len(times) // 12)
    axes.set_xticks(list(times)[::step])
    axes.set_xlabel("pause")


def quality_figure(
    times: Sequence[int],
    qualities: Sequence[Sequence[float]],
    weights: Sequence[Sequence[float]],
    floors: Mapping[str, Sequence[float]],
) -> str:
    """Quality of every hypothesis (points, area by weight), their weighted mean (line) and floors (dashed).

    Parameters
    ----------
    times : sequence of int
        Pauses with truth.
    qualities, weights : sequence of sequences
        One value a hypothesis, for each of those pauses.
    floors : mapping
        Name to one value a pause.
    """
    with style("quality"):
        figure, (axes,) = new_figure(6.6, 3.3)
        mean = [float(np.dot(q, w) / np.sum(w)) for q, w in zip(qualities, weights, strict=True)]
        for (name, values), dash in zip(floors.items(), ((4, 2), (1, 2)), strict=False):
            axes.plot(times, values, color=FLOOR, lw=1.3, dashes=dash, marker="_", ms=12, label=name)
        for t, q, w in zip(times, qualities, weights, strict=True):
            offset = np.linspace(-0.09, 0.09, len(q)) if len(q) > 1 else np.zeros(1)
            axes.scatter(t + offset, q, s=16 + 130 * np.asarray(w), color=ACCENT, alpha=0.4, lw=0)
        axes.plot(times, mean, color=ACCENT, lw=2, marker="o", ms=4.5, label="weighted mean")
        axes.scatter([], [], s=30, color=ACCENT, alpha=0.4, lw=0, label="hypothesis")
        axes.set_ylim(0, 1.02)
        _pauses(axes, times)
        axes.set_title("Quality against the truth")
        figure.legend(loc="outside lower center", ncols=4, fontsize=8.5, handlelength=2.2, columnspacing=1.4)
        return svg_text(figure, "Quality of the hypotheses over time")


def health_figure(
    times: Sequence[int],
    ess: Sequence[tuple[float, int] | None],
    ancestors: Sequence[tuple[float, int] | None],
) -> str:
    """Effective sample size before resampling, and how many previous particles have descendants.

    Parameters
    ----------
    times : sequence of int
        Pauses.
    ess, ancestors : sequence of (value, most) or None
        Drawn as a share of the most there can be; None where there is nothing to count.
    """
    with style("health"):
        figure, axes = new_figure(6.6, 2.3, 2)
        both = (("Effective sample size", ess), ("Previous particles with descendants", ancestors))
        for a, (title, values) in zip(axes, both, strict=True):
            known = [(t, *pair) for t, pair in zip(times, values, strict=True) if pair is not None]
            at = [t for t, _, _ in known]
            share = [100 * value / max(most, 1) for _, value, most in known]
            a.bar(at, 100, width=0.62, color=LINE, lw=0, alpha=0.55)
            a.bar(at, share, width=0.62, color=ACCENT, lw=0, alpha=0.85)
            _pauses(a, times)
            a.set_ylim(0, 116)
            a.set_yticks([0, 50, 100], ["0", "50 %", "100 %"])
            for (t, value, most), s in zip(known, share, strict=True):
                if len(known) <= 8:
                    text = f"{value:.3g} of {most}"
                    a.annotate(text, (t, s), (0, 2), textcoords="offset points", ha="center", fontsize=8)
            a.set_title(title)
        return svg_text(figure, "Effective sample size and unique ancestors over time")


def genealogy_figure(
    weights: Sequence[Sequence[float]],
    previous: Sequence[Sequence[int] | None],
    proposed: Sequence[Sequence[int] | None],
) -> str:
    """Who descends from whom: particles of each pause in a column, disc area by weight.

    Parameters
    ----------
    weights : sequence of sequences
        For each pause, one a particle.
    previous, proposed : sequence of sequences or None
        For each pause, the particle of the previous pause and the proposal that each one comes from; -1 none.

    The lineage of the heaviest particle of the last pause is drawn in colour.
    """
    n = max(len(w) for w in weights)
    named = n <= _MOST_NAMED
    line = _lineage(weights, previous)
    with style("genealogy"):
        figure, (axes,) = new_figure(6.6, float(np.clip(1.0 + 0.62 * n, 2.2, 6.2)))
        axes.grid(visible=False)
        for t, parents in enumerate(previous):
            for k, parent in enumerate(parents or ()):
                if t and 0 <= parent < len(weights[t - 1]):
                    own = line.get(t) == k
                    x, y = _bend(t - 1, parent, t, k)
                    axes.plot(x, y, color=ACCENT if own else MUTED, lw=2.2 if own else 1, alpha=1 if own else 0.45)
        for t, indices in enumerate(proposed):
            for k, index in enumerate(indices or ()):
                if index >= 0:
                    axes.plot([t - 0.11, t], [k - 0.26, k], color=FLOOR, lw=1, solid_capstyle="round")
                    if named:
                        axes.annotate(
                            f"p{index}",
                            (t - 0.115, k - 0.3),
                            ha="right",
                            va="center",
                            fontsize=7.5,
                            color=FLOOR,
                        )
        for t, w in enumerate(weights):
            share = np.asarray(w) / np.sum(w)
            on = np.array([line.get(t) == k for k in range(len(w))])
            size = (18 if named else 4) + (260 if named else 60) * share
            for mask, colour in ((~on, INK), (on, ACCENT)):
                axes.scatter(np.full(mask.sum(), t), np.flatnonzero(mask), s=size[mask], color=colour, lw=0, zorder=3)
            if named:
                for k in range(len(w)):
                    axes.annotate(f"#{k}", (t, k), (7, 6), textcoords="offset points", fontsize=8, color=MUTED)
        axes.set_ylim(n - 0.4, -0.75)
        axes.set_yticks([])
        _pauses(axes, range(len(weights)))
        axes.set_title("Genealogy")
        return svg_text(figure, "Genealogy of the particles")


def _lineage(weights: Sequence[Sequence[float]], previous: Sequence[Sequence[int] | None]) -> dict[int, int]:
    """Pause to particle on the way back from the heaviest of the last pause."""
    t, k = len(weights) - 1, int(np.argmax(weights[-1]))
    line = {t: k}
    while t > 0:
        parents: Sequence[Any] = previous[t] or ()
        if k >= len(parents) or parents[k] < 0:
            break
        t, k = t - 1, int(parents[k])
        line[t] = k
    return line


def _bend(x0: float, y0: float, x1: float, y1: float) -> tuple[np.ndarray, np.ndarray]:
    """A smooth line between two points that leaves and arrives level."""
    s = np.linspace(0, 1, 24)
    return x0 + (x1 - x0) * s, y0 + (y1 - y0) * (3 * s**2 - 2 * s**3)
