"""Figures of a study as inline SVG: quality over time by family and method, paired differences.

>>> svg = time_figure({"s1": {"mst": {0: [0.5, 0.6], 1: [0.7]}}}, arms=["mst"])
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mstfilter.report.svg import INK, LINE, MUTED, SERIES, new_figure, style, svg_text
from mstfilter.study import Compared

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["colour_of", "differences_figure", "in_groups", "time_figure"]

_MOST, _GROUP = len(SERIES), 8  # arms that one figure can tell apart, and that each of several holds


def colour_of(arms: Sequence[str]) -> dict[str, str]:
    """A colour for every arm; they repeat after twelve."""
    return {arm: SERIES[k % len(SERIES)] for k, arm in enumerate(arms)}


def in_groups(arms: Sequence[str], reference: str) -> list[list[str]]:
    """Arms for one figure each: all of them up to twelve, else the reference with seven others in each."""
    if len(arms) <= _MOST:
        return [list(arms)]
    others, first = [arm for arm in arms if arm != reference], [reference] if reference in arms else []
    size = _GROUP - len(first)
    return [first + others[k : k + size] for k in range(0, len(others), size)]


def time_figure(values: Mapping[str, Mapping[str, Mapping[int, Sequence[float]]]], arms: Sequence[str]) -> str:
    """Quality of all hypotheses over time, one panel a family.

    Parameters
    ----------
    values : mapping
        Family -> arm -> pause -> quality of every hypothesis of every scene and seed.
    arms : sequence of str
        In the order in which they stand beside each other; see `in_groups` where there are many.

    Arms that the values lack are left out, and so are values of other arms. Boxes hold the middle half of the
    hypotheses, the bar is their median, whiskers reach the 5th and 95th per cent; points are hypotheses, lines join
    the means.
    """
    values = {family: {a: v for a, v in of_arms.items() if a in arms} for family, of_arms in values.items()}
    colours, n = colour_of(arms), len(values)
    shown = [arm for arm in arms if any(arm in of_arms for of_arms in values.values())]
    with style("study over time"):
        figure, panels = new_figure(max(6.6, 1.1 + 0.42 * _slots(values, len(shown))), 3.4 * n, n, below=True)
        for axes, (family, of_arms) in zip(panels, values.items(), strict=True):
            pauses = sorted({t for by_pause in of_arms.values() for t in by_pause})
            width = 0.84 / max(len(shown), 1)
            for k, arm in enumerate(shown):
                if arm not in of_arms:
                    continue
                at = {t: t + (k - (len(shown) - 1) / 2) * width for t in of_arms[arm]}
                _boxes(axes, at, of_arms[arm], width, colours[arm])
                means = [float(np.mean(of_arms[arm][t])) for t in at]
                axes.plot(
                    list(at.values()), means, color=colours[arm], lw=1.3, marker="D", ms=3.6, label=arm, zorder=4
                )
            for t in pauses[1:]:
                axes.axvline(t - 0.5, color=LINE, lw=0.7)
            axes.set_xlim(min(pauses) - 0.5, max(pauses) + 0.5)
            axes.set_xticks(pauses)
            drawn = np.concatenate([np.asarray(q) for by_pause in of_arms.values() for q in by_pause.values()])
            axes.set_ylim(max(-0.02, drawn.min() - 0.05), min(1.02, drawn.max() + 0.05))
            axes.set_title(family)
            axes.set_ylabel("quality")
        panels[-1].set_xlabel("pause")
        handles = {line.get_label(): line for axes in panels for line in axes.get_lines() if line.get_label() in arms}
        figure.legend(
            [handles[arm] for arm in arms if arm in handles],
            [arm for arm in arms if arm in handles],
            loc="outside lower center",
            ncols=min(4, len(shown)),
            fontsize=8.5,
        )
        return svg_text(figure, "Quality of the hypotheses over time by family and method")


def _slots(values: Mapping[str, Mapping[str, Mapping[int, Sequence[float]]]], n_arms: int) -> int:
    """Boxes side by side in the widest panel."""
    return max(len({t for by_pause in of_arms.values() for t in by_pause}) for of_arms in values.values()) * n_arms


def _boxes(
    axes: Axes, at: Mapping[int, float], by_pause: Mapping[int, Sequence[float]], width: float, colour: str
) -> None:
    """A box and the points of every pause."""
    for t, x in at.items():
        q = np.sort(np.asarray(by_pause[t]))
        # Points beside one another, in an order that does not depend on their height.
        place = (np.arange(len(q)) * 0.618) % 1.0 - 0.5
        axes.scatter(x + 0.6 * width * place, q, s=5, color=colour, alpha=0.35, lw=0, zorder=2)
        axes.boxplot(
            [q],
            positions=[x],
            widths=0.78 * width,
            whis=(5, 95),
            showfliers=False,
            manage_ticks=False,
            boxprops={"color": colour, "lw": 1.0},
            medianprops={"color": colour, "lw": 2.0},
            whiskerprops={"color": colour, "lw": 1.0},
            capprops={"color": colour, "lw": 0},
            zorder=3,
        )


def differences_figure(compared: Sequence[Compared], arms: Sequence[str]) -> str:
    """Paired differences with their t intervals, by family; right of zero the reference is better."""
    known = [one for one in compared if one.difference.n]
    colours = colour_of(arms)
    with style("study differences"):
        figure, (axes,) = new_figure(6.6, 0.9 + 0.26 * len(known) + 0.3 * len({one.family for one in known}))
        axes.grid(axis="y", visible=False)
        axes.grid(axis="x")
        axes.axvline(0, color=MUTED, lw=1.0)
        y, ticks, family = 0.0, [], None
        for one in known:
            if one.family != family:
                y += 0.0 if family is None else 0.9
                where: dict[str, Any] = {
                    "xycoords": ("axes fraction", "data"),
                    "textcoords": "offset points",
                    "va": "center",
                }
                axes.annotate(one.family, (0, y), (4, 0), fontsize=9, color=INK, fontweight="bold", **where)
                family, y = one.family, y + 0.9
            d = one.difference
            if np.isfinite(d.low):
                axes.plot([d.low, d.high], [y, y], color=colours[one.second], lw=2.2, solid_capstyle="butt")
            axes.plot([d.mean], [y], marker="o", ms=6, color=colours[one.second])
            ticks.append((y, one.second))
            y += 1.0
        axes.set_yticks([at for at, _ in ticks], [name for _, name in ticks])
        axes.set_ylim(y - 0.3, -0.7)
        reference = known[0].first if known else ""
        axes.set_xlabel(f"quality of {reference} minus quality of the method")
        return svg_text(figure, "Paired differences of quality with 95 % intervals")
