"""Figures as inline SVG that takes its colours and fonts from the page it stands in, so that it follows its theme.

>>> with style("quality"):
...     figure, (axes,) = new_figure(6.6, 3.3)
...     axes.plot([0, 1], [0.5, 0.7], color=ACCENT)
...     text = svg_text(figure, "Quality over time")

The same values give the same text.
"""

from __future__ import annotations

import io
import re
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["ACCENT", "FLOOR", "INK", "LINE", "MUTED", "SERIES", "new_figure", "style", "svg_text"]

# Stand-ins that are replaced by the page's own colours.
INK, MUTED, LINE, ACCENT, FLOOR = "#010203", "#020304", "#030405", "#040506", "#050607"
#: Colours of things that are compared.
SERIES = tuple(f"#06{k:02x}08" for k in range(12))
_PAGE = {
    INK: "currentColor",
    MUTED: "var(--muted)",
    LINE: "var(--line)",
    ACCENT: "var(--accent)",
    FLOOR: "var(--floor)",
    **{mark: f"var(--s{k})" for k, mark in enumerate(SERIES)},
}


@contextmanager
def style(name: str) -> Iterator[None]:
    """Settings of figures; `name` keeps their element names apart in one page."""
    import matplotlib

    settings = {
        "svg.fonttype": "none",
        "svg.hashsalt": f"mstfilter {name}",
        "font.size": 9.5,
        "axes.edgecolor": LINE,
        "axes.labelcolor": MUTED,
        "axes.titlecolor": INK,
        "axes.titlesize": 10,
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.spines.left": False,
        "axes.axisbelow": True,
        "text.color": INK,
        "xtick.color": LINE,
        "ytick.color": LINE,
        "xtick.labelcolor": MUTED,
        "ytick.labelcolor": MUTED,
        "ytick.left": False,
        "grid.color": LINE,
        "grid.linewidth": 0.7,
        "legend.frameon": False,
        "legend.labelcolor": MUTED,
    }
    with matplotlib.rc_context(settings):
        yield


def new_figure(width: float, height: float, n: int = 1, *, below: bool = False) -> tuple[Figure, list[Axes]]:
    """A figure of so many inches with `n` axes side by side, or one below the other."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure((width, height), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    axes = [figure.add_subplot(*((n, 1) if below else (1, n)), k + 1) for k in range(n)]
    for a in axes:
        a.patch.set_alpha(0)
        a.grid(axis="y")
    return figure, axes


def svg_text(figure: Figure, title: str) -> str:
    """The figure as an element to stand in a page, without prolog, links, size or fonts of its own."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    view = re.search(r'viewBox="([^"]*)"', text)
    assert view is not None
    head = f'<svg class="figure" viewBox="{view[1]}" role="img" aria-label="{title}">'
    text = head + text[text.index(">") + 1 :]
    text = re.sub(r"font(-family)?: ?[^;\"]*'[^;\"]*(;|(?=\"))", _font, text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r"(<g [^>]*)>\n((?:\s*<use [^>]*/>\n){2,})", _once, text)
    for mark, colour in _PAGE.items():
        text = text.replace(mark, colour)
    return text.strip()


def _once(match: re.Match[str]) -> str:
    """Marks of one group that look alike: their style once, their places to a tenth of a point."""
    styles = set(re.findall(r'style="([^"]*)"', match[2]))
    marks = re.sub(r'([xy]="-?\d+\.\d)\d+"', r'\1"', match[2])
    if len(styles) > 1 or "style=" in match[1]:
        return f"{match[1]}>\n{marks}"
    return f'{match[1]} style="{styles.pop()}">\n' + re.sub(r' style="[^"]*"', "", marks)


def _font(match: re.Match[str]) -> str:
    """Keep the size of a ``font`` shorthand, drop the family."""
    size = re.search(r"([\d.]+)px", match[0])
    return "" if size is None else f"font-size: {size[1]}px;"
