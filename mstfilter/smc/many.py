"""Many runs: filters to compare (arms) times seeds, in parallel, with paired seeds.

>>> runs = run_many(
...     {"systematic": bootstrap(model, 100), "multinomial": bootstrap(model, 100, Multinomial())},
...     observations, seeds=range(20), workers=4, ess=ess, log_evidence=log_evidence)
>>> runs["log_evidence"].shape                         # (arm, seed, time)
(2, 20, 50)

Seeds are paired: run k of every arm has the same seed and hence the same streams, so differences between arms are
less noisy than two sets of runs would be. A run depends on its filter, its seed and the observations alone: neither
the number of workers nor another arm changes anything. Each worker keeps the numerical libraries to one thread.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.collectors import Collector, History, collect, log_evidence
from mstfilter.smc.particle_filter import ParticleFilter

__all__ = ["run_many"]


def run_many(
    arms: Mapping[str, ParticleFilter],
    observations: Iterable[Any],
    seeds: Sequence[int] = range(10),
    workers: int = 1,
    **collectors: Collector,
) -> History:
    """Run every filter with every seed.

    Parameters
    ----------
    arms : mapping
        Name -> filter.
    observations : iterable
        The same for all.
    seeds : sequence of int
        One a run; the same for all arms.
    workers : int
        Processes; 1 runs in this one.
    **collectors
        As for `collect`; the log evidence where there are none.

    Returns
    -------
    History
        Arrays (arm, seed, time, ...).
    """
    if not arms:
        raise InputError("there are no filters to run")
    if workers < 1:
        raise InputError(f"workers is {workers}, expected at least 1")
    wanted = collectors or {"log_evidence": log_evidence}
    job = {"arms": dict(arms), "observations": list(observations), "collectors": wanted}
    tasks = [(name, int(seed)) for name in arms for seed in seeds]
    if workers == 1:
        results = [_one(job, *task) for task in tasks]
    else:
        results = _in_pool(job, tasks, workers)
    shape = (len(arms), len(seeds))
    values = {}
    for name in wanted:
        stacked = np.stack([r[name] for r in results])
        values[name] = stacked.reshape(*shape, *stacked.shape[1:])
    coords = {"arm": list(arms), "seed": np.asarray(list(seeds)), "time": np.arange(len(job["observations"]))}
    return History(values, ("arm", "seed", "time"), coords)


def _one(job: Mapping[str, Any], arm: str, seed: int) -> dict[str, np.ndarray]:
    try:
        history = collect(job["arms"][arm].iterate(job["observations"], seed), **job["collectors"])
    except InputError as error:
        raise InputError(f"arm {arm!r}, seed {seed}: {error.message}", *error.hints) from error
    return dict(history)


def _in_pool(job: dict[str, Any], tasks: list[tuple[str, int]], workers: int) -> list[dict[str, np.ndarray]]:
    """Results in order. Fresh processes, not forks: a fork of a process whose libraries run threads may never return.
    The job is sent once to each batch; closures and classes of a notebook travel too (cloudpickle)."""
    from joblib import Parallel, delayed, parallel_config

    batches = [tasks[k :: 4 * workers] for k in range(min(4 * workers, len(tasks)))]
    with parallel_config("loky", n_jobs=min(workers, len(batches)), inner_max_num_threads=1):
        done = Parallel(batch_size=1)(delayed(_batch)(job, batch) for batch in batches)
    found = dict(pair for results in done for pair in results)
    return [found[task] for task in tasks]


def _batch(job: dict[str, Any], tasks: list[tuple[str, int]]) -> list[tuple[tuple[str, int], dict[str, np.ndarray]]]:
    """In a worker: one thread a library. Those that read no environment variable are told."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(1)
    return [(task, _one(job, *task)) for task in tasks]
