"""When to resample (triggers), and to how many particles (sizes).

>>> import numpy as np
>>> from mstfilter.smc import Bins, Kld, Population
>>> wide = Population(np.linspace(0, 10, 200))
>>> narrow = Population(np.linspace(0, 10, 200), -50.0 * (np.linspace(0, 10, 200) - 5.25) ** 2)
>>> size = Kld(equivalence=Bins(0.5), epsilon=0.05, n_min=10)
>>> size.choose(wide), size.choose(narrow)
(374, 47)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mstfilter.errors import check_component, check_integer, check_number
from mstfilter.smc.interfaces import Size, Trigger
from mstfilter.smc.population import Population
from mstfilter.smc.similarity import Bins, Equivalence


@dataclass(frozen=True)
class EssBelow(Trigger):
    """Resample if the effective sample size is below a share of the number of particles.

    Parameters
    ----------
    share : float
        In (0, 1].
    """

    share: float = 0.5

    def __post_init__(self) -> None:
        hint = "share is relative to the number of particles: 0.5 resamples below half of them"
        check_number("share", self.share, f"{hint}; see also the triggers Always and Never", above=0, at_most=1)

    def wants(self, population: Population, t: int) -> bool:
        return population.ess < self.share * len(population)


@dataclass(frozen=True)
class Always(Trigger):
    """Resample at every step."""

    def wants(self, population: Population, t: int) -> bool:
        return True


@dataclass(frozen=True)
class Never(Trigger):
    """Resample only if there are more particles than the filter keeps."""

    def wants(self, population: Population, t: int) -> bool:
        return False


@dataclass(frozen=True)
class EveryKth(Trigger):
    """Resample at every k-th step."""

    k: int = 2

    def __post_init__(self) -> None:
        check_integer("resampling at every k-th step: k", self.k)

    def wants(self, population: Population, t: int) -> bool:
        return t % self.k == 0


@dataclass(frozen=True)
class Fixed(Size):
    """A fixed number of particles `n`."""

    n: int = 100

    def __post_init__(self) -> None:
        check_integer("n", self.n)

    def choose(self, population: Population) -> int:
        return self.n


@dataclass(frozen=True)
class Kld(Size):
    """Enough particles to know the distribution over bins up to a Kullback-Leibler distance epsilon.

    With k occupied bins this takes n = chi2_{k-1}(1 - delta) / (2 epsilon) draws (Fox 2003, "Adapting the sample size
    in particle filters through KLD-sampling"). Fox counts the bins while drawing. Here the masses W_b of the bins are
    known, and n is the least number with n >= bound(sum_b 1 - (1 - W_b)^n), the expected number of bins that n draws
    occupy. This holds for any resampling scheme, and gives slightly more particles than Fox's sequential stopping.

    Parameters
    ----------
    equivalence : Equivalence
        The bins: a grid for vectors, classes of equal particles for objects.
    epsilon : float
        Kullback-Leibler distance in nats, positive.
    delta : float
        Probability that the distance is larger, in (0, 1).
    n_min, n_max : int
        Bounds of the result. One occupied bin gives `n_min`.
    """

    equivalence: Equivalence = Bins()  # noqa: RUF009 (frozen)
    epsilon: float = 0.05
    delta: float = 0.01
    n_min: int = 10
    n_max: int = 100_000

    def __post_init__(self) -> None:
        check_component("equivalence", self.equivalence, Equivalence)
        check_number("epsilon", self.epsilon, above=0, unit="distance in nats")
        check_number("delta", self.delta, above=0, below=1, unit="probability")
        check_integer("n_min", self.n_min)
        check_integer("n_max", self.n_max, f"n_min is {self.n_min}", at_least=self.n_min)

    def choose(self, population: Population) -> int:
        """The least sufficient number within the bounds."""
        population = population.realised()
        mass = np.bincount(self.equivalence.classes(population.particles), population.weights)
        mass = np.minimum(mass[mass > 0], 1.0)
        n = self.n_min
        # The bound grows with n, so increasing n from n_min stops at the least solution.
        while n < self.n_max:
            with np.errstate(divide="ignore"):
                occupied = -np.expm1(n * np.log1p(-mass)).sum()
            enough = int(np.ceil(self.bound(occupied)))
            if enough <= n:
                break
            n = enough
        return min(n, self.n_max)

    def bound(self, k: float) -> float:
        """Number of draws for k occupied bins; 0 for one bin."""
        from scipy.special import chdtri

        return float(chdtri(k - 1, self.delta) / (2 * self.epsilon)) if k > 1 + 1e-9 else 0.0
