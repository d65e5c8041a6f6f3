"""Figure `teaser`: several hypotheses about one simulated table over time, while an object is hidden.

Columns are pauses. The rows show the image, the true volumes, and the three heaviest distinct hypotheses of `mst`
with their weights (equal hypotheses are counted as one). Voxels are seen from the camera's right. An object has
the same colour at all pauses and in all hypotheses.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from canvas import INK, LINE, MUTED, crop, page, save, show, voxels, write_rows
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from scipy.spatial.transform import RigidTransform, Rotation

from mstfilter.app.report import TRUTH, Identities, assign_identities, order_by_weight, viewpoint
from mstfilter.formats import open_recording
from mstfilter.lab.simulation import cached_recording
from mstfilter.runs import RunFolder, filter_recording
from mstfilter.runs.presets import load_config
from mstfilter.scene import Camera, Recording
from mstfilter.scoring import object_status, overlap

#: The scene of the figure `sampled_cuts`.
FAMILY, SEED = "s2", 0
FEW = {"n_objects_min": 5, "n_objects_max": 5, "n_twins": 1, "n_stacked": 1, "n_hidden": 1}
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02, **FEW}
SHOWN = 3
TURN = RigidTransform.from_rotation(Rotation.from_euler("z", 125, degrees=True))


def make(out: Path, smoke: bool) -> list[Path]:
    """Draw the figure."""
    recording = open_recording(cached_recording(FAMILY, SEED, **(SMALL if smoke else {})))
    with tempfile.TemporaryDirectory() as folder:
        run = filter_recording(recording, load_config("mst", ("n=3",) if smoke else ()), Path(folder) / "run", seed=0)
        return [picture(recording, run, out / "teaser.png", smoke), table(recording, run, out / "teaser.csv")]


def picture(recording: Recording, run: RunFolder, path: Path, smoke: bool) -> Path:
    """Draw the figure with one column per pause."""
    identities, grid = assign_identities(run), recording.grid
    truths = [recording.truth(t) for t in range(run.n_pauses)]
    everything = np.max([truth > 0 for truth in truths], axis=0)
    camera = run.camera(0)
    box = crop(everything, grid, camera)
    # From the camera's right, where hidden objects are visible.
    aside = replace(camera, T_world_camera=TURN * camera.pose)
    view = viewpoint([(everything, grid)], aside, *((160, 120) if smoke else (480, 360)))
    figure, axes = page(2 + SHOWN, run.n_pauses, 2.2 * run.n_pauses, 1.8 * (2 + SHOWN))
    for t, truth in enumerate(truths):
        status = object_status(recording, t)
        hidden, unseen = ([k for k, s in status.items() if s == wanted] for wanted in ("hidden", "unseen"))
        show(axes[0, t], run.rgb(t)[box], f"Pause {t}")
        said = ", ".join(
            f"{len(x)} {what}" for x, what in ((hidden, "hidden, seen before"), (unseen, "never seen")) if x
        )
        show(axes[1, t], voxels(truth, grid, view, identities.colours(t, TRUTH)), said or "all in sight")
        hypotheses(axes[2:, t], run, t, identities, view)
    for row, name in enumerate(("image", "truth", *(f"hypothesis {k + 1}" for k in range(SHOWN)))):
        axes[row, 0].text(
            -0.04, 0.5, name, transform=axes[row, 0].transAxes, rotation=90, va="center", ha="right", color=MUTED
        )
    return save(figure, path, 50 if smoke else 120)


def hypotheses(column: np.ndarray, run: RunFolder, t: int, identities: Identities, view: Camera) -> None:
    """Draw the heaviest distinct hypotheses of a pause."""
    found, weights = run.hypotheses(t), run.info(t)["weights"]
    first: dict[bytes, int] = {}
    total: dict[int, float] = {}
    for k in order_by_weight(weights):
        same = first.setdefault(found[k].key, k)
        total[same] = total.get(same, 0.0) + weights[k]
    order = sorted(total, key=lambda k: -total[k])
    for axes, k in zip(column, [*order, *[None] * len(column)], strict=False):
        axes.set_axis_off()
        if k is not None:
            show(axes, voxels(found[k].labels, found[k].grid, view, identities.colours(t, k)))
            bar(axes, total[k], f"{found[k].n_objects} objects")


def bar(axes: Axes, weight: float, said: str) -> None:
    """Draw the weight as a bar above the picture, with a caption."""
    for width, colour in ((0.4, LINE), (0.4 * weight, INK)):
        axes.add_patch(
            Rectangle((0.02, 1.02), width, 0.025, transform=axes.transAxes, color=colour, lw=0, clip_on=False)
        )
    axes.text(0.45, 1.01, f"{weight:.2f}   {said}", transform=axes.transAxes, fontsize=9, color=MUTED)


def table(recording: Recording, run: RunFolder, path: Path) -> Path:
    """Write the largest IoU of each object that is hidden at some pause, for every pause and hypothesis."""
    status = [object_status(recording, t) for t in range(run.n_pauses)]
    watched = sorted({k for one in status for k, s in one.items() if s != "visible"})
    rows = []
    for t in range(run.n_pauses):
        for k, hypothesis in enumerate(run.hypotheses(t)):
            found = overlap(recording.truth(t), hypothesis.labels)
            jaccard = found.jaccard()[:, found.labels_b > 0]
            for label in watched:
                row = jaccard[found.labels_a == label]
                rows.append(
                    [t, k, hypothesis.n_objects, label, status[t].get(label, ""), float(row.max(initial=0.0))]
                )
    return write_rows(path, ["pause", "hypothesis", "objects", "true object", "status", "IoU"], rows)
