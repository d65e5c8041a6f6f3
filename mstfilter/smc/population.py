"""Weighted particles.

>>> import numpy as np
>>> from mstfilter.smc.population import Population
>>> population = Population(np.array([0.0, 1.0, 2.0]), np.log([1.0, 1.0, 2.0]))
>>> population.weights
array([0.25, 0.25, 0.5 ])
>>> round(population.ess, 3)
2.667

Particles are an array (n, ...), a mapping of arrays (n, ...), a tuple of frozen objects, or `Candidates` that
are built only when someone looks at them. `take` selects from any of them: rows of arrays are copied, objects are
shared, so a duplicate costs a reference.

Nobody can write to a population, but it does not copy what it is made of: its arrays are read-only views. Who keeps
an array, makes a population of it, and writes to that array afterwards changes the population too. Components make
new arrays at every step; hand in ``array.copy()`` where you go on writing to yours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import numpy as np

from mstfilter.errors import InputError

__all__ = ["Candidates", "Population", "effective_sample_size", "log_mean_exp", "normalise"]

T = TypeVar("T")
U = TypeVar("U")


def log_mean_exp(log_weights: np.ndarray) -> float:
    """``log(mean(exp(log_weights)))`` without overflow; -inf where all are."""
    top = np.max(log_weights)
    if top == -np.inf:
        return -np.inf
    shifted = np.exp(log_weights - top)
    return float(top + math.log(shifted.sum() / len(shifted)))


def normalise(log_weights: np.ndarray) -> np.ndarray:
    """Weights (n,) that sum to one from unnormalised log weights (n,)."""
    lw = np.asarray(log_weights, dtype=np.float64)
    weights = np.exp(lw - lw.max())
    return weights / weights.sum()


def effective_sample_size(log_weights: np.ndarray) -> float:
    """``(sum w)^2 / sum w^2``, between 1 and n."""
    lw = np.asarray(log_weights, dtype=np.float64)
    weights = lw - lw.max()
    np.exp(weights, out=weights)
    return float(weights.sum() ** 2 / (weights @ weights))


class Candidates(Sequence[T], Generic[T]):
    """Particles that are built when they are looked at.

    In MST a candidate's weight depends only on the pair it is made from, so the candidates need not exist to be
    resampled. `build(i)` makes candidate i from stored keys alone: building twice gives the same thing, and
    what was built is kept.

    Parameters
    ----------
    build : callable
        ``build(index) -> particle`` for the indices below.
    indices : (n,) int array
        Which candidates, in order; the same one may occur more than once.
    """

    def __init__(
        self, build: Callable[[int], T], indices: np.ndarray | int, _built: dict[int, T] | None = None
    ) -> None:
        self._build = build
        self._indices = np.arange(indices) if isinstance(indices, (int, np.integer)) else np.asarray(indices)
        self._built: dict[int, T] = {} if _built is None else _built

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: Any) -> Any:
        if isinstance(position, slice):
            return self.take(np.arange(len(self))[position])
        index = int(self._indices[position])
        if index not in self._built:
            self._built[index] = self._build(index)
        return self._built[index]

    def __iter__(self) -> Iterator[T]:
        return (self[i] for i in range(len(self)))

    @property
    def n_built(self) -> int:
        """How many distinct candidates have been built so far (shared by all selections)."""
        return len(self._built)

    def take(self, positions: np.ndarray) -> Candidates[T]:
        """Some of them, still unbuilt; what is built already is shared."""
        return Candidates(self._build, self._indices[np.asarray(positions)], self._built)

    def map(self, function: Callable[[T], U]) -> Candidates[U]:
        """Candidates of ``function(candidate)``, still unbuilt."""
        own = Candidates(self._build, len(self._indices), self._built)
        parent = self._indices

        def build(position: int) -> U:
            index = int(parent[position])
            if index not in own._built:
                own._built[index] = own._build(index)
            return function(own._built[index])

        return Candidates(build, len(parent))


Particles = Any  # ndarray (n, ...) | mapping name -> ndarray (n, ...) | sequence of objects


def _count(particles: Particles) -> int:
    if isinstance(particles, Mapping):
        sizes = {name: len(a) for name, a in particles.items()}
        if len(set(sizes.values())) != 1:
            raise InputError(f"arrays of a population have different lengths: {sizes}")
        return next(iter(sizes.values()))
    return len(particles)


def _freeze(particles: Particles) -> Particles:
    if isinstance(particles, np.ndarray):
        view = particles.view()
        view.flags.writeable = False
        return view
    if isinstance(particles, Mapping):
        return {name: _freeze(np.asarray(a)) for name, a in particles.items()}
    if isinstance(particles, Candidates):
        return particles
    return tuple(particles)


def take(particles: Particles, indices: np.ndarray) -> Particles:
    """Select particles by index from any of the three kinds; objects are shared, not copied."""
    if isinstance(particles, np.ndarray):
        return particles[indices]
    if isinstance(particles, Mapping):
        return {name: a[indices] for name, a in particles.items()}
    if isinstance(particles, Candidates):
        return particles.take(indices)
    return tuple(particles[int(i)] for i in indices)


def _check_log_weights(lw: np.ndarray, n: int) -> None:
    if lw.shape != (n,):
        raise InputError(f"log weights have shape {lw.shape}, expected ({n},) as there are {n} particles")
    # One pass finds all three faults: NaN poisons the maximum.
    top = lw.max()
    if not top < np.inf:
        wrong = np.flatnonzero(~(lw < np.inf))
        raise InputError(
            f"log weight of particle {wrong[0]} is {lw[wrong[0]]} ({len(wrong)} of {n} are NaN or +inf)",
            *(["is the observation NaN? one that is missing is None"] if np.isnan(lw).all() else []),
        )
    if top == -np.inf:
        raise InputError(
            f"all {n} log weights are -inf: no particle explains the observation",
            "more particles, a wider proposal, or a likelihood with heavier tails",
        )


@dataclass(frozen=True, eq=False)
class Population:
    """Weighted particles and where they come from.

    Parameters
    ----------
    particles : ndarray (n, ...) | mapping of ndarray (n, ...) | sequence of n objects | Candidates
        Treated as immutable; shared, not copied.
    log_weights : (n,) float
        Natural log, unnormalised. -inf is a weight of 0; NaN and +inf are errors. None: all 0.
    parents : mapping
        ``"previous"`` and ``"proposed"``: (n,) index of the parent in the previous population or among the
        proposed particles, -1 for none. A resampler adds ``"ancestor"``: which particle each one was before.
    notes : mapping
        What a component wants recorded: plain numbers, strings and lists.
    """

    particles: Particles
    log_weights: np.ndarray = None  # type: ignore[assignment]
    parents: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        particles = _freeze(self.particles)
        n = _count(particles)
        if n == 0:
            raise InputError("a population has no particles", "a proposal must return at least one")
        lw = np.zeros(n) if self.log_weights is None else np.asarray(self.log_weights, dtype=np.float64).view()
        _check_log_weights(lw, n)
        lw.flags.writeable = False
        parents = {}
        for name, index in self.parents.items():
            index = np.asarray(index, dtype=np.int64).view()
            index.flags.writeable = False
            if index.shape != (n,):
                raise InputError(f'parents "{name}" have shape {index.shape}, expected ({n},)')
            parents[name] = index
        object.__setattr__(self, "particles", particles)
        object.__setattr__(self, "log_weights", lw)
        object.__setattr__(self, "parents", parents)

    def __len__(self) -> int:
        return len(self.log_weights)

    @property
    def weights(self) -> np.ndarray:
        """(n,) weights that sum to one."""
        return normalise(self.log_weights)

    @property
    def ess(self) -> float:
        """Effective sample size."""
        return self._summary()[0]

    @property
    def log_mean_weight(self) -> float:
        """``log(mean(exp(log_weights)))``."""
        return self._summary()[1]

    def _summary(self) -> tuple[float, float]:
        """Effective sample size and log mean weight, from one pass; asked for by several parts of a step."""
        if "_both" not in self.__dict__:
            top = self.log_weights.max()
            weights = self.log_weights - top
            np.exp(weights, out=weights)
            total = float(weights.sum())
            both = (total**2 / float(weights @ weights), float(top) + math.log(total / len(weights)))
            object.__setattr__(self, "_both", both)
        return self.__dict__["_both"]

    @property
    def best(self) -> Any:
        """The particle of the largest weight (the first of equals)."""
        index = int(np.argmax(self.log_weights))
        if isinstance(self.particles, Mapping):
            return {name: a[index] for name, a in self.particles.items()}
        return self.particles[index]

    def take(self, indices: np.ndarray, log_weights: np.ndarray | None = None) -> Population:
        """Select particles, with their parents; log weights come along unless new ones are given."""
        indices = np.asarray(indices, dtype=np.int64)
        return Population(
            take(self.particles, indices),
            self.log_weights[indices] if log_weights is None else log_weights,
            {name: index[indices] for name, index in self.parents.items()},
            self.notes,
        )

    def labelled(self, parents: Mapping[str, np.ndarray], notes: Mapping[str, Any] | None = None) -> Population:
        """The same particles and weights with other parents ((n,) int64 arrays) and notes (none by default)."""
        new = object.__new__(Population)  # nothing that was checked has changed
        new.__dict__.update(self.__dict__, parents=parents, notes=notes or {})
        return new

    def moved(self, particles: Particles) -> Population:
        """Other particles, as many, with the same weights and parents; notes are dropped."""
        particles = _freeze(particles)
        if _count(particles) != len(self):
            raise InputError(f"{len(self)} particles became {_count(particles)}, expected as many")
        new = self.labelled(self.parents)
        new.__dict__["particles"] = particles
        return new

    def realised(self) -> Population:
        """The same population with every candidate built."""
        if isinstance(self.particles, Candidates):
            return replace(self, particles=tuple(self.particles))
        return self

    def reweighted(self, log_factors: np.ndarray) -> Population:
        """The same particles, log weights plus `log_factors`."""
        lw = np.asarray(self.log_weights + log_factors, dtype=np.float64)
        _check_log_weights(lw, len(self))
        lw.flags.writeable = False
        new = self.labelled(self.parents, self.notes)  # particles and parents have been checked
        new.__dict__["log_weights"] = lw
        new.__dict__.pop("_both", None)
        return new
