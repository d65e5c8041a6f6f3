"""Figures of runs and studies as inline SVG.

>>> svg = quality_figure(times, qualities, weights, {"without past": [...]}, {"one blob": [...]})
>>> svg = time_figure({"s1": {"mst": {0: [0.5, 0.6], 1: [0.7]}}}, arms=["mst"])

Each function returns the text of an ``<svg>`` element. The figure uses the colours and fonts of the page that
contains it, also in a dark theme. The same values give the same text.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from mstfilter.scoring.forecasts import ForecastTable
from mstfilter.scoring.statistics import Difference

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Colours of the style file that a page replaces by its own, which follow a light or a dark theme.
_INK, _MUTED, _LINE, _ACCENT, _BASELINE = "#1d2126", "#646b74", "#e1e2e0", "#2f6db4", "#9c5a12"
#: Colours of the compared methods (arms).
SERIES = (
    *("#336fb9", "#ee9138", "#2ca281", "#93285c", "#a3d3eb", "#e8d34f"),
    *("#d381d8", "#8b8f86", "#4f4100", "#502684", "#70d6b5", "#a95317"),
)
_PAGE = {
    _INK: "currentColor",
    _MUTED: "var(--muted)",
    _LINE: "var(--line)",
    _ACCENT: "var(--accent)",
    _BASELINE: "var(--baseline)",
    **{mark: f"var(--s{k})" for k, mark in enumerate(SERIES)},
}
_WIDEST = 10.0  # inches


@contextmanager
def _style(name: str) -> Iterator[None]:
    """The style of all figures. `name` makes the ids of the elements of a figure unique in a page."""
    import matplotlib.style

    style = matplotlib.style.context(
        "mstfilter.app.report.figures", after_reset=True
    )  # without the user's matplotlibrc
    with style, matplotlib.rc_context({"svg.hashsalt": name}):
        yield


def _new_figure(width: float, height: float, n: int = 1, *, below: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure, `width` by `height` inches, with `n` axes in a row, or in a column if `below`."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure((width, height), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    axes = [figure.add_subplot(*((n, 1) if below else (1, n)), k + 1) for k in range(n)]
    for a in axes:
        a.patch.set_alpha(0)
    return figure, axes


def _svg_text(figure: Figure, title: str) -> str:
    """The figure as an SVG element of a page, without prolog, links, size and fonts."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    view = re.search(r'viewBox="([^"]*)"', text)
    assert view is not None
    widest = 1.45 * float(view[1].split()[2])  # pixels: text of 10 points is not drawn larger than 19 pixels
    head = (
        f'<svg class="figure" style="max-width:{widest:.0f}px" viewBox="{view[1]}" role="img" aria-label="{title}">'
    )
    text = head + text[text.index(">") + 1 :]
    # The page names the font. Of a shorthand, as other versions of matplotlib write it, the size remains.
    text = re.sub(r"font: [^;\"]*?([\d.]+px)[^;\"]*", r"font-size: \1", text)
    text = re.sub(r"font-family: [^;\"]*(;|(?=\"))", "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r"(<g [^>]*)>\n((?:\s*<use [^>]*/>\n){2,})", _merge_styles, text)
    for mark, colour in _PAGE.items():
        text = text.replace(mark, colour)
    return text.strip()


def _merge_styles(match: re.Match[str]) -> str:
    """Write the common style of a group of marks only once, and round the marks' positions to a tenth of a point."""
    styles = set(re.findall(r'style="([^"]*)"', match[2]))
    marks = re.sub(r'([xy]="-?\d+\.\d)\d+"', r'\1"', match[2])
    if len(styles) > 1 or "style=" in match[1]:
        return f"{match[1]}>\n{marks}"
    return f'{match[1]} style="{styles.pop()}">\n' + re.sub(r' style="[^"]*"', "", marks)


def quality_figure(
    times: Sequence[int],
    qualities: Sequence[Sequence[float]],
    weights: Sequence[Sequence[float]],
    compared: Mapping[str, Sequence[float]],
    baselines: Mapping[str, Sequence[float]],
) -> str:
    """Quality over time: hypotheses (points with area by weight), mean and compared runs (lines), baselines (dashed).

    `times` are the indices of the pauses with ground truth. `qualities` and `weights` have one value per hypothesis
    for each pause. `compared` and `baselines` have one value per pause for each name. NaN means no value.
    """
    with _style("quality"):
        figure, (axes,) = _new_figure(6.6, 3.3)
        for (name, values), mark in zip(compared.items(), SERIES[2:], strict=False):
            axes.plot(times, values, color=mark, lw=1.6, marker="o", ms=4, label=name)
        for (name, values), dash in zip(baselines.items(), ((4, 2), (1, 2)), strict=False):
            axes.plot(times, values, color=_BASELINE, lw=1.3, dashes=dash, marker="_", ms=12, label=name)
        for t, q, w in zip(times, qualities, weights, strict=True):
            offset = np.linspace(-0.09, 0.09, len(q)) if len(q) > 1 else np.zeros(1)
            axes.scatter(t + offset, q, s=16 + 130 * np.asarray(w), color=_ACCENT, alpha=0.4, lw=0)
        mean = [float(np.mean(q)) for q in qualities]
        axes.plot(times, mean, color=_ACCENT, lw=2, marker="o", ms=4.5, label="mean over hypotheses")
        axes.scatter([], [], s=30, color=_ACCENT, alpha=0.4, lw=0, label="hypothesis")
        axes.set_ylim(0, 1.02)
        axes.set_xlim(min(times) - 0.5, max(times) + 0.5)
        axes.set_xticks(list(times)[:: max(1, len(times) // 12)])
        axes.set_xlabel("pause")
        axes.set_title("Quality against the ground truth")
        figure.legend(loc="outside lower center", ncols=3, handlelength=2.2, columnspacing=1.4)
        return _svg_text(figure, "Quality of the hypotheses over time")


_MOST, _GROUP = len(SERIES), 8  # arms in a single figure, and in each of several


def _arm_colours(arms: Sequence[str]) -> dict[str, str]:
    """The colour of each compared method (arm). Colours repeat after twelve arms."""
    return {arm: SERIES[k % len(SERIES)] for k, arm in enumerate(arms)}


def figure_groups(arms: Sequence[str], reference: str) -> list[list[str]]:
    """Split `arms` into figures: up to twelve arms in one figure, or else the reference and seven others in each."""
    if len(arms) <= _MOST:
        return [list(arms)]
    others, first = [arm for arm in arms if arm != reference], [reference] if reference in arms else []
    size = _GROUP - len(first)
    return [first + others[k : k + size] for k in range(0, len(others), size)]


def time_figure(
    values: Mapping[str, Mapping[str, Mapping[int, Sequence[float]]]],
    arms: Sequence[str],
    measure: str = "quality",
    every_arm: Sequence[str] = (),
) -> str:
    """Quality of all hypotheses over time, or another measure of the runs, with one panel per family.

    `values` is a nested mapping family -> arm -> pause -> values. A pause has one value for each scene and seed, or
    for each hypothesis. `arms` names the compared methods in the order of their boxes (`figure_groups` splits long
    lists). Methods without values are not drawn. If `every_arm` lists up to twelve methods, each has the same colour
    in all figures with this list. A box contains the middle half of the values, the bar is the median, and whiskers
    reach the 5th and 95th percentile. Points are values, and lines join the means.
    """
    values = {family: {a: v for a, v in of_arms.items() if a in arms} for family, of_arms in values.items()}
    colours, n = _arm_colours(every_arm if 0 < len(every_arm) <= len(SERIES) else arms), len(values)
    shown = [arm for arm in arms if any(arm in of_arms for of_arms in values.values())]
    most_pauses = max(len({t for by_pause in of_arms.values() for t in by_pause}) for of_arms in values.values())
    most_boxes = most_pauses * len(shown)
    with _style("study over time"):
        figure, panels = _new_figure(min(max(6.6, 1.1 + 0.42 * most_boxes), _WIDEST), 3.4 * n, n, below=True)
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
                axes.axvline(t - 0.5, color=_LINE, lw=0.7)
            axes.set_xlim(min(pauses) - 0.5, max(pauses) + 0.5)
            axes.set_xticks(pauses)
            drawn = np.concatenate([np.asarray(q) for by_pause in of_arms.values() for q in by_pause.values()])
            most = 1.02 if "quality" in measure else np.inf
            axes.set_ylim(max(-0.02, drawn.min() - 0.05), min(most, drawn.max() + 0.05))
            axes.set_title(family)
            axes.set_ylabel(measure)
        panels[-1].set_xlabel("pause")
        handles = {line.get_label(): line for axes in panels for line in axes.get_lines() if line.get_label() in arms}
        named = [arm for arm in arms if arm in handles]
        figure.legend([handles[arm] for arm in named], named, loc="outside lower center", ncols=_columns(named))
        return _svg_text(figure, f"{measure.capitalize()} over time by family and arm")


def _columns(names: Iterable[str]) -> int:
    """Number of columns of a legend that fit into the narrowest figure."""
    return max(1, min(4, 84 // (8 + max(len(name) for name in names))))


def _boxes(
    axes: Axes, at: Mapping[int, float], by_pause: Mapping[int, Sequence[float]], width: float, colour: str
) -> None:
    """Draw a box and points for the values of each pause."""
    for t, x in at.items():
        q = np.sort(np.asarray(by_pause[t]))
        # Points are spread horizontally, in an order that does not depend on their height.
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


def reliability_figure(tables: Mapping[str, ForecastTable], arms: Sequence[str] = ()) -> str:
    """Reliability diagram of the forecasts that two voxels belong to one object.

    Parameters
    ----------
    tables : mapping
        Mapping from names of methods or families to their forecasts.
    arms : sequence of str
        Names of the curves; the first name has the first colour. The default is the names of `tables`.
    """
    colours = _arm_colours(arms or list(tables))
    with _style("reliability"):
        figure, (axes,) = _new_figure(6.6, 4.4)
        axes.plot([0, 1], [0, 1], color=_MUTED, lw=1.0, dashes=(4, 2))
        for name, table in tables.items():
            r = table.reliability()
            axes.plot(r.forecast, r.frequency, color=colours[name], lw=1.3, zorder=3)
            size = 12 + 160 * r.count / r.count.sum()
            axes.scatter(r.forecast, r.frequency, s=size, color=colours[name], alpha=0.6, lw=0, label=name, zorder=3)
        axes.set_xlim(-0.03, 1.03)
        axes.set_ylim(-0.03, 1.03)
        axes.set_xlabel('forecast of "the two voxels belong to one object"')
        axes.set_ylabel("how often it is true")
        if len(tables) > 1:
            figure.legend(loc="outside lower center", ncols=_columns(tables))
        return _svg_text(figure, "Reliability diagram")


def differences_figure(
    differences: Sequence[tuple[str, str, Difference]], arms: Sequence[str], reference: str, measure: str, side: str
) -> str:
    """Differences of a measure between compared methods and the reference, with intervals and a dot for each unit.

    An entry of `differences` is (family, arm, arm minus reference). `arms` lists all compared methods, in the order
    of the colours. `side` is the side of zero on which the reference is better, "left" or "right", or empty.
    """
    colours = _arm_colours(arms)
    rows = [(family, arm, (d.mean, d.low, d.high), colours[arm]) for family, arm, d in differences]
    with _style("study differences"):
        figure, (axes,) = _new_figure(6.6, 1.0 + 0.26 * forest_height(rows))
        draw_forest(axes, rows, [d.values for *_, d in differences])
        parts = [f"{measure} of the arm minus that of {reference}"]
        parts += [f"{reference} is better on the {side}"] if side else []
        label = "\n".join(line for part in parts for line in textwrap.wrap(part, 76))
        figure.supxlabel(label, fontsize=10, color=_MUTED)
        return _svg_text(figure, f"Paired differences of {measure} with 95 % intervals")


#: Group, name, (mean, low, high), colour.
ForestRow = tuple[str, str, tuple[float, float, float], str]


def forest_height(rows: Sequence[ForestRow]) -> float:
    """Height of a forest plot in lines of text."""
    return len(rows) + 1.8 * len({group for group, *_ in rows})


def draw_forest(axes: Axes, rows: Sequence[ForestRow], dots: Sequence[Sequence[float]] = ()) -> None:
    """Draw each row as a point with its interval, and below it small dots, if there are any for the row.

    The name of a group, if not empty, is above its rows.
    """
    axes.grid(axis="y", visible=False)
    axes.grid(axis="x")
    axes.axvline(0, color=_MUTED, lw=1.0)
    y, ticks = 0.0, []
    for k, (group, name, (mean, low, high), mark) in enumerate(rows):
        if group and (k == 0 or group != rows[k - 1][0]):
            y += 0.9 * (k > 0)
            ticks.append((y, group, True))
            y += 0.9
        if np.isfinite(low):
            axes.plot([low, high], [y, y], color=mark, lw=2.4, solid_capstyle="butt")
        axes.plot([mean], [y], marker="o", ms=6, color=mark)
        if dots:
            axes.plot(dots[k], [y + 0.32] * len(dots[k]), ".", ms=3, alpha=0.6, color=mark)
        ticks.append((y, name, False))
        y += 1.0
    axes.set_yticks([at for at, *_ in ticks], [text for _, text, _ in ticks])
    for label, (*_, head) in zip(axes.get_yticklabels(), ticks, strict=True):
        if head:
            label.set(fontweight="bold", color=_INK)
    axes.locator_params(axis="x", nbins=6)
    axes.set_ylim(y - 0.3, -0.7)
