"""Small recordings for studies, and an executor without processes."""

from __future__ import annotations

import numpy as np

from mstfilter.base.files import read_csv
from mstfilter.formats import RecordingWriter
from mstfilter.runs.study import Executor
from mstfilter.runs.study.jobs import perform
from mstfilter.scene import scene_cache
from tests.scene.scenes import CAMERA, GRID, table_scene


def slide(path, seed=0, pauses=3):
    """Three pauses; box 1 slides 2 voxels to the right between them."""
    rng = np.random.default_rng(seed)
    with RecordingWriter(path, CAMERA, GRID) as writer:
        for index in range(2 * pauses - 1):
            rgb, depth, labels = table_scene(index, rng)
            writer.add_frame(rgb, depth, index / 5, "action" if index % 2 else "static")
            if index % 2 == 0:
                writer.add_voxels(labels)
    return path


def table(path, name="runs.csv"):
    """The rows of a table of a study."""
    return read_csv(path / name)


def metrics(path):
    """The table of runs without time and memory."""
    cost = ("core_seconds", "seconds", "peak_mb")
    return [{k: v for k, v in row.items() if not k.startswith(cost)} for row in table(path)]


class InProcess(Executor):
    """Runs jobs one after another in this process.

    For tests of plans, resuming and tables: starting a worker takes longer than a small run. `Local` has its
    own tests.
    """

    def run(self, jobs, tell):
        scene_cache.clear()  # as in a new worker
        outcomes = []
        for k, job in enumerate(jobs):
            outcomes.append(perform(job))
            tell(k, outcomes[-1])
        return outcomes
