"""A size: how many particles the resampler `Sized` selects.

mstfilter check ./size.py:MySize
mstfilter run demo/recording resampler=sized resampler.size=./size.py:MySize --out runs/mine --replace
python size.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import PositiveFloat, PositiveInt
from mstfilter.smc import Population, Size, Sized, bootstrap, linear_gaussian


@dataclass(frozen=True)
class MySize(Size):
    """More particles if the weights are spread over many. Fields need an annotation and a default.

    Parameters
    ----------
    factor : float
        Number of particles per unit of the perplexity, the exponential of the entropy of the weights.
    n_min, n_max : int
        Bounds of the answer.
    """

    factor: PositiveFloat = 2.0
    n_min: PositiveInt = 10
    n_max: int = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_max < self.n_min:
            raise InputError(f"n_max is {self.n_max}, less than n_min, {self.n_min}")

    def choose(self, population: Population) -> int:
        """An integer of at least 1, from the weighted particles before the resampling."""
        weights = population.weights[population.weights > 0]
        perplexity = float(np.exp(-(weights @ np.log(weights))))
        # Rounded, since the last bits of a sum depend on the order of the particles.
        return int(np.clip(np.ceil(round(self.factor * perplexity, 6)), self.n_min, self.n_max))


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = bootstrap(model, n=1000, resampler=Sized(size=MySize()))
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])
