"""Components that need no model: an update, branching, triggers, a size, and equality of particles.

The bootstrap filter multiplies each weight by the likelihood of the observation, w_i p(y | x_i):

>>> import numpy as np
>>> from scipy.stats import norm
>>> from mstfilter.smc import Bins, Kld, Population, Reweight
>>> update = Reweight(lambda particles, y: norm.logpdf(y, loc=particles, scale=0.5))
>>> rng = np.random.default_rng(0)
>>> update.update(rng, Population(np.array([0.0, 1.0])), None, 0.9).weights.round(2)
array([0.17, 0.83])

A wide posterior needs more particles than a narrow one. `Kld` counts the bins that the particles occupy (Fox 2003):

>>> wide = Population(np.linspace(0, 10, 200))
>>> narrow = Population(np.linspace(0, 10, 200), -50.0 * (np.linspace(0, 10, 200) - 5.25) ** 2)
>>> size = Kld(equivalence=Bins(0.5), epsilon=0.05, n_min=10)
>>> size.choose(wide), size.choose(narrow)
(374, 47)

`Kld` and `Coalesced` take an `Equivalence`, which defines equal particles:

>>> Bins(width=0.5).classes(np.array([0.1, 0.4, 0.6, -0.1]))
array([0, 0, 1, 2])
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from mstfilter.base.errors import InputError, check_integer
from mstfilter.base.fields import Bounds, PositiveInt
from mstfilter.smc.first_steps import Few, compare_alone
from mstfilter.smc.interfaces import Equivalence, Size, Transition, Trigger, Update
from mstfilter.smc.population import Population, as_matrix, union


@dataclass(frozen=True)
class Reweight(Update):
    """Adds ``log_likelihood(particles, observation)`` (n,) to the log weights, as in the bootstrap filter.

    Proposed particles, if any, are appended to the predicted particles, with the mean weight that these have: the
    weights of predicted particles contain the likelihoods of all earlier observations, those of proposed ones none.
    """

    log_likelihood: Callable[[Any, Any], np.ndarray]

    draws: ClassVar[bool] = False
    alone: ClassVar[bool] = True
    step_functions: ClassVar = {"log_likelihood": 2}

    def update(
        self, rng: np.random.Generator, predicted: Population | None, proposed: Population | None, observation: Any
    ) -> Population:
        if predicted is not None and proposed is not None:
            level = predicted.log_mean_weight - proposed.log_mean_weight
            proposed = proposed.reweighted(np.full(len(proposed), level))
        population = union(predicted, proposed)
        found = np.asarray(self.log_likelihood(population.particles, observation))
        if found.shape != population.log_weights.shape:
            raise InputError(
                f"log likelihood has shape {found.shape}, expected {population.log_weights.shape}: one number per "
                "particle"
            )
        return population.reweighted(found)

    def examine(
        self, rng: np.random.Generator, before: Population | None, observation: Any, after: Population
    ) -> bool:
        few = Few.of(after.particles)
        compare_alone("the log likelihood", lambda x: self.log_likelihood(x, observation), few)
        return few.differ


@dataclass(frozen=True)
class Branching(Transition):
    """Moves `branches` copies of every particle independently. The mean weight, and so the evidence, does not change.

    Schemes without duplicates (Fearnhead-Clifford, k-DPP, coalescing) need more candidates than particles. If n
    particles are selected from n candidates, all candidates are kept, and the filter degenerates. If the branches of
    a discrete state are all its successors, the filter is the algorithm of Fearnhead and Clifford (2003). Use
    ``resample="after"``, and `Never` as the trigger: more than n candidates are always resampled.

    Parameters
    ----------
    inner : Transition
        The transition that moves the copies.
    branches : int
        Number of copies of each particle. Copies are adjacent in the result.
    """

    inner: Transition
    branches: PositiveInt = 4
    step_functions: ClassVar = {"inner": None}

    @property
    def properly_weighted(self) -> bool:
        return self.inner.properly_weighted

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        index = np.repeat(np.arange(len(population)), self.branches)
        copies = population.realised().take(index)
        moved = self.inner.predict(rng, copies.labelled({**copies.parents, "previous": index}), observation)
        if "previous" in moved.parents or len(moved) != len(index):
            return moved
        return moved.labelled({**moved.parents, "previous": index}, moved.notes)

    def examine(
        self, rng: np.random.Generator, before: Population | None, observation: Any, after: Population
    ) -> bool:
        return self.inner.examine(rng, before, observation, after)


_HINT_SHARE = (
    "share is relative to the number of particles: 0.5 resamples below half of them; see also the triggers Always "
    "and Never"
)


@dataclass(frozen=True)
class EssBelow(Trigger):
    """Resample if the effective sample size is below a `share`, in (0, 1], of the number of particles."""

    share: Annotated[float, Bounds(above=0, at_most=1, hint=_HINT_SHARE)] = 0.5

    def wants(self, population: Population, t: int) -> bool:
        return population.ess < self.share * population.log_weights.shape[-1]


@dataclass(frozen=True)
class Always(Trigger):
    """Resample at every step."""

    def wants(self, population: Population, t: int) -> bool:
        return True


@dataclass(frozen=True)
class Every(Trigger):
    """Resample at every `k`-th step, from step 0."""

    k: PositiveInt = 2

    def wants(self, population: Population, t: int) -> bool:
        return t % self.k == 0


@dataclass(frozen=True)
class Never(Trigger):
    """Resample only if there are more particles than the filter keeps."""

    def wants(self, population: Population, t: int) -> bool:
        return False


def first_seen(keys: Iterable[Hashable]) -> np.ndarray:
    """(n,) int: equal keys get equal numbers, counted from 0 in the order of first occurrence."""
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)


@dataclass(frozen=True)
class ExactEquality(Equivalence):
    """Array particles are equal if their bytes are identical. Objects are equal if ``==`` and hashes agree."""

    def classes(self, particles: Any) -> np.ndarray:
        if isinstance(particles, np.ndarray) and particles.dtype != object:
            return first_seen(np.ascontiguousarray(row).tobytes() for row in particles)
        if isinstance(particles, Mapping):
            columns = [self.classes(np.asarray(a)) for a in particles.values()]
            return first_seen(zip(*(c.tolist() for c in columns), strict=True))
        return first_seen(particles)


@dataclass(frozen=True)
class Bins(Equivalence):
    """Array particles are equal if they lie in the same cell of a regular grid with cells of side `width`.

    Entries that are NaN lie in one cell.
    """

    width: Annotated[float, Bounds(above=0, unit="side of a cell")] = 1.0

    def classes(self, particles: Any) -> np.ndarray:
        cells = np.floor(as_matrix(particles) / self.width)
        cells[np.isnan(cells)] = -np.inf  # np.unique would give each row with NaN a cell of its own
        _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        return rank[inverse.ravel()]


@dataclass(frozen=True)
class Kld(Size):
    """KLD-sampling: the least n that bounds the error of the distribution over bins by `epsilon`.

    k occupied bins require n >= bound(k) = chi2_{k-1}(1 - delta) / (2 epsilon) draws (Fox 2003, "Adapting the sample
    size in particle filters through KLD-sampling"). Fox counts the occupied bins while drawing. `Kld` uses the weight
    W_b of each bin. It chooses the least n with n >= bound(k), where k = sum_b (1 - (1 - W_b)^n) is the expected
    number of bins that n draws occupy. This n slightly exceeds Fox's n.

    Parameters
    ----------
    equivalence : Equivalence
        Defines the bins: a grid for vectors, or classes of equal particles for objects.
    epsilon : float
        Bound of the Kullback-Leibler distance in nats, positive.
    delta : float
        Probability that the distance exceeds `epsilon`, in (0, 1).
    n_min, n_max : int
        Bounds of the number of particles. For one occupied bin, `n_min` is chosen.
    """

    equivalence: Equivalence = Bins()
    epsilon: Annotated[float, Bounds(above=0, unit="distance in nats")] = 0.05
    delta: Annotated[float, Bounds(above=0, below=1, unit="probability")] = 0.01
    n_min: PositiveInt = 10
    n_max: int = 100_000

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("n_max", self.n_max, f"n_min is {self.n_min}", at_least=self.n_min)

    def choose(self, population: Population) -> int:
        """The least number of particles that meets the error bound, within `n_min` and `n_max`."""
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
        """Number of draws that k occupied bins require for the error bound; 0 for one bin."""
        from scipy.special import chdtri

        return float(chdtri(k - 1, self.delta) / (2 * self.epsilon)) if k > 1 + 1e-9 else 0.0
