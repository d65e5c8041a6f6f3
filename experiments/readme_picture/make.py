"""The picture of the README: pauses of a simulated recording, hypotheses over the image, voxels.

    python experiments/readme_picture/make.py [--seed 0] [--out docs/images/demo.png]
    python experiments/readme_picture/make.py --smoke --out FILE    # a small scene: shows only that it works

Rows are the first, second and last pause. Columns are the image, the heaviest hypothesis, the hypothesis that differs
most from it, and the voxels of the heaviest hypothesis. An object has the same colour in all pictures.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from mstfilter.presets import load_config
from mstfilter.report import assign_identities, overlay, viewpoint, voxel_picture
from mstfilter.runs import RunFolder, filter_recording
from mstfilter.scene import project
from mstfilter.scoring import weighted_coverage
from mstfilter.simulation import scene_family, simulate_recording

WIDTH, HEIGHT = 400, 300
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
PICTURE = Path("docs/images/demo.png")
HEADS = ("image", "heaviest hypothesis", "another hypothesis", "heaviest: voxels")


def window(masks: list[np.ndarray], shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of the image around all objects of all pauses, with the proportions of the picture."""
    rows, columns = np.nonzero(np.any(masks, axis=0))
    centre = np.array([rows.min() + rows.max(), columns.min() + columns.max()]) / 2
    half = 1.25 * max((rows.max() - rows.min()) / HEIGHT, (columns.max() - columns.min()) / WIDTH) / 2
    size = np.minimum(np.array([HEIGHT, WIDTH]) * half, np.array(shape) / 2)
    low = np.clip(centre - size, 0, np.array(shape) - 2 * size).astype(int)
    high = low + (2 * size).astype(int)
    return slice(low[0], high[0]), slice(low[1], high[1])


def draw(run: RunFolder, out: Path) -> None:
    """Draw three pauses of a run below each other."""
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    colours, pauses = assign_identities(run), (0, 1, run.n_pauses - 1)
    everything = [h for t in pauses for h in run.hypotheses(t)]
    view = viewpoint(everything, run.camera(0), WIDTH, HEIGHT)
    masks = [project(h, run.camera(0)) > 0 for h in everything]
    box = window(masks, masks[0].shape)
    with matplotlib.style.context("mstfilter.report.figures"):
        figure = Figure((8.75, 5.2), layout="constrained")
        FigureCanvasAgg(figure)
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
        for t, line in zip(pauses, figure.subplots(3, 4), strict=True):
            hypotheses, camera, rgb = run.hypotheses(t), run.camera(t), run.rgb(t)
            heaviest = int(np.argmax(run.info(t)["weights"]))
            other = int(np.argmin([weighted_coverage(h.labels, hypotheses[heaviest].labels) for h in hypotheses]))
            labels, grid, own = hypotheses[heaviest].labels, hypotheses[heaviest].grid, colours.colours(t, heaviest)
            cells = [rgb[box]]
            cells += [
                overlay(rgb, project(hypotheses[k], camera), colours.colours(t, k))[box] for k in (heaviest, other)
            ]
            cells.append(voxel_picture(labels, grid, view, own))
            for axes, cell, head in zip(line, cells, HEADS, strict=True):
                axes.imshow(cell, aspect="auto", interpolation="antialiased")
                axes.set(xticks=[], yticks=[])
                axes.set_title(head if t == 0 else "", fontsize=12.5)  # also readable on a telephone
                axes.spines[:].set_visible(False)
                axes.title.set_horizontalalignment("left")
            seconds = run.description["recording"]["times"][t]
            line[0].set_ylabel(f"pause {t}, {seconds:.0f} s", fontsize=12.5)
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, dpi=150, metadata={"Software": None})


def main(seed: int, out: Path, smoke: bool) -> None:
    """Simulate, filter, draw."""
    with tempfile.TemporaryDirectory() as folder:
        family = replace(scene_family("demo"), **SMALL) if smoke else scene_family("table")
        recording = simulate_recording(family, seed, Path(folder) / "recording")
        draw(filter_recording(recording, load_config("mst"), Path(folder) / "run", seed=0), out)
    print(out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=PICTURE)
    parser.add_argument("--smoke", action="store_true", help="a small scene; needs --out")
    arguments = parser.parse_args()
    if arguments.smoke and arguments.out == PICTURE:
        parser.error("--smoke would overwrite the picture: name another file with --out")
    main(arguments.seed, arguments.out, arguments.smoke)
