"""The run that `test_running` kills: ``killed.py KIND PATH``. It continues from what PATH holds.

`checkpoint` is one run with a checkpoint file; `run_many` stores finished runs of two filters in a folder.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from mstfilter.smc import (
    Multinomial,
    Normal,
    StateSpaceModel,
    bootstrap,
    linear_gaussian,
    log_evidence,
    mean,
    run_many,
)

MODEL = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.6), lambda x: Normal(x, 0.4))
LINEAR = linear_gaussian(*np.array([[[0.9]], [[0.36]], [[1.0]], [[0.16]]]), [0.0], [[1.0]])
OBSERVATIONS = np.random.default_rng(0).normal(size=60).tolist()


def run(kind: str, path: Path) -> None:
    """Run, or continue; the results of the folders are also written as history.npz."""
    if kind == "checkpoint":
        bootstrap(MODEL, 2000).run(OBSERVATIONS, 3, checkpoint=path)
        return
    model = replace(LINEAR, batched=False)  # runs that are processed together are stored together
    arms = {"systematic": bootstrap(model, 500), "multinomial": bootstrap(model, 500, Multinomial())}
    history = run_many(arms, OBSERVATIONS, range(8), folder=path, log_evidence=log_evidence, mean=mean)
    np.savez(path / "history.npz", **history)


if __name__ == "__main__":
    print("begun", flush=True)
    run(sys.argv[1], Path(sys.argv[2]))
