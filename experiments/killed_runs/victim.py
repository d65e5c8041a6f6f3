"""The run that trials.py kills: ``victim.py CHECKPOINT``. It resumes from the checkpoint if there is one."""

from __future__ import annotations

import sys

import numpy as np

from mstfilter.smc import Normal, StateSpaceModel, bootstrap

MODEL = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.6), lambda x: Normal(x, 0.4))

if __name__ == "__main__":
    observations = np.random.default_rng(0).normal(size=60).tolist()
    print("begun", flush=True)
    bootstrap(MODEL, 2000).run(observations, 3, checkpoint=sys.argv[1])
