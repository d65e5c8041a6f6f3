"""A resampler: selects particles by weight.

mstfilter check ./resampler.py:MyResampler
mstfilter run demo/recording resampler=./resampler.py:MyResampler --out runs/mine --replace
python resampler.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mstfilter.smc import WeightResampler, bootstrap, linear_gaussian, normalise


@dataclass(frozen=True)
class MyResampler(WeightResampler):
    """Independent draws by weight. Fields need an annotation and a default: add yours here."""

    # Set to False if the weights of the result are not those of an exact filter (for example: keep the n best).
    # The filter then reports no log evidence, and the contract does not test the weights.
    properly_weighted = True

    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose n ancestors: indices into log_weights (unnormalised, -inf is a weight of zero)."""
        # Random numbers come from rng only. The input is read-only.
        cumulative = np.cumsum(normalise(log_weights))
        points = np.sort(rng.random(n)) * cumulative[-1]
        ancestors = np.searchsorted(cumulative, points, side="right")  # "right" skips weights of zero
        # None: equal weights. Otherwise return (n,) log weights, log(w_i / expected number of copies).
        return ancestors, None


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = replace(bootstrap(model, n=1000), resampler=MyResampler())
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])
