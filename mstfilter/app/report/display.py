"""Shows the package's objects in a notebook: text, pictures, plots, and scenes that can be rotated.

>>> recording.plot()                        # images, depth and the time line of the pauses
>>> hypothesis.show()                       # voxels that can be rotated with the mouse, also outside a notebook
>>> hypothesis.show().save("scene.html")
>>> state.population.plot()                 # hypotheses by weight, or the distribution of each coordinate
>>> belief.objects()                        # in a notebook: the table of the report

Classes in `mstfilter.scene`, `mstfilter.smc` and `mstfilter.mst.belief` have methods `plot`, `show` and
`_repr_html_`, which import this module when they are called (`mstfilter.base.lazy.late`). HTML pages load nothing
from a network.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.style
import numpy as np

from mstfilter.app.report.answer import TABLE_HEADS, table_cells
from mstfilter.app.report.charts import Drawing
from mstfilter.app.report.identities import match_objects, weigh_distinct
from mstfilter.app.report.page import fill_template, short_text
from mstfilter.app.report.pictures import colour, data_uri, jpeg_bytes, png_bytes, viewpoint, voxel_picture
from mstfilter.mst.belief import Belief, ObjectTable
from mstfilter.scene import Clip, Frame, Hypothesis, Recording
from mstfilter.smc import Infos, Population, State, as_matrix

_MOST_PICTURES = 6


@matplotlib.style.context("mstfilter.app.report.figures")
def plot_recording(recording: Recording) -> Drawing:
    """Colour and depth images of at most six pauses, and a time line of all frames with marked pauses."""
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


@matplotlib.style.context("mstfilter.app.report.figures")
def plot_population(population: Population) -> Drawing:
    """The six most probable hypotheses; for numeric particles, weighted histograms of the first six coordinates."""
    population = population.realised()
    if shown := pictures_of(population):
        columns = min(3, len(shown))
        rows = -(-len(shown) // columns)
        figure = Drawing(figsize=(3.2 * columns, 2.6 * rows), layout="constrained")
        for axis in figure.subplots(rows, columns, squeeze=False).ravel():
            axis.set_axis_off()
        for axis, (picture, text) in zip(figure.axes, shown, strict=False):
            axis.imshow(picture)
            axis.set_title(text, fontsize=12)
        return figure
    named = population.particles if isinstance(population.particles, Mapping) else {"x": population.particles}
    columns_of: dict[str, np.ndarray] = {}
    for name, values in named.items():
        rows_of = as_matrix(values if isinstance(values, tuple) else np.asarray(values))
        several = rows_of.shape[1] > 1
        columns_of |= {f"{name}[{j}]" if several else name: column for j, column in enumerate(rows_of.T)}
    names = list(columns_of)[:_MOST_PICTURES]
    figure = Drawing(figsize=(2.6 * len(names) + 0.6, 2.6), layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    for axis, name in zip(axes, names, strict=True):
        axis.hist(columns_of[name], bins=40, weights=population.weights, color="C0")
        axis.set(xlabel=name, yticks=[])
        axis.spines[["left", "right", "top"]].set_visible(False)
    axes[0].set_ylabel("weight")
    figure.suptitle(f"{len(population)} particles, ESS {population.ess:.1f}", fontsize=10)
    return figure


def to_html(value: Any) -> str:
    """HTML that shows an object of the package in a notebook: text, and pictures, a table of steps or of objects."""
    if isinstance(value, ObjectTable):
        return fill_template(
            "objects.html", {}, head=repr(value).splitlines()[0], rows=table_cells(value), columns=TABLE_HEADS
        )
    text = f'<pre style="margin:0">{html.escape(repr(value))}</pre>'
    shown = [] if isinstance(value, Infos) else pictures_of(value)
    height = 150 if len(shown) > 1 else 240
    more = _table(value.rows()) if isinstance(value, Infos) else ""
    for picture, caption in shown:
        photo = picture.shape[2] == 3
        uri = data_uri(jpeg_bytes(picture), "jpeg") if photo else data_uri(png_bytes(picture))
        words = html.escape(caption)
        more += (
            f'<figure style="display:inline-block;margin:4px 8px 4px 0"><img alt="{words}" height="{height}" '
            f'src="{uri}"><figcaption>{words}</figcaption></figure>'
        )
    return f'<div style="max-width:60em">{text}<div style="overflow-x:auto">{more}</div></div>'


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table of rows with the same keys."""
    lines = [list(rows[0]), *(list(row.values()) for row in rows)] if rows else []
    cells = ["".join(f"<td>{html.escape(short_text(v))}</td>" for v in line) for line in lines]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in cells)}</table>"


def pictures_of(value: Any) -> list[tuple[np.ndarray, str]]:
    """Pictures of an object with captions: photos (H, W, 3), and voxels (H, W, 4). `Candidates` are not built."""
    if isinstance(value, Belief | State):
        value = value.population
    if isinstance(value, Hypothesis):
        colours = {record.label: colour(k) for k, record in enumerate(value.objects)}
        view = viewpoint([value], width=480, height=360)
        return [(voxel_picture(value.labels, value.grid, view, colours), ".show() can be rotated")]
    if isinstance(value, Population):
        return _voxel_pictures(value)
    photos: list[tuple[Frame, str]] = []
    if isinstance(value, Frame):
        photos = [(value, "colour")]
    elif isinstance(value, Clip):
        photos = [(value.before, "before"), (value.after, "after")][-len(value) :]
    elif isinstance(value, Recording):
        photos = [(value.frames[value.pauses[t]], f"pause {t}") for t in _evenly(range(len(value.pauses)), 4)]
    steps = [max(1, frame.camera.width // 320) for frame, _ in photos]
    return [(frame.rgb[::k, ::k], text) for k, (frame, text) in zip(steps, photos, strict=True)]


def _voxel_pictures(population: Population) -> list[tuple[np.ndarray, str]]:
    """The most probable distinct hypotheses from one viewpoint; empty if the particles are no hypotheses."""
    particles = population.particles
    if not (isinstance(particles, tuple) and isinstance(particles[0], Hypothesis)):
        return []
    groups = weigh_distinct(particles, population.weights.tolist())[:_MOST_PICTURES]
    weights, shown = [weight for _, weight in groups], [particles[members[0]] for members, _ in groups]
    view = viewpoint(shown, width=420, height=315)
    return [
        (voxel_picture(h.labels, h.grid, view, colours), f"weight {weight:.2f}, {h.n_objects} objects")
        for h, weight, colours in zip(shown, weights, match_objects(shown, weights), strict=True)
    ]


def _evenly(values: Sequence[int], n: int) -> list[int]:
    """At most `n` evenly spaced values, including the first and the last."""
    return [values[k] for k in np.linspace(0, len(values) - 1, min(n, len(values))).round().astype(int)]
