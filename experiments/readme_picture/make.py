"""The picture of the README: pauses of a simulated recording, hypotheses over the image, voxels.

    python experiments/readme_picture/make.py [--seed 0] [--out docs/images/demo.png]
    python experiments/readme_picture/make.py --smoke --out FILE    # a small scene: shows only that it works

Rows are the first, second and last pause; columns the image, the heaviest hypothesis, the one that differs most from
it, and the voxels of the heaviest.
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
from mstfilter.scene import project, write_image
from mstfilter.scoring import weighted_coverage
from mstfilter.simulation import scene_family, simulate_recording

WIDTH, HEIGHT, GAP = 400, 300, 10
SMALL = {"width": 160, "height": 120, "n_actions": 1, "frames_per_clip": 8, "voxel_size": 0.02}
PICTURE = Path("docs/images/demo.png")
PAPER = np.array([252, 252, 250], float)


def window(masks: list[np.ndarray], shape: tuple[int, int]) -> tuple[slice, slice]:
    """The part of the image around all objects of all pauses, in the picture's proportions."""
    rows, columns = np.nonzero(np.any(masks, axis=0))
    centre = np.array([rows.min() + rows.max(), columns.min() + columns.max()]) / 2
    half = 1.25 * max((rows.max() - rows.min()) / HEIGHT, (columns.max() - columns.min()) / WIDTH) / 2
    size = np.minimum(np.array([HEIGHT, WIDTH]) * half, np.array(shape) / 2)
    low = np.clip(centre - size, 0, np.array(shape) - 2 * size).astype(int)
    high = low + (2 * size).astype(int)
    return slice(low[0], high[0]), slice(low[1], high[1])


def row(run: RunFolder, t: int, box: tuple[slice, slice], colours, view) -> np.ndarray:
    """Image, two hypotheses, voxels of a pause."""
    import cv2

    camera, rgb, hypotheses = run.camera(t), run.rgb(t), run.hypotheses(t)
    heaviest = int(np.argmax(run.info(t)["weights"]))
    other = int(np.argmin([weighted_coverage(h.labels, hypotheses[heaviest].labels) for h in hypotheses]))
    cells = [rgb[box]]
    for k in (heaviest, other):
        cells.append(overlay(rgb, project(hypotheses[k], camera), colours.colours(t, k))[box])
    shown = voxel_picture(hypotheses[heaviest].labels, hypotheses[heaviest].grid, view, colours.colours(t, heaviest))
    alpha = shown[..., 3:] / 255.0
    cells.append(np.rint(shown[..., :3] * alpha + PAPER * (1 - alpha)).astype(np.uint8))
    cells = [cv2.resize(cell, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for cell in cells]
    gap = np.broadcast_to(PAPER.astype(np.uint8), (HEIGHT, GAP, 3))
    return np.hstack([part for cell in cells for part in (cell, gap)][:-1])


def main(seed: int, out: Path, smoke: bool) -> None:
    """Simulate, filter, and paste the pauses together."""
    with tempfile.TemporaryDirectory() as folder:
        family = replace(scene_family("demo"), **SMALL) if smoke else scene_family("table")
        recording = simulate_recording(family, seed, Path(folder) / "recording")
        run = filter_recording(recording, load_config("mst"), Path(folder) / "run", seed=0)
        colours, pauses = assign_identities(run), (0, 1, run.n_pauses - 1)
        everything = [h for t in pauses for h in run.hypotheses(t)]
        view = viewpoint(everything, run.camera(0), WIDTH, HEIGHT)
        masks = [project(h, run.camera(0)) > 0 for h in everything]
        box = window(masks, masks[0].shape)
        rows = [row(run, t, box, colours, view) for t in pauses]
    gap = np.broadcast_to(PAPER.astype(np.uint8), (GAP, rows[0].shape[1], 3))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_image(out, np.vstack([part for line in rows for part in (line, gap)][:-1]))
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
