"""A similarity of numbers, for resamplers that compare particles.

mstfilter check ./similarity.py:MySimilarity
python similarity.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mstfilter.smc import ClusterStratified, Similarity, bootstrap, linear_gaussian


@dataclass(frozen=True)
class MySimilarity(Similarity):
    """Falls with the distance of two particles. Fields need an annotation and a default.

    Parameters
    ----------
    scale : float
        Distance at which the similarity is 1/e, in the units of the particles.
    """

    scale: float = 1.0

    def matrix(self, particles: np.ndarray) -> np.ndarray:
        """(n, n) symmetric similarities in [0, 1], 1 on the diagonal."""
        rows = particles.reshape(len(particles), -1)
        return np.exp(-np.linalg.norm(rows[:, None] - rows, axis=2) / self.scale)


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = replace(bootstrap(model, n=50), resampler=ClusterStratified(similarity=MySimilarity()))
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])
