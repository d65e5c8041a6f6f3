"""Figure `initial`: the first pause of a scene of each family: the image, and the true objects over it and as voxels.

Scenes are simulated; seed 0 of each family.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from canvas import crop, page, save, show, voxels
from teaser import FEW

from mstfilter.report import colour, overlay, viewpoint
from mstfilter.scene import scaled_area
from mstfilter.scoring import MIN_PIXELS
from mstfilter.simulation import SimulatedScene, scene_family

FAMILIES = ("s1", "s2", "s3")
SEED = 0


def make(out: Path, smoke: bool) -> list[Path]:
    """Draw the figure."""
    small = {"width": 160, "height": 120, "voxel_size": 0.02, **FEW} if smoke else {}
    figure, axes = page(3, len(FAMILIES), 11.0, 8.6)
    for k, name in enumerate(FAMILIES):
        family = replace(scene_family(name), **small)
        scene = SimulatedScene(family, SEED)
        shot = scene.frame_images(0)
        truth, grid, camera = scene.truth(), family.grid(), scene.camera
        colours = {label: colour(label - 1) for label in range(1, int(truth.max()) + 1)}
        pixels = np.bincount(shot["instance"].ravel(), minlength=256)
        hidden = [k for k in colours if pixels[k] < scaled_area(MIN_PIXELS, camera.width * camera.height)]
        title = f"{name.upper()}: {scene.world.n_objects} objects" + (
            f", {len(hidden)} out of sight" if hidden else ""
        )
        box = crop(truth, grid, camera)
        show(axes[0, k], shot["rgb"][box], title)
        show(axes[1, k], overlay(shot["rgb"], shot["instance"], colours, fill=0.5)[box])
        view = viewpoint([(truth, grid)], camera, *((160, 120) if smoke else (600, 450)))
        show(axes[2, k], voxels(truth, grid, view, colours))
    return [save(figure, out / "initial.png", 50 if smoke else 82)]
