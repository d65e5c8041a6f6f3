"""How many particles a resampling makes: a fixed number, or as many as the posterior needs (KLD).

>>> import numpy as np
>>> from mstfilter.smc.population import Population
>>> spread = Population(np.linspace(0, 10, 200))
>>> peaked = Population(np.linspace(0, 10, 200), -50.0 * (np.linspace(0, 10, 200) - 5.25) ** 2)
>>> size = Kld(equivalence=Bins(0.5), epsilon=0.05, n_min=10)
>>> size.choose(spread), size.choose(peaked)
(374, 47)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.smc.fields import number, part, whole
from mstfilter.smc.interfaces import Size
from mstfilter.smc.population import Population
from mstfilter.smc.similarity import Bins, Equivalence

__all__ = ["Fixed", "Kld"]


@dataclass(frozen=True)
class Fixed(Size):
    """Always the same number.

    Parameters
    ----------
    n : int
        Particles, at least 1.
    """

    n: int = 100

    def __post_init__(self) -> None:
        whole("n", self.n)

    def choose(self, population: Population) -> int:
        """`n`."""
        return self.n


@dataclass(frozen=True)
class Kld(Size):
    """Enough particles that the distribution over bins is known to a Kullback-Leibler distance epsilon.

    With k bins occupied that takes n = chi2_{k-1}(1 - delta) / (2 epsilon) draws (Fox 2003, "Adapting the sample
    size in particle filters through KLD-sampling"). Fox counts bins while he draws; but all bins and their masses
    W_b are known before, so here n is the least number with n >= bound(sum_b 1 - (1 - W_b)^n), the bins that n
    draws are expected to meet. That serves any resampling scheme, and gives slightly more than drawing one by one,
    which stops at the first lucky moment.

    Parameters
    ----------
    equivalence : Equivalence
        The bins: a grid for vectors, classes of equal particles for objects.
    epsilon : float
        Distance in nats, positive.
    delta : float
        Probability that the distance is larger, in (0, 1).
    n_min, n_max : int
        Bounds of the answer. One occupied bin gives `n_min`.
    """

    equivalence: Equivalence = Bins()  # noqa: RUF009 (frozen)
    epsilon: float = 0.05
    delta: float = 0.01
    n_min: int = 10
    n_max: int = 100_000

    def __post_init__(self) -> None:
        part("equivalence", self.equivalence, Equivalence)
        number("epsilon", self.epsilon, above=0, unit="distance in nats")
        number("delta", self.delta, above=0, below=1, unit="probability")
        whole("n_min", self.n_min)
        whole("n_max", self.n_max, f"n_min is {self.n_min}", at_least=self.n_min)

    def choose(self, population: Population) -> int:
        """The least sufficient number within the bounds."""
        population = population.realised()
        mass = np.bincount(self.equivalence.classes(population.particles), population.weights)
        mass = np.minimum(mass[mass > 0], 1.0)
        n = self.n_min
        # The right side grows with n, so going up from n_min meets the least solution.
        while n < self.n_max:
            with np.errstate(divide="ignore"):
                occupied = -np.expm1(n * np.log1p(-mass)).sum()
            enough = int(np.ceil(self.bound(occupied)))
            if enough <= n:
                break
            n = enough
        return min(n, self.n_max)

    def bound(self, k: float) -> float:
        """Draws for k occupied bins; 0 for one bin."""
        from scipy.special import chdtri

        return float(chdtri(k - 1, self.delta) / (2 * self.epsilon)) if k > 1 + 1e-9 else 0.0
