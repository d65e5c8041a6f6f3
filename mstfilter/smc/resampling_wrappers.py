"""Resamplers around another resampler: coalescing, tempering, shuffling.

>>> import numpy as np
>>> from mstfilter.smc.population import Population
>>> doubled = Population(np.array([1.0, 2.0, 1.0, 3.0]), np.log([1.0, 1.0, 2.0, 4.0]))
>>> Coalesced(FearnheadClifford()).resample(np.random.default_rng(0), doubled, 3).particles
array([2., 1., 3.])

All three are as proper as the scheme inside. The law they promise is the general one of weighted selection: the
mean over the output of w f(x) has the expectation of the mean over the input.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import number, part
from mstfilter.smc.interfaces import Resampler
from mstfilter.smc.population import Population, log_mean_exp
from mstfilter.smc.resampling import Systematic, checked_weights
from mstfilter.smc.resampling_optimal import FearnheadClifford
from mstfilter.smc.similarity import Equivalence, Exact

__all__ = ["Coalesced", "Shuffled", "Tempered", "coalesce"]


def coalesce(log_weights: np.ndarray, classes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One particle for each class: the heaviest, with the weight of all.

    Returns
    -------
    representatives : (k,) int
        The heaviest particle of each class (the first of equals), ascending. Classes without weight are left out.
    log_weights : (k,) float64
        Log of the summed weights times k / m, so that their log MEAN stays.
    """
    lw = np.asarray(log_weights, dtype=np.float64)
    classes = np.asarray(classes)
    mass = np.bincount(classes, np.exp(lw - lw.max()))
    heaviest = np.lexsort((np.arange(len(lw)), -lw, classes))
    first = np.concatenate([[True], np.diff(classes[heaviest]) > 0])
    representatives = heaviest[first]
    representatives = np.sort(representatives[mass[classes[representatives]] > 0])
    total = np.log(mass[classes[representatives]]) + lw.max()
    return representatives, total + np.log(len(representatives) / len(lw))


@dataclass(frozen=True)
class Coalesced(Resampler):
    """Merges equal particles before it selects: lossless, and no place is wasted on a copy.

    The population shrinks by what is merged; only what makes more candidates than places lets it grow again.

    Parameters
    ----------
    scheme : Resampler
        Selects among the merged particles.
    equivalence : Equivalence
        Says which are equal. Of a class the heaviest stays.
    """

    scheme: Resampler = FearnheadClifford()  # noqa: RUF009 (frozen)
    equivalence: Equivalence = Exact()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        part("scheme", self.scheme, Resampler)
        part("equivalence", self.equivalence, Equivalence)

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.properly_weighted

    @property
    def exact_size(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.exact_size

    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Not possible without the particles."""
        raise InputError("coalescing looks at the particles, and select sees only weights", "call resample")

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Merge, then select; `notes["distinct"]` is the number of different particles with any weight."""
        population = population.realised()
        representatives, log_weights = coalesce(
            population.log_weights, self.equivalence.classes(population.particles)
        )
        merged = population.take(representatives, log_weights)
        chosen = self.scheme.resample(rng, merged, n)
        ancestors = representatives[chosen.parents["ancestor"]]
        notes = {**chosen.notes, "distinct": len(representatives)}
        return replace(chosen, parents={**chosen.parents, "ancestor": ancestors}, notes=notes)


@dataclass(frozen=True)
class Tempered(Resampler):
    """Selects with weights w^power and divides that out: light particles live longer, at unequal weights.

    Parameters
    ----------
    scheme : Resampler
        Selects.
    power : float
        1 is the scheme itself, 0 ignores the weights (zeros stay zeros); in [0, 1].
    """

    scheme: Resampler = Systematic()  # noqa: RUF009 (frozen)
    power: float = 0.5

    def __post_init__(self) -> None:
        part("scheme", self.scheme, Resampler)
        number("power", self.power, at_least=0, at_most=1)

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.properly_weighted

    @property
    def exact_size(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.exact_size

    def _split(self, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Log weights to select by, and what is to be added to the selected ones."""
        positive = checked_weights(log_weights, n) > 0
        lw = np.asarray(log_weights, dtype=np.float64)
        by = np.full(len(lw), -np.inf)
        by[positive] = self.power * lw[positive]
        rest = np.zeros(len(lw))
        rest[positive] = (1 - self.power) * lw[positive]
        return by, rest

    def select(self, rng: np.random.Generator, log_weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Choose."""
        by, rest = self._split(log_weights, n)
        ancestors, out = self.scheme.select(rng, by, n)
        return ancestors, (log_mean_exp(by) if out is None else out) + rest[ancestors]

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Choose; also for schemes that see the particles."""
        by, rest = self._split(population.log_weights, n)
        chosen = self.scheme.resample(rng, replace(population, log_weights=by), n)
        return chosen.reweighted(rest[chosen.parents["ancestor"]])


@dataclass(frozen=True)
class Shuffled(Resampler):
    """Puts the particles into random order first: systematic and stratified schemes then owe nothing to the order.

    Parameters
    ----------
    scheme : Resampler
        Selects.
    """

    scheme: Resampler = Systematic()  # noqa: RUF009 (frozen)

    def __post_init__(self) -> None:
        part("scheme", self.scheme, Resampler)

    @property
    def properly_weighted(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.properly_weighted

    @property
    def exact_size(self) -> bool:  # type: ignore[override]
        """As the scheme inside."""
        return self.scheme.exact_size

    def select(
        self, rng: np.random.Generator, log_weights: np.ndarray, n: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose."""
        lw = np.asarray(log_weights, dtype=np.float64)
        order = rng.permutation(len(lw))
        ancestors, out = self.scheme.select(rng, lw[order], n)
        return order[ancestors], out

    def resample(self, rng: np.random.Generator, population: Population, n: int) -> Population:
        """Choose; also for schemes that see the particles."""
        order = rng.permutation(len(population))
        chosen = self.scheme.resample(rng, population.take(order), n)
        return replace(chosen, parents={**chosen.parents, "ancestor": order[chosen.parents["ancestor"]]})
