"""Figure `sampled_cuts`: cuts of the segmentation tree of one simulated frame, on the tree and over the image.

The figure shows the optimal cut, and the first two cuts with other objects that the sampler of `mst` draws. The
height of a merge is its log odds of joining different objects, or the largest log odds of a merge inside it. Merges
with log odds below `LEAST` are not drawn unless a cut divides them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from canvas import INK, MUTED, crop, page, save, show
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from teaser import FEW

import mstfilter
from mstfilter.app.report import UNASSIGNED_COLOUR, Colour, colour, overlay
from mstfilter.lab.simulation import SimulatedScene, scene_family
from mstfilter.mst.segmentation import Segments, Tree, optimal_cut
from mstfilter.scene import Frame

FAMILY, SEED = "s2", 0
LEAST = -6.0
ABOVE = (176, 179, 175)


def make(out: Path, smoke: bool) -> list[Path]:
    """Draw the figure."""
    family = replace(scene_family(FAMILY), **({"width": 160, "height": 120, **FEW} if smoke else {}))
    scene = SimulatedScene(family, SEED)
    shot = scene.frame_images(0)
    frame = Frame(shot["rgb"], shot["depth"], scene.camera)
    proposal = mstfilter.preset("mst").proposal
    tree, w = proposal.tree_of(frame, family.grid())
    found = proposal.objects.segments(tree, frame, family.grid())
    drawn = proposal.sampler.sample(np.random.default_rng(0), tree, w, 50)
    best = optimal_cut(tree, w)
    shown, probability = [best], [0.0]
    for cut, log_p in zip(drawn.cuts, drawn.log_p, strict=True):
        if len(shown) < 3 and all(set(objects(found, cut)) != set(objects(found, other)) for other in shown):
            shown.append(cut)
            probability.append(float(log_p))

    colours = colours_of(tree, found, shown)
    part = Drawn.of(tree, shown)
    box = crop(scene.truth(), family.grid(), scene.camera)
    figure, axes = page(2, len(shown), 11.0, 6.3)
    for k, (cut, log_p) in enumerate(zip(shown, probability, strict=True)):
        own = {int(n): colours.get(int(n), UNASSIGNED_COLOUR) for n in cut}
        draw_tree(axes[0, k], part, own, ylabel=k == 0)
        name = "The best cut" if k == 0 else f"Sampled, {np.exp(log_p):.2g} as probable"
        axes[0, k].set_title(f"{name}: {len(objects(found, cut))} objects")
        labels = np.where(found.object_pixels, np.where(found.is_object[cut], cut, 0)[tree.label_image(cut)], 0)
        show(axes[1, k], overlay(shot["rgb"], labels, own, fill=0.55)[box])
    return [save(figure, out / "sampled_cuts.png", 50 if smoke else 105)]


def objects(found: Segments, cut: np.ndarray) -> list[int]:
    """The nodes of a cut that count as objects."""
    return [int(n) for n in cut if found.is_object[n]]


def colours_of(tree: Tree, found: Segments, cuts: Sequence[np.ndarray]) -> dict[int, Colour]:
    """A colour for each object; objects of different cuts that overlap have the same colour."""
    names: dict[int, int] = {}
    for cut in cuts:
        used: set[int] = set()
        for node in sorted(objects(found, cut), key=lambda n: -int((tree.mask(n) & found.object_pixels).sum())):
            mask = tree.mask(node)
            like = [(jaccard(mask, tree.mask(other)), name) for other, name in names.items() if name not in used]
            best = max(like, default=(0.0, -1))
            names[node] = names.get(node, best[1] if best[0] > 0.5 else len(set(names.values())))
            used.add(names[node])
    return {node: colour(name) for node, name in names.items()}


def jaccard(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((a & b).sum() / (a | b).sum())


@dataclass(frozen=True)
class Drawn:
    """The upper part of a tree, for drawing.

    Parameters
    ----------
    inside : dict
        Node -> its drawn children; an empty list for a node below which nothing is drawn.
    x, y : dict
        Position of each drawn node.
    root : int
    """

    inside: dict[int, list[int]]
    x: dict[int, float]
    y: dict[int, float]
    root: int

    @classmethod
    def of(cls, tree: Tree, cuts: Sequence[np.ndarray]) -> Drawn:
        """The merges of a tree above `LEAST`, and the merges that a cut divides."""
        odds = np.where(np.arange(tree.n_nodes) < tree.n_leaves, -np.inf, tree.odds)
        taken = np.zeros(tree.n_nodes, bool)  # has a node of a cut strictly inside
        for cut in cuts:
            for node in cut.tolist():
                while node != tree.root:
                    node = int(tree.parent[node])
                    taken[node] = True
        for node in range(tree.n_nodes - 1):
            odds[tree.parent[node]] = max(odds[tree.parent[node]], odds[node])
        top = float(odds[:-1].max()) + 2  # the root joins different objects with certainty
        inside: dict[int, list[int]] = {}
        x: dict[int, float] = {}
        y: dict[int, float] = {}
        stack = [tree.root]
        while stack:
            node = stack.pop()
            whole = node < tree.n_leaves or not (odds[node] > LEAST or taken[node])
            inside[node] = [] if whole else list(tree.children[node])
            y[node] = LEAST - 1 if whole else top if node == tree.root else max(float(odds[node]), LEAST - 0.5)
            if whole:
                x[node] = float(len(x))
            stack.extend(inside[node])
        for node in sorted(inside):  # children come before their parents
            if inside[node]:
                x[node] = float(np.mean([x[c] for c in inside[node]]))
        return cls(inside, x, y, tree.root)


def draw_tree(axes: Axes, part: Drawn, cut: dict[int, Colour], ylabel: bool) -> None:
    """Draw the tree, grey above the cut and in the segments' colours below, with a disc on each node of the cut."""
    lines, colours, widths = [], [], []
    stack: list[tuple[int, Colour | None]] = [(part.root, None)]
    while stack:
        node, own = stack.pop()
        own = cut.get(node, own)
        for child in part.inside[node]:
            x, y = part.x[child], part.y[node]
            lines.append([(part.x[node], y), (x, y), (x, part.y[child])])
            colours.append(tuple(np.array(ABOVE if own is None else own) / 255))
            widths.append(0.9 if own is None or own == UNASSIGNED_COLOUR else 1.6)
            stack.append((child, own))
    axes.add_collection(LineCollection(lines, colors=colours, lw=widths))
    for node, own in cut.items():
        size = 16 if own == UNASSIGNED_COLOUR else 55
        axes.scatter(
            part.x[node], part.y[node], s=size, color=[np.array(own) / 255], edgecolors=INK, lw=0.7, zorder=3
        )
    axes.axhline(0, color=MUTED, lw=0.7, dashes=(3, 3), zorder=0)
    axes.set(
        xlim=(-1, max(part.x.values()) + 1),
        ylim=(LEAST - 1.6, part.y[part.root] + 0.6),
        xticks=[],
        yticks=range(-5, 11, 5),
    )
    axes.spines["bottom"].set_visible(False)
    if ylabel:
        axes.set_ylabel("log odds: different objects")
