"""Display of the package's objects in a notebook: facts and pictures, plots, a scene that can be rotated.

>>> recording.plot()                        # images, depth and the time line of the pauses
>>> hypothesis.show()                       # voxels that can be rotated with the mouse, also outside a notebook
>>> hypothesis.show().save("scene.html")
>>> state.population.plot()                 # hypotheses by weight, or the distribution of each coordinate

The classes in `mstfilter.scene`, `mstfilter.smc` and `mstfilter.belief` have methods with these names. The methods
import this module when they are called (`mstfilter.lazy.late`). Pages load nothing from a network.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from functools import singledispatch
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from mstfilter.belief import Belief
from mstfilter.report.identities import match_objects, weigh_distinct
from mstfilter.report.pictures import (
    Colour,
    colour,
    data_uri,
    jpeg_bytes,
    png_bytes,
    viewpoint,
    voxel_picture,
)
from mstfilter.scene import Clip, Frame, Hypothesis, Recording
from mstfilter.smc import Candidates, Info, Infos, ParticleFilter, Population, State, as_matrix

_MOST_PICTURES = 6


class Drawing(Figure):
    """A matplotlib figure that a notebook shows as a picture, with or without pyplot."""

    def _repr_png_(self) -> bytes:
        import io

        file = io.BytesIO()
        self.savefig(file, format="png", dpi=110, bbox_inches="tight")
        return file.getvalue()


def colours_of(hypothesis: Hypothesis) -> dict[int, Colour]:
    """A colour for each label, in ascending order of labels."""
    return {record.label: colour(k) for k, record in enumerate(hypothesis.objects)}


@matplotlib.style.context("mstfilter.report.figures")
def plot_recording(recording: Recording) -> Drawing:
    """Colour and depth at the pauses (at most six), and a time line of all frames with marked pauses."""
    chosen = _evenly(range(len(recording.pauses)), _MOST_PICTURES)
    n = len(chosen)
    figure = Drawing(figsize=(max(4.5, 2.3 * n), 4.6), layout="constrained")
    axes = figure.subplots(3, n, squeeze=False, gridspec_kw={"height_ratios": [1, 1, 0.22]})
    frames = [recording.frames[recording.pauses[t]] for t in chosen]
    known = np.concatenate([frame.depth[frame.valid] for frame in frames])
    low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    for k, (t, frame) in enumerate(zip(chosen, frames, strict=True)):
        axes[0, k].imshow(frame.rgb)
        axes[0, k].set_title(f"pause {t}, {recording.times[recording.pauses[t]]:.1f} s")
        image = axes[1, k].imshow(frame.depth, vmin=low, vmax=high, cmap="viridis_r")
        for axis in axes[:2, k]:
            axis.set_axis_off()
    figure.colorbar(image, ax=axes[1].tolist(), label="depth, m", shrink=0.85)
    for axis in axes[2]:
        axis.remove()
    line = figure.add_subplot(axes[2, 0].get_gridspec()[2, :])
    line.plot(recording.times, np.zeros(len(recording)), "|", color="0.7")
    line.plot([recording.times[p] for p in recording.pauses], np.zeros(len(recording.pauses)), "v", color="C1")
    line.set(yticks=[], xlabel=f"time, s; {len(recording)} frames, pauses marked")
    line.spines[["left", "right", "top"]].set_visible(False)
    return figure


@matplotlib.style.context("mstfilter.report.figures")
def plot_population(population: Population) -> Drawing:
    """Hypotheses: the six heaviest with their weights. Numbers: weighted histograms of the first coordinates."""
    population = population.realised()
    if isinstance(population.best, Hypothesis):
        return _plot_hypotheses(population)
    named = population.particles if isinstance(population.particles, Mapping) else {"x": population.particles}
    columns = {}
    for name, values in named.items():
        rows = as_matrix(np.asarray(values)) if not isinstance(values, tuple) else as_matrix(values)
        several = rows.shape[1] > 1
        columns.update({f"{name}[{j}]" if several else name: rows[:, j] for j in range(rows.shape[1])})
    shown = list(columns)[:_MOST_PICTURES]
    figure = Drawing(figsize=(2.6 * len(shown) + 0.6, 2.6), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    for axis, name in zip(axes, shown, strict=True):
        axis.hist(columns[name], bins=40, weights=population.weights, color="C0")
        axis.set(xlabel=name, yticks=[])
        axis.spines[["left", "right", "top"]].set_visible(False)
    axes[0].set_ylabel("weight")
    figure.suptitle(f"{len(population)} particles, ESS {population.ess:.1f}", fontsize=10)
    return figure


def _plot_hypotheses(population: Population) -> Drawing:
    pictures = _voxel_pictures(population)
    columns = min(3, len(pictures))
    rows = -(-len(pictures) // columns)
    figure = Drawing(figsize=(3.2 * columns, 2.6 * rows), layout="constrained")
    for axis in figure.subplots(rows, columns, squeeze=False).ravel():
        axis.set_axis_off()
    for axis, (picture, text) in zip(figure.axes, pictures, strict=False):
        axis.imshow(picture)
        axis.set_title(text, fontsize=12)
    return figure


def _voxel_pictures(population: Population) -> list[tuple[np.ndarray, str]]:
    """Pictures of the heaviest distinct hypotheses from one viewpoint, and texts with weight and objects."""
    particles, groups = population.particles, weigh_distinct(population.particles, population.weights.tolist())
    weights = [weight for _, weight in groups[:_MOST_PICTURES]]
    shown = [particles[members[0]] for members, _ in groups[:_MOST_PICTURES]]
    view = viewpoint(shown, width=420, height=315)
    return [
        (voxel_picture(h.labels, h.grid, view, colours), f"weight {weight:.2f}, {h.n_objects} objects")
        for h, weight, colours in zip(shown, weights, match_objects(shown, weights), strict=True)
    ]


def to_html(value: Any) -> str:
    """The HTML that a notebook shows for an object of the package: its text, and pictures or a table."""
    return f'<div style="max-width:60em"><pre style="margin:0">{html.escape(repr(value))}</pre>{_more(value)}</div>'


@singledispatch
def _more(value: Any) -> str:
    return ""


def _images(pictures: Sequence[tuple[bytes, str, str]], height: int = 150) -> str:
    """A row of image files with captions: (bytes, format, caption)."""
    cells = [
        f'<figure style="display:inline-block;margin:4px 8px 4px 0"><img alt="{html.escape(text)}" height="{height}" '
        f'src="{data_uri(data, kind)}"><figcaption>{html.escape(text)}</figcaption></figure>'
        for data, kind, text in pictures
    ]
    return f"<div>{''.join(cells)}</div>"


def _photo(frame: Frame, text: str) -> tuple[bytes, str, str]:
    step = max(1, frame.camera.width // 320)
    return jpeg_bytes(np.ascontiguousarray(frame.rgb[::step, ::step])), "jpeg", text


@_more.register
def _(value: Frame) -> str:
    return _images([_photo(value, "colour")])


@_more.register
def _(value: Clip) -> str:
    frames = [(value.before, "before"), (value.after, "after")]
    return _images([_photo(*pair) for pair in (frames if len(value) > 1 else frames[1:])])


@_more.register
def _(value: Recording) -> str:
    chosen = _evenly(range(len(value.pauses)), 4)
    return _images([_photo(value.frames[value.pauses[t]], f"pause {t}") for t in chosen])


@_more.register
def _(value: Hypothesis) -> str:
    view = viewpoint([value], width=480, height=360)
    picture = png_bytes(voxel_picture(value.labels, value.grid, view, colours_of(value)))
    return _images([(picture, "png", ".show() can be rotated")], 240)


@_more.register
def _(value: Population) -> str:
    if not isinstance(value.particles, Candidates) and isinstance(value.best, Hypothesis):
        return _images([(png_bytes(picture), "png", text) for picture, text in _voxel_pictures(value)])
    return ""


@_more.register
def _(value: Belief) -> str:
    return _more(value.population)


@_more.register
def _(value: State) -> str:
    return "" if value.population is None else _more(value.population)


@_more.register
def _(value: Info) -> str:
    return _more(Infos([value]))


@_more.register
def _(value: Infos) -> str:
    rows = value.rows()
    return _table(list(rows[0]), [[_number(v) for v in row.values()] for row in rows]) if rows else ""


@_more.register
def _(value: ParticleFilter) -> str:
    slots = {name: getattr(value, name) for name in value.__dataclass_fields__}
    return _table(["slot", "component"], [[name, _short(part)] for name, part in slots.items() if part is not None])


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def cells(tag: str, row: Sequence[str]) -> str:
        style = "text-align:left;padding:1px 8px"
        return "".join(f'<{tag} style="{style}">{html.escape(str(cell))}</{tag}>' for cell in row)

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div style="overflow-x:auto"><table><tr>{cells("th", head)}</tr>{body}</table></div>'


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _short(part: Any) -> str:
    text = str(part)
    return text if len(text) <= 160 else f"{text[:157]}..."


def _evenly(values: Sequence[int], n: int) -> list[int]:
    """At most `n` of the values, evenly spaced, including the first and the last."""
    if len(values) <= n:
        return list(values)
    return [values[round(k * (len(values) - 1) / (n - 1))] for k in range(n)]
