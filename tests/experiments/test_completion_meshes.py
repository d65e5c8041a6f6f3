"""The measuring script of experiments/completion on meshes: its definitions by hand, and one scene."""

from __future__ import annotations

import numpy as np
import pytest

from mstfilter.base.files import read_csv
from tests.conftest import find_shared
from tests.experiments.scripts import import_script, run_script

meshes = import_script("completion/meshes.py")


def sphere(radius: float, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Occupancy of a ball in a crop of 20 voxels of 1 cm, and points on a sphere of 6 cm at its middle."""
    centres = (np.indices((20, 20, 20)).reshape(3, -1).T + 0.5) * 0.01
    distance = np.linalg.norm(centres - 0.1, axis=1) - radius
    rays = np.random.default_rng(0).normal(size=(3000, 3))
    points = 0.1 + 0.06 * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.clip(0.5 - distance / 0.01, 0, 1).reshape(20, 20, 20), points + [shift, 0, 0]


def test_distances_of_spheres():
    """Concentric spheres: the difference of the radii, and about 2 mm for the spacing of points."""
    for radius, expected, near in ((0.06, 0.0, 1.0), (0.063, 3.0, 0.95), (0.053, 7.0, 0.0)):
        p, surface = sphere(radius)
        found, within = meshes.surface_distances(p, surface)
        assert expected - 0.1 < found < expected + 2.2 and within == pytest.approx(near, abs=0.05)
    p, surface = sphere(0.06)
    moved = sphere(0.06, shift=0.01)[1]
    assert meshes.surface_distances(p, moved)[0] > meshes.surface_distances(p, surface)[0] + 0.5
    assert meshes.surface_distances(np.zeros((4, 4, 4)), surface)[1] == 0  # an empty shape has no surface


@pytest.mark.nightly
def test_one_scene_of_the_tuning_pool(tmp_path, monkeypatch):
    monkeypatch.setenv("MSTFILTER_OBJECTS", str(find_shared("meshes/index.csv").parent))
    run_script("completion/meshes.py", "make", "--scenes", "1", "--out", tmp_path / "crops")
    run_script("completion/meshes.py", "score", "--out", tmp_path / "crops", "--results", tmp_path / "results")
    rows = read_csv(tmp_path / "results/summary.csv")
    of_all = {row["completer"]: row for row in rows if row["group"] == "all"}
    assert {"extrude", "network", "prior", "posterior", "pooled"} <= set(of_all)
    assert all(0 < float(row["iou"]) < 1 for row in of_all.values())
