"""Figure `merging`: merges of two real hypotheses, step by step.

The first row shows a sample, a prediction and their conflict graph. Each of two further rows shows the same random
order with other merges, the painted objects, and the result of the mode filter. The particles are the authors' (see
r1.py), and the fusion is the fusion of `paper`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import networkx as nx
import numpy as np
from canvas import INK, MUTED, page, save, show, voxels
from matplotlib.axes import Axes
from r1 import NOTICE, Particles, folder

from mstfilter.app.report import Colour, viewpoint
from mstfilter.mst.crossover import (
    PREDICTED,
    PROPOSED,
    ConflictGraph,
    ConflictResolution,
    Crossover,
    Structure,
    assign_labels,
    conflict_graph,
)
from mstfilter.runs.presets import REGISTRY, load_config

SAMPLE, PREDICTION = 2, 2  # the pair with the fewest conflicts of those that the authors' program kept
SEED = 0
COOL = ("#bfe3c0", "#2ca281", "#12305c", "#336fb9", "#a3d3eb")
WARM = ("#f7d98b", "#ee9138", "#c9302c", "#5e0d2a", "#e8a0b0")
Edges = list[tuple[int, int]]


@dataclass(frozen=True)
class Replay(Structure):
    """A structure that returns given draws: (order, edges) of each component, by the component's first vertex."""

    drawn: dict[int, tuple[list[int], Edges]]

    def draw(self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]) -> tuple[list[int], Edges]:
        """The given draw."""
        return self.drawn[component[0]]


def make(out: Path, smoke: bool) -> list[Path]:
    """Draw the figure; returns no paths if the data are missing."""
    found = folder()
    if found is None:
        return []
    particles = Particles(found)
    return [picture(particles, out / "merging.png", smoke)]


def picture(particles: Particles, path: Path, smoke: bool) -> Path:
    """The steps for one pair."""
    sample, prediction = particles.samples[SAMPLE], particles.predictions[PREDICTION]
    crossover: Crossover = REGISTRY.build("crossover", load_config("paper")["update"]["crossover"])
    graph = conflict_graph(sample.labels, prediction.labels)
    rng = np.random.default_rng(SEED)
    links = graph.networkx()
    drawn = {c[0]: crossover.structure.draw(rng, links, c) for c in graph.components()}
    fixed = replace(crossover, structure=Replay(drawn))
    first = second = fixed.resolve(rng, graph)
    while np.array_equal(first.group, second.group):  # many merges are certain or impossible
        second = fixed.resolve(rng, graph)

    colours, places = colours_of(graph), layout(graph)
    size = (240, 180) if smoke else (600, 450)
    view = viewpoint([sample, prediction], None, *size)
    figure, axes = page(3, 3, 11.0, 8.7)
    for k, (title, side, one) in enumerate(
        (("A sample of the new image", PROPOSED, sample), ("A moved earlier hypothesis", PREDICTED, prediction))
    ):
        own = {int(graph.label[v]): colours[v] for v in range(len(graph)) if graph.side[v] == side}
        show(axes[0, k], voxels(one.labels, one.grid, view, own), f"{title}: {one.n_objects} objects")
    draw_graph(axes[0, 2], graph, places, colours)
    axes[0, 2].set_title(f"Conflict graph: {len(graph.edges)} overlaps")
    directed = [edge for _, edges in drawn.values() for edge in edges]
    for row, draw in enumerate((first, second), start=1):
        own = {v + 1: colours[v] for v in range(len(graph))}
        labels = assign_labels(graph, draw, sample.labels, prediction.labels)
        smooth = fixed.mode_filter.apply(labels)
        draw_graph(axes[row, 0], graph, places, [colours[g] for g in draw.group], directed, draw)
        axes[row, 0].set_title(("A random order; bold: merged", "The same order, other merges")[row - 1])
        show(axes[row, 1], voxels(labels, sample.grid, view, own), f"Painted: {count(labels)} objects")
        title = f"After the mode filter: {count(smooth)} objects"
        show(axes[row, 2], voxels(smooth, sample.grid, view, own), title)
    figure.supxlabel(NOTICE, fontsize=9, color=MUTED)
    return save(figure, path, 50 if smoke else 115)


