"""A trigger: when to resample.

mstfilter check ./trigger.py:MyTrigger
mstfilter run demo/recording trigger=./trigger.py:MyTrigger --out runs/mine --replace
python trigger.py
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from mstfilter.base.errors import InputError
from mstfilter.smc import Population, Trigger, bootstrap, linear_gaussian


@dataclass(frozen=True)
class MyTrigger(Trigger):
    """Resamples if one particle has more than a given share of the weight. Fields need an annotation and a default.

    Parameters
    ----------
    share : float
        Share of the total weight, in (0, 1).
    """

    share: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.share < 1:
            raise InputError(f"share is {self.share}, expected a number in (0, 1)")

    def wants(self, population: Population, t: int) -> bool:
        """True to resample; t counts observations from 0. Weights are normalised, log weights are not."""
        return bool(population.weights.max() > self.share)


if __name__ == "__main__":
    # x_0 ~ N(0, 1), x_t ~ N(0.9 x_{t-1}, 0.5), y_t ~ N(x_t, 1)
    model = linear_gaussian(F=[[0.9]], Q=[[0.5]], H=[[1.0]], R=[[1.0]], m0=[0.0], P0=[[1.0]])
    filter = replace(bootstrap(model, n=1000), trigger=MyTrigger(share=0.002))
    state, infos = filter.run([[0.3], [-0.1], [0.8]], seed=0)
    print("mean", state.population.weights @ state.population.particles, "ESS", [round(info.ess) for info in infos])
