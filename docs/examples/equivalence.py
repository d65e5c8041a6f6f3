"""An equivalence of numbers: particles that count as equal, for `Coalesced` and `Kld`.

mstfilter check ./equivalence.py:MyEquivalence
python equivalence.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.smc import Equivalence, Kld, Sized, bootstrap, first_seen, linear_gaussian


@dataclass(frozen=True)
class MyEquivalence(Equivalence):
    """Particles that round to the same multiples of a step are equal. Fields need an annotation and a default.

    Parameters
    ----------
    step : float
        In the units of the particles.
    """

    step: float = 0.25

    def classes(self, particles: np.ndarray) -> np.ndarray:
        """(n,) int: class of each particle, numbered from 0 in the order of first occurrence."""
        return first_seen(tuple(np.round(row / self.step).ravel().tolist()) for row in particles)


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = bootstrap(model, n=1000, resampler=Sized(size=Kld(MyEquivalence())))
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])