def count(labels: np.ndarray) -> int:
    """Number of objects in a label grid."""
    return int(np.count_nonzero(np.bincount(labels.ravel())[1:]))


def colours_of(graph: ConflictGraph) -> list[Colour]:
    """Cool colours for objects of the sample, warm ones for objects of the prediction; successive colours differ."""
    from matplotlib.colors import LinearSegmentedColormap

    colours: list[Colour] = [(0, 0, 0)] * len(graph)
    for side, ramp in ((PROPOSED, COOL), (PREDICTED, WARM)):
        shade = LinearSegmentedColormap.from_list("ramp", ramp)
        for k, v in enumerate(np.flatnonzero(graph.side == side).tolist()):
            r, g, b = (int(x) for x in np.rint(255 * np.array(shade((0.15 + k * 0.618) % 1.0)[:3])))
            colours[v] = (r, g, b)
    return colours


def layout(graph: ConflictGraph) -> np.ndarray:
    """Positions (n, 2) of the objects: sample above, prediction below, components side by side, few crossings."""
    places, left = np.zeros((len(graph), 2)), 0.0
    neighbours = graph.networkx().adj
    for component in graph.components():
        rows = {y: [v for v in component if graph.side[v] == side] for y, side in ((1.0, PROPOSED), (0.0, PREDICTED))}
        width = max(len(row) for row in rows.values())
        for turn in range(16):
            y, row = list(rows.items())[turn % 2]
            if turn:  # each vertex at the mean of its neighbours
                row.sort(key=lambda v: float(np.mean(places[list(neighbours[v]), 0])))
            for k, v in enumerate(row):
                places[v] = left + (k + 0.5) * width / len(row), y
        left += width + 0.6
    return places


def draw_graph(
    axes: Axes,
    graph: ConflictGraph,
    places: np.ndarray,
    colours: Sequence[Colour],
    directed: Edges = (),
    draw: ConflictResolution | None = None,
) -> None:
    """The conflict graph; with a draw, arrows start at the object painted first, and merged conflicts are bold."""
    conflicts = directed or [(a, b) for a, b in graph.edges.tolist()]
    for a, b in conflicts:
        merged = draw is not None and draw.group[a] == draw.group[b]
        axes.annotate(
            "",
            places[b],
            places[a],
            arrowprops={
                "arrowstyle": "-|>" if draw else "-",
                "color": INK if merged else ("#a9aca8" if draw else MUTED),
                "lw": 2.0 if merged else 0.8,
                "shrinkA": 7,
                "shrinkB": 7,
                "mutation_scale": 9,
            },
        )
    for side, mark in ((PROPOSED, "o"), (PREDICTED, "s")):
        own = np.flatnonzero(graph.side == side)
        fill = np.array([colours[v] for v in own]) / 255
        axes.scatter(*places[own].T, s=150, c=fill, marker=mark, edgecolors=INK, linewidths=0.8, zorder=3)
    if draw is not None:
        for number, v in enumerate(draw.order, start=1):
            bright = np.dot(colours[v], (0.3, 0.59, 0.11)) > 140
            style = {"ha": "center", "va": "center", "fontsize": 8.6, "zorder": 4}
            axes.text(*places[v], str(number), color=INK if bright else "white", **style)
    else:
        axes.text(places[:, 0].mean(), 1.2, "objects of the sample", ha="center", color=MUTED)
        axes.text(places[:, 0].mean(), -0.24, "objects of the prediction", ha="center", color=MUTED)
    axes.set(xlim=(places[:, 0].min() - 0.7, places[:, 0].max() + 0.7), ylim=(-0.4, 1.4))
    axes.set_axis_off()
