"""Figure `over_segmenting`: over-segmented samples, with and without hypotheses over time.

Every merge of the segmentation tree gets `SHIFT` more log odds of joining different objects, so that the sampled cuts
hold two to three times as many segments as there are objects. `mst` and its samples alone, each with the usual and
with the shifted value, on simulated scenes of the tuning seeds at a quarter of the studies' pixels. `mst` is the
crossover, `mst_rules` with the completion network, so that both are equal at the first pause.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from canvas import BLUE, INK, MUTED, ORANGE, page, save, write_rows
from matplotlib.axes import Axes
from scipy import stats

import mstfilter
from mstfilter.files import read_csv
from mstfilter.formats import open_recording
from mstfilter.scene import Frame
from mstfilter.scoring import weighted_coverage
from mstfilter.segmentation import CutValue, MergeLogOdds, Tree
from mstfilter.simulation import cached_recording

SHIFT = 5.0
FAMILY, SEEDS = "s1", range(8)
SIZE = {"width": 320, "height": 240}
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
ARMS = {"mst": BLUE, "samples_only": ORANGE}
PRESETS = {"mst": ("mst_rules", "proposal.completer=network"), "samples_only": ("samples_only",)}
COLUMNS = ("seed", "value", "arm", "pause", "quality", "objects", "true objects")


@dataclass(frozen=True)
class TooFine(CutValue):
    """Merge log odds reduced by `shift` for each merge inside a node: cuts are finer than the tree's odds imply.

    Parameters
    ----------
    shift : float
        In log odds.
    """

    shift: float = SHIFT

    def values(self, tree: Tree, frame: Frame) -> np.ndarray:
        """Values of `MergeLogOdds` minus `shift` for each merge inside the node."""
        merges = tree.accumulate(np.ones(tree.n_leaves)) - 1
        return MergeLogOdds().values(tree, frame) - self.shift * merges


def make(out: Path, smoke: bool) -> list[Path]:
    """Add missing scenes to the table and draw the figure."""
    path = out / "over_segmenting.csv"
    rows = []
    if path.exists():
        rows = [list(row.values()) for row in read_csv(path)]
    done = {int(row[0]) for row in rows}
    for seed in SEEDS[:1] if smoke else SEEDS:
        if seed not in done:
            rows += scene(seed, smoke)
            write_rows(path, COLUMNS, rows)
    return [path, picture(path, out / "over_segmenting.svg")]


def scene(seed: int, smoke: bool) -> list[list[object]]:
    """One row per arm, value and pause: mean quality and number of objects of the hypotheses."""
    recording = open_recording(cached_recording(FAMILY, seed, **(SMALL if smoke else SIZE)))
    rows: list[list[object]] = []
    for value in ("usual", "too fine"):
        for arm in ARMS:
            filter = mstfilter.preset(*PRESETS[arm], *(["n=2"] if smoke else []))
            if value == "too fine":
                filter = replace(filter, proposal=replace(filter.proposal, value=TooFine()))
            for state, info in filter.iterate(recording.clips(), 0):
                truth, found = recording.truth(info.t), state.population.particles
                quality = float(np.mean([weighted_coverage(h.labels, truth) for h in found]))
                n_true = int(np.count_nonzero(np.bincount(truth.ravel())[1:]))
                rows.append([seed, value, arm, info.t, quality, float(np.mean([h.n_objects for h in found])), n_true])
                print(*rows[-1], flush=True)
    return rows


def picture(table: Path, path: Path) -> Path:
    """Quality and number of objects over pauses, means over scenes with 95 % t intervals, and the gain of mst."""
    rows = read_csv(table)
    figure, axes = page(1, 3, 11.0, 3.5)
    for (value, dashes), (arm, colour) in product((("usual", (3, 2)), ("too fine", (None, None))), ARMS.items()):
        for panel, column in zip(axes[0], ("quality", "objects"), strict=False):
            name = f"{arm.replace('_', ' ')}, {value}"
            style = {"dashes": dashes} if value == "usual" else {"lw": 2.2, "marker": "o", "ms": 4.5}
            curve(panel, by_pause(rows, value, arm, column), color=colour, label=name, band=value != "usual", **style)
    true = {int(row["pause"]): float(row["true objects"]) for row in rows}
    axes[0, 1].plot(list(true), list(true.values()), color=INK, lw=1, dashes=(1, 2), label="true")
    for value, dashes in (("usual", (3, 2)), ("too fine", (None, None))):
        ours, theirs = (by_pause(rows, value, arm, "quality") for arm in ARMS)
        gain = {t: ours[t] - theirs[t] for t in ours}
        curve(axes[0, 2], gain, color=INK, label=value, band=True, dashes=dashes, marker="o", ms=4.5)
    axes[0, 2].axhline(0, color=MUTED, lw=0.8)
    scenes = len({row["seed"] for row in rows})
    for panel, title in zip(
        axes[0],
        (f"Quality, {scenes} simulated scenes", "Objects in a hypothesis", "Quality: mst minus samples only"),
        strict=True,
    ):
        panel.set_title(title)
        panel.set_xlabel("pause")
        panel.set_xticks(sorted(true))
        panel.grid(axis="y")
    axes[0, 1].set_ylim(bottom=0)
    axes[0, 2].legend(loc="upper left")
    handles, labels = axes[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=9)
    return save(figure, path)


def by_pause(rows: list[dict[str, str]], value: str, arm: str, column: str) -> dict[int, np.ndarray]:
    """Pause -> one number per scene, in the order of the scenes."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if row["value"] == value and row["arm"] == arm:
            found.setdefault(int(row["pause"]), []).append(float(row[column]))
    return {t: np.array(x) for t, x in found.items()}


def curve(axes: Axes, values: dict[int, np.ndarray], *, color: str, band: bool, **style: Any) -> None:
    """Means, and a band of the 95 % t interval over scenes."""
    times, mean = list(values), np.array([x.mean() for x in values.values()])
    style = {k: v for k, v in style.items() if k != "dashes" or v[0] is not None}
    axes.plot(times, mean, color=color, **style)
    n = len(next(iter(values.values())))
    if band and n > 1:
        half = stats.t.ppf(0.975, n - 1) * np.array([x.std(ddof=1) for x in values.values()]) / np.sqrt(n)
        axes.fill_between(times, mean - half, mean + half, color=color, alpha=0.13, lw=0)
