"""Small recordings for studies, and an executor without processes."""

from __future__ import annotations

import numpy as np

from mstfilter.formats import RecordingWriter
from mstfilter.scene import scene_cache
from mstfilter.study import Executor
from mstfilter.study.jobs import perform
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


class InProcess(Executor):
    """Runs jobs one after another in this process.

    For tests of plans, resuming and tables: starting a worker takes longer than a small run. `Local` and `Cluster`
    have their own tests.
    """

    def run(self, jobs, tell):
        scene_cache.clear()  # as in a new worker
        outcomes = []
        for k, job in enumerate(jobs):
            outcomes.append(perform(job))
            tell(k, outcomes[-1])
        return outcomes
