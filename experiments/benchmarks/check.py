"""Time that `mstfilter check` takes for resamplers.

    OMP_NUM_THREADS=1 python experiments/benchmarks/check.py [--rounds 3]

The schemes run in turns; the figures are medians over the rounds of the processor time in seconds.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from mstfilter.presets import REGISTRY
from mstfilter.testing import run_contract

SCHEMES = ("systematic", "multinomial", "residual", "ssp", "killing", "fearnhead_clifford", "clusters")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    seconds: dict[str, list[float]] = {name: [] for name in SCHEMES}
    for _ in range(options.rounds):
        for name in SCHEMES:
            start = time.process_time()
            run_contract(REGISTRY.build("resampler", name))
            seconds[name].append(time.process_time() - start)
    for name, values in seconds.items():
        print(f"check resampler.{name:<20s} {np.median(values):6.1f} s")


if __name__ == "__main__":
    main()
