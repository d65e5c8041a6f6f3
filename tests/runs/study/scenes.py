"""Small recordings for studies, and studies without processes."""

from __future__ import annotations

from contextlib import contextmanager
from unittest import mock

import numpy as np

from mstfilter.base.files import read_csv
from mstfilter.formats import RecordingWriter
from mstfilter.runs.study import run_study, worker
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


class InProcess(worker.Worker):
    """Runs jobs in this process: starting a worker takes longer than a small run."""

    def perform(self, job, died=None):
        return worker.perform(job)

    def close(self):
        return 0


@contextmanager
def in_process():
    """In the block, studies run in this process, as in one new worker."""
    worker._recording.cache_clear()
    kept = scene_cache.keeps_shared, scene_cache.limit_bytes
    with mock.patch("mstfilter.runs.study.study.Worker", InProcess):
        yield
    scene_cache.keeps_shared, scene_cache.limit_bytes = kept


def run_here(*arguments, **options):
    """`run_study` without processes."""
    with in_process():
        return run_study(*arguments, workers=1, **options)
