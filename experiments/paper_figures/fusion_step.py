"""Figure `fusion_step`: the crossover of the authors' real particles at t = 1, with trivial baselines.

The score compares a hypothesis with a partition of its own voxels (r1.py). One blob scores .7 - .8 on it, connected
components of a single sample 1.0: it shows what the fusion step does, not how good the result is.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from canvas import BLUE, FLOOR, INK, MUTED, PAPER, save, show, voxels, write_rows
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from r1 import NOTICE, Particles, folder

from mstfilter.presets import REGISTRY, load_config
from mstfilter.report import colour, viewpoint
from mstfilter.scoring import connected_components, one_blob

ETA = 5
PRESETS = ("authors", "paper", "mst_rules")


def make(out: Path, smoke: bool) -> list[Path]:
    """Draw the figure and write its numbers; returns no paths if the data are missing."""
    found = folder()
    if found is None:
        return []
    particles = Particles(found)
    groups = {
        "samples": [h.labels for h in particles.samples],
        "predictions": [h.labels for h in particles.predictions],
        "shipped by\nthe authors": [h.labels for h in particles.estimates],
        **{f"crossover\nof {name}": list(fused(particles, name, 1 if smoke else ETA)) for name in PRESETS},
    }
    scores = {name: np.array([particles.score(x) for x in labels]) for name, labels in groups.items()}
    floors = {
        name: [
            float(np.mean([score(particles, floor(x), x) for x in labels]))
            for floor in (one_blob, connected_components)
        ]
        for name, labels in groups.items()
    }
    return [
        picture(particles, groups, scores, floors, out / "fusion_step.png", smoke),
        table(groups, scores, floors, weights(particles, 1 if smoke else ETA), out / "fusion_step.csv"),
    ]


def score(particles: Particles, labels: np.ndarray, of: np.ndarray) -> float:
    """Score of other labels for the same voxels."""
    assert ((labels > 0) == (of > 0)).all()
    return particles.score(labels)


def fused(particles: Particles, preset: str, eta: int) -> Iterator[np.ndarray]:
    """Labels of each pair's candidates, without the preset's claims, division and evidence, which need images."""
    crossover = REGISTRY.build("crossover", load_config(preset)["update"]["crossover"])
    rng = np.random.default_rng(0)
    for sample in particles.samples:
        for prediction in particles.predictions:
            for _ in range(eta):
                yield crossover.cross(rng, sample, prediction).labels


def weights(particles: Particles, eta: int) -> np.ndarray:
    """The authors' log weights of the pairs (25 eta,): log w = log w_i + log w_j + 3 log Q_j."""
    sample, previous, kept = particles.log_weights
    log_w = (sample[:, None] + previous + 3 * np.log(kept)).ravel().repeat(eta)
    return np.exp(log_w - log_w.max())


def table(
    groups: dict[str, list[np.ndarray]],
    scores: dict[str, np.ndarray],
    floors: dict[str, list[float]],
    w: np.ndarray,
    path: Path,
) -> Path:
    """One row per group: scores, baselines on the same voxels, objects, voxels."""
    rows = []
    for name, labels in groups.items():
        q = scores[name]
        weighted = float(np.average(q, weights=w)) if len(q) == len(w) else ""
        objects = float(np.mean([np.count_nonzero(np.bincount(x.ravel())[1:]) for x in labels]))
        size = round(float(np.mean([(x > 0).sum() for x in labels])))
        plain = name.replace("\n", " ")
        rows.append([plain, len(q), q.mean(), weighted, q.min(), q.max(), *floors[name], objects, size])
    return write_rows(
        path,
        [
            "hypotheses",
            "n",
            "mean",
            "mean by pair weight",
            "least",
            "greatest",
            "one blob",
            "components",
            "objects",
            "voxels",
        ],
        rows,
    )


def picture(
    particles: Particles,
    groups: dict[str, list[np.ndarray]],
    scores: dict[str, np.ndarray],
    floors: dict[str, list[float]],
    path: Path,
    smoke: bool,
) -> Path:
    """Scores of all hypotheses; below, the fused hypothesis with the median score of each kind."""
    figure = Figure((11.0, 6.7), layout="constrained", facecolor=PAPER)
    FigureCanvasAgg(figure)
    shown = list(groups)[2:]
    grid = figure.add_gridspec(2, len(shown), height_ratios=[1.35, 1])
    strip(figure.add_subplot(grid[0, :], facecolor=PAPER), scores, floors)
    view = viewpoint(
        [(groups[name][0], particles.grid) for name in shown], None, *((240, 180) if smoke else (520, 390))
    )
    for k, name in enumerate(shown):
        q = scores[name]
        labels = groups[name][int(np.argsort(q)[len(q) // 2])]
        # Larger objects have the first colours.
        order = np.argsort(-np.bincount(labels.ravel())[1:], kind="stable") + 1
        colours = {int(label): colour(n) for n, label in enumerate(order)}
        title = f"{name.replace(chr(10), ' ')}, median {np.sort(q)[len(q) // 2]:.2f}"
        axes = figure.add_subplot(grid[1, k])
        show(axes, voxels(labels, particles.grid, view, colours))
        axes.set_title(title, fontsize=9)
    figure.supxlabel(NOTICE, fontsize=9, color=MUTED)
    return save(figure, path, 50 if smoke else 105)


def strip(axes: Axes, scores: dict[str, np.ndarray], floors: dict[str, list[float]]) -> None:
    """One point per hypothesis, the mean of each group, and its baselines."""
    for k, (name, q) in enumerate(scores.items()):
        place = ((np.arange(len(q)) * 0.618) % 1.0 - 0.5) * 0.5
        axes.scatter(k + place, np.sort(q), s=22 if len(q) < 20 else 12, color=BLUE, alpha=0.55, lw=0)
        axes.plot([k - 0.3, k + 0.3], [q.mean()] * 2, color=INK, lw=2, label="mean" if k == 0 else None)
        for value, dash, what in zip(
            floors[name], ((4, 2), (1, 1.5)), ("one blob", "connected components"), strict=True
        ):
            label = f"baseline: {what}" if k == 0 else None
            axes.plot([k - 0.42, k + 0.42], [value] * 2, color=FLOOR, lw=1.6, dashes=dash, label=label)
    axes.set_xticks(range(len(scores)), list(scores), color=INK)
    axes.set(ylim=(0, 1.04), xlim=(-0.6, len(scores) - 0.4), ylabel="score against a partition\nof its own voxels")
    axes.grid(axis="y")
    axes.set_title("Segmentation score at t = 1 (no evidence of quality: see the baselines)")
    axes.legend(loc="lower center", ncols=3, bbox_to_anchor=(0.5, -0.33))
