"""Weighted particles.

Particles x^1 .. x^n with weights W^1 .. W^n (which sum to one) stand for a distribution: the expectation of f(x) is
estimated by sum_i W^i f(x^i). The weights are stored as unnormalised logarithms, because likelihoods of many
observations underflow:

>>> import numpy as np
>>> from mstfilter.smc import Population
>>> population = Population(np.array([0.0, 1.0, 2.0]), np.log([1.0, 1.0, 2.0]))
>>> population.weights
array([0.25, 0.25, 0.5 ])
>>> float(population.mean())                                        # the expectation of x
1.25

If few particles carry most of the weight, the others are wasted. The effective sample size (sum w)^2 / sum w^2 says
how many particles of equal weight would be as good (Kong, Liu, Wong 1994):

>>> round(population.ess, 3)
2.667

Particles are an array (n, ...), a mapping of arrays (n, ...), a tuple of frozen objects, or `Candidates`, which build
particles on access. A population is immutable. It stores read-only views of the given arrays. If you write to an
array later, pass ``array.copy()`` to the population.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from hashlib import sha256
from typing import Any, Generic, TypeVar

import numpy as np

from mstfilter.base.errors import InputError, LostRunError
from mstfilter.base.lazy import late
from mstfilter.base.processes import each
from mstfilter.smc.summaries import (
    by_variable,
    check_levels,
    data_frame,
    drawn_by_weight,
    flat_columns,
    inference_data,
    weighted_circular_mean,
    weighted_covariance,
    weighted_mean,
    weighted_quantiles,
    weighted_variance,
)

_T = TypeVar("_T")
_U = TypeVar("_U")

Function = Callable[[Any], Any]  # of the particles: an array (n, ...), or a mapping of such
Particles = Any  # ndarray (n, ...) | mapping name -> ndarray (n, ...) | sequence of objects


def log_mean_exp(log_weights: np.ndarray) -> float:
    """``log(mean(exp(log_weights)))`` without overflow; -inf if all log weights are -inf."""
    top = np.max(log_weights)
    if top == -np.inf:
        return -np.inf
    shifted = np.exp(log_weights - top)
    return float(top + math.log(shifted.sum() / len(shifted)))


def normalise(log_weights: np.ndarray) -> np.ndarray:
    """Weights (n,) that sum to one, from unnormalised log weights (n,)."""
    lw = np.asarray(log_weights, dtype=np.float64)
    weights = np.exp(lw - lw.max())
    return weights / weights.sum()


@lru_cache(maxsize=8)
def identity(n: int) -> np.ndarray:
    """The read-only, cached array 0 .. n-1: the parents of particles that kept their positions."""
    return frozen_view(np.arange(n))


class Candidates(Sequence[_T], Generic[_T]):
    """Particles ``build(index)`` that are built at the first access and then stored.

    In MST the weight of a candidate is known before the candidate is built, so only selected candidates are built.
    `build` must return the same particle at every call with the same index, from any thread. `indices` (n,) may
    repeat; an integer n stands for the indices 0 .. n-1.
    """

    def __init__(
        self, build: Callable[[int], _T], indices: np.ndarray | int, _built: dict[int, _T] | None = None
    ) -> None:
        self._build = build
        self._indices = np.arange(indices) if isinstance(indices, (int, np.integer)) else np.asarray(indices)
        self._built: dict[int, _T] = {} if _built is None else _built

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: Any) -> Any:
        if isinstance(position, slice):
            return self.take(np.arange(len(self))[position])
        index = int(self._indices[position])
        if index not in self._built:
            self._built[index] = self._build(index)
        return self._built[index]

    def built(self) -> tuple[_T, ...]:
        """All candidates in order, built at the same time in a block `mstfilter.base.processes.parallel`."""
        _, first = np.unique(self._indices, return_index=True)
        each(self.__getitem__, np.sort(first))
        return tuple(self)

    @property
    def n_built(self) -> int:
        """Number of distinct candidates built so far, including candidates built through a selection by `take`."""
        return len(self._built)

    def map(self, function: Callable[[_T], _U]) -> Candidates[_U]:
        """Candidates ``function(candidate)``, computed on access."""
        return Candidates(lambda position: function(self[position]), len(self))

    def take(self, positions: np.ndarray) -> Candidates[_T]:
        """Select candidates without building them."""
        return Candidates(self._build, self._indices[np.asarray(positions)], self._built)


def count_particles(particles: Particles) -> int:
    """Number of particles; raises InputError if arrays of a mapping have different lengths."""
    if isinstance(particles, np.ndarray):
        return len(particles)
    if isinstance(particles, (dict, Mapping)):
        sizes = {name: len(a) for name, a in particles.items()}
        if len(set(sizes.values())) != 1:
            raise InputError(f"arrays of a population have different lengths: {sizes}")
        return next(iter(sizes.values()))
    return len(particles)


def take(particles: Particles, indices: np.ndarray) -> Particles:
    """Select particles by index; objects are shared, not copied."""
    if isinstance(particles, np.ndarray):
        return particles[indices]
    if isinstance(particles, Mapping):
        return {name: a[indices] for name, a in particles.items()}
    if isinstance(particles, Candidates):
        return particles.take(indices)
    return tuple(particles[int(i)] for i in indices)


def _all_same(particles: Particles) -> bool:
    """Whether all particles are one object, or equal rows of arrays."""
    if isinstance(particles, np.ndarray):
        return bool((particles == particles[0]).all())
    if isinstance(particles, Mapping):
        return all(_all_same(a) for a in particles.values())
    return all(particle is particles[0] for particle in particles)


def as_matrix(particles: Any) -> np.ndarray:
    """(n, d) float64 rows of particles that are an array or a mapping of arrays; InputError for objects."""
    if isinstance(particles, np.ndarray) and particles.dtype != object:
        return np.asarray(particles, dtype=np.float64).reshape(len(particles), -1)
    if isinstance(particles, Mapping):
        return np.concatenate([as_matrix(np.asarray(a)) for _, a in sorted(particles.items())], axis=1)
    raise InputError(
        f"particles are {type(particles[0]).__name__} objects, expected an array or a mapping of arrays",
        "choose a similarity or equivalence for them, such as resampler.similarity=weighted_coverage for hypotheses",
    )


def frozen_view(array: np.ndarray) -> np.ndarray:
    """A read-only view of an array, or the array itself if it is read-only."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def _freeze(particles: Particles) -> Particles:
    """Replace arrays by read-only views, and a sequence of objects by a tuple."""
    if isinstance(particles, np.ndarray):
        return frozen_view(particles)
    if isinstance(particles, (dict, Mapping)):
        return {name: frozen_view(_numpy_array(f"variable {name!r}", a)) for name, a in particles.items()}
    if isinstance(particles, Candidates):
        return particles
    if hasattr(particles, "__dlpack__"):
        _numpy_array("particles", particles)
    return tuple(particles)


def _numpy_array(what: str, array: Any) -> np.ndarray:
    """The array of a variable. Raises InputError for an array of another library, which numpy may not convert."""
    if not isinstance(array, np.ndarray) and hasattr(array, "__dlpack__"):  # which all libraries of arrays define
        library, name = type(array).__module__.partition(".")[0].removesuffix("lib"), type(array).__name__
        raise InputError(
            f"{what}: found {name} of {library}, expected a NumPy array",
            "x.detach().cpu().numpy() converts a torch tensor, numpy.asarray(x) a JAX array",
            "a function of a model gets NumPy arrays: convert to the other library first and back at the end",
        )
    return np.asanyarray(array)


def _check_log_weights(lw: np.ndarray, n: int) -> float:
    """The largest of n log weights; InputError if they cannot be log weights, LostRunError if all are -inf."""
    if lw.shape != (n,):
        raise InputError(f"log weights have shape {lw.shape}, expected ({n},) as there are {n} particles")
    top = np.maximum.reduce(lw)  # NaN if any is NaN, so one pass finds all three errors
    if not top < np.inf:
        wrong = np.flatnonzero(~(lw < np.inf))
        raise InputError(
            f"log weight of particle {wrong[0]} is {lw[wrong[0]]} ({len(wrong)} of {n} are NaN or +inf)",
            "is a parameter of a distribution out of range, such as a scale of 0?",
            *["is the observation NaN? one that is missing is None"] * bool(np.isnan(lw).all()),
        )
    if top == -np.inf:
        raise LostRunError(
            f"all {n} log weights are -inf: no particle explains the observation",
            "more particles, a wider proposal, or a likelihood with heavier tails",
        )
    return float(top)


def _integers(what: str, index: Any) -> np.ndarray:
    """An index array as int64; raises InputError if the array does not have an integer type."""
    index = np.asarray(index)
    if index.dtype.kind not in "iu":
        raise InputError(f"{what} are of type {index.dtype}, expected integers")
    return index.astype(np.int64, copy=False)


def _within(index: np.ndarray, n: int) -> np.ndarray:
    """The given indices of n particles; raises InputError if an index is negative or too large."""
    if len(index) and index.view(np.uint64).max() >= n:  # as unsigned integers, negative ones are too large
        wrong = int(np.flatnonzero((index < 0) | (index >= n))[0])
        raise InputError(
            f"index {wrong} of the selected particles is {index[wrong]}, expected 0 to {n - 1}",
            "indices are positions in the population that is selected from",
        )
    return index


@dataclass(frozen=True, eq=False)
class Population:
    """Weighted particles and their parents.

    Parameters
    ----------
    particles : ndarray (n, ...) | mapping of ndarray (n, ...) | sequence of n objects | Candidates
        The particles, which are not copied and must not be modified.
    log_weights : (n,) float
        Unnormalised natural log weights, by default 0. NaN and +inf raise InputError; -inf means a weight of 0.
    parents : mapping
        ``"previous"``: (n,) indices of the parents in the previous population. ``"proposed"``: (n,) indices of the
        parents among the proposed particles. -1 means no parent. The filter sets the indices, and an update keeps
        them. A resampler adds ``"ancestor"``: the indices before the resampling. A population after a step has
        ``"ancestor"`` if the step resampled after its update.
    notes : mapping
        Values that a component records: numbers, strings and lists.
    """

    particles: Particles
    log_weights: np.ndarray = None  # type: ignore[assignment]
    parents: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        particles = _freeze(self.particles)
        n = count_particles(particles)
        if n == 0:
            raise InputError("a population has no particles", "a proposal must return at least one")
        lw = np.zeros(n) if self.log_weights is None else np.asarray(self.log_weights, dtype=np.float64).view()
        _check_log_weights(lw, n)
        lw.flags.writeable = False
        parents = {}
        for name, index in self.parents.items():
            index = frozen_view(_integers(f'parents "{name}"', index))
            if index.shape != (n,):
                raise InputError(f'parents "{name}" have shape {index.shape}, expected ({n},)')
            parents[name] = index
        object.__setattr__(self, "particles", particles)
        object.__setattr__(self, "log_weights", lw)
        object.__setattr__(self, "parents", parents)

    def __repr__(self) -> str:
        lines = [f"Population: n = {len(self)}, {_kind(self.particles)}, ESS {self.ess:.1f}"]
        heaviest = np.sort(self.weights)[::-1][:8]
        lines.append("weights " + ", ".join(f"{w:.3g}" for w in heaviest) + ", ..." * (len(self) > 8))
        if self.parents:
            lines.append(f"parents {', '.join(self.parents)}")
        return "\n  ".join(lines)

    plot = late("mstfilter.app.report.display:plot_population", "Hypotheses by weight, or weighted histograms.")
    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    def __len__(self) -> int:
        return len(self.log_weights)

    @property
    def weights(self) -> np.ndarray:
        """(n,) weights that sum to one."""
        return normalise(self.log_weights)

    @property
    def ess(self) -> float:
        """Effective sample size ``(sum w)^2 / sum w^2``, between 1 and n."""
        return self._summary()[0]

    @property
    def log_mean_weight(self) -> float:
        """``log(mean(exp(log_weights)))``."""
        return self._summary()[1]

    def _summary(self) -> tuple[float, float]:
        """Effective sample size and log mean weight, computed together and cached, because each step uses both."""
        if "_both" not in self.__dict__:
            top = self.__dict__.get("_top")  # known if the weights have just changed
            if top is None:
                top = np.maximum.reduce(self.log_weights)  # faster than `max` for few particles
            weights = self.log_weights - top
            np.exp(weights, out=weights)
            total = float(np.add.reduce(weights))
            both = (total * total / float(weights @ weights), float(top) + math.log(total / len(weights)))
            object.__setattr__(self, "_both", both)
        return self.__dict__["_both"]

    def mean(self, function: Function | None = None) -> Any:
        """Weighted mean (...) of particles (n, ...), or a mapping of means for a mapping of arrays.

        ``function(particles)`` (n, ...) may say what is averaged, as in all summaries (`mstfilter.smc.summaries`).
        """
        return by_variable(weighted_mean, self._values(function), self.weights)

    def variance(self, function: Function | None = None) -> Any:
        """Weighted variances (...) of the entries of particles (n, ...)."""
        return by_variable(weighted_variance, self._values(function), self.weights)

    def covariance(self, function: Function | None = None) -> np.ndarray:
        """Weighted covariance (d, d) of the d entries of a particle, in the order of `columns`."""
        columns = _columns(self._values(function))
        return by_variable(weighted_covariance, np.stack([*columns.values()], axis=1), self.weights)

    def quantiles(self, levels: Any = (0.05, 0.5, 0.95), function: Function | None = None) -> Any:
        """Weighted quantiles (levels, ...) of the entries of particles (n, ...), of one level or several."""
        return by_variable(weighted_quantiles, self._values(function), self.weights, check_levels(levels))

    def circular_mean(self, function: Function | None = None, period: float = 2 * math.pi) -> Any:
        """Weighted mean (...) of angles (n, ...), from -period / 2 to period / 2. Degrees have the period 360."""
        return by_variable(weighted_circular_mean, self._values(function), self.weights, period)

    def _values(self, function: Function | None) -> Any:
        """What is summarised: the particles, or a function of them."""
        if function is None:
            return self.particles
        values = function(self.particles)
        return values if isinstance(values, Mapping) else np.asarray(values)

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of a table with a row per particle: its entries ``x``, or ``x_0`` ..., and its weight."""
        return {**_columns(self.particles), "weight": self.weights}

    def to_pandas(self) -> Any:
        """A ``pandas.DataFrame`` with one row per particle and the column "weight"."""
        return data_frame(self.columns())

    def to_arviz(self, resample: bool = True) -> Any:
        """The particles as draws of one chain for ArviZ, whose statistics do not use weights.

        So the draws are particles selected by weight. With ``resample=False`` they are all particles, as they are.
        The group ``sample_stats`` holds the weight that each draw has.
        """
        weights = self.weights
        rows = drawn_by_weight(weights) if resample else np.arange(len(self))
        values: Any = take(self.particles, rows)
        named = values if isinstance(values, Mapping) else {"x": values}
        kept = np.full(len(self), 1 / len(self)) if resample else weights
        return inference_data({name: np.asarray(a)[None] for name, a in named.items()}, {"weight": kept[None]})

    @property
    def unique_ancestors(self) -> int:
        """Number of particles of the previous population that have descendants; 0 if the parents are unknown."""
        previous = self.parents.get("previous", np.zeros(0, np.int64))
        return len(np.unique(previous[previous >= 0]))

    def known_parents(self) -> np.ndarray:
        """(n,) indices of the parents in the previous population; InputError if a particle has no known parent."""
        index = self.parents.get("previous")
        if index is None or (index < 0).any():
            raise InputError(
                f"{'no' if index is None else 'not every'} particle has a known parent",
                "a filter with a proposal of new particles has no paths",
            )
        return index

    @property
    def best(self) -> Any:
        """The particle of largest weight.

        Raises InputError if different particles share the largest weight, as after resampling, because any of them
        would be a random draw. Particles are the same if they are one object, or have equal values in all arrays.
        """
        heaviest = np.flatnonzero(self.log_weights == self.log_weights.max())
        tied = take(self.particles, heaviest)
        if not _all_same(tied):
            raise InputError(
                f"{len(heaviest)} of {len(self)} particles share the largest weight, so none of them is the best",
                "of scenes, mstfilter.Belief(population).estimate() is the best single answer",
                "of numbers, use the weighted mean: population.mean()",
            )
        if isinstance(tied, Mapping):
            return {name: a[0] for name, a in tied.items()}
        return tied[0]

    @classmethod
    def unchecked(cls, particles: Particles, log_weights: np.ndarray) -> Population:
        """Make a population from particles and log weights that were checked before."""
        new = object.__new__(cls)
        new.__dict__.update(particles=_freeze(particles), log_weights=frozen_view(log_weights), parents={}, notes={})
        return new

    def take(self, indices: np.ndarray, log_weights: np.ndarray | None = None) -> Population:
        """Select particles with their parents, and with their log weights unless `log_weights` are given.

        Raises InputError if the indices are not integers from 0 to n - 1, if there are none, or if all selected
        particles have weight 0.
        """
        indices = _within(_integers("indices", indices), len(self))
        if len(indices) == 0:
            raise InputError("no particle is selected", "name at least one index")
        lw = self.log_weights[indices] if log_weights is None else np.asarray(log_weights, dtype=np.float64)
        try:
            _check_log_weights(lw, len(indices))
        except LostRunError:
            raise InputError(
                f"all {len(indices)} selected particles have weight 0",
                "select among those of positive weight: np.flatnonzero(population.weights)",
            ) from None
        new = self.labelled({name: frozen_view(index[indices]) for name, index in self.parents.items()}, self.notes)
        new.__dict__.update(particles=_freeze(take(self.particles, indices)), log_weights=frozen_view(lw), _top=None)
        new.__dict__.pop("_both", None)
        return new

    def select(self, ancestors: np.ndarray, log_weights: np.ndarray, **notes: Any) -> Population:
        """Select particles as `take` does, set ``parents["ancestor"]``, and add the given values to `notes`."""
        new = self.take(ancestors, log_weights)
        new.__dict__["parents"]["ancestor"] = _integers("ancestors", ancestors)
        if notes:
            new.__dict__["notes"] = {**self.notes, **notes}
        return new

    def with_ancestors(self, ancestors: np.ndarray, **notes: Any) -> Population:
        """The same particles with the given ``parents["ancestor"]``, and the given values added to `notes`."""
        parents = {**self.parents, "ancestor": _integers("ancestors", ancestors)}
        return self.labelled(parents, {**self.notes, **notes} if notes else self.notes)

    def labelled(self, parents: Mapping[str, np.ndarray], notes: Mapping[str, Any] | None = None) -> Population:
        """The same particles and weights with other `parents` (each an (n,) int64 array) and other `notes`."""
        new = object.__new__(Population)  # checked already
        new.__dict__.update(self.__dict__, parents=parents, notes=notes or {})
        return new

    def traced_through(self, resampled: Population | None) -> Population:
        """The same particles, with parents in the population from which `resampled` was selected.

        Before the call, ``parents["previous"]`` are indices into `resampled`. If `resampled` has ancestors, each
        index is replaced by the index of the ancestor. The field `notes` of the result is empty.
        """
        ancestors = None if resampled is None else resampled.parents.get("ancestor")
        index = self.parents.get("previous")
        if ancestors is None or index is None:
            return self.labelled(self.parents)
        stayed = index is identity(len(ancestors))
        traced = ancestors if stayed else np.where(index >= 0, ancestors[index], -1)
        return self.labelled({**self.parents, "previous": traced})

    def moved(self, particles: Particles) -> Population:
        """Replace the particles by as many new ones. Weights and parents stay the same, and `notes` becomes empty."""
        particles = _freeze(particles)
        if count_particles(particles) != len(self):
            raise InputError(f"{len(self)} particles became {count_particles(particles)}, expected as many")
        new = self.labelled(self.parents)
        new.__dict__["particles"] = particles
        return new

    def realised(self) -> Population:
        """The same population, with all `Candidates` built."""
        # Arrays are tested first, as a test for an abstract class such as `Candidates` takes longer.
        if type(self.particles) is np.ndarray or not isinstance(self.particles, Candidates):
            return self
        return replace(self, particles=self.particles.built())

    def reweighted(self, log_factors: np.ndarray) -> Population:
        """The same particles with `log_factors` added to the log weights."""
        lw = np.asarray(self.log_weights + log_factors, dtype=np.float64)
        top = _check_log_weights(lw, len(self))
        lw.flags.writeable = False
        new = self.labelled(self.parents, self.notes)  # particles and parents have been checked
        new.__dict__.update(log_weights=lw, _top=top)
        new.__dict__.pop("_both", None)
        return new


def digest_of(population: Population) -> str:
    """A hash of weights, parents and particles that are arrays, to name random streams."""
    arrays: dict[str, Any] = {"log weights": population.log_weights, **population.parents}
    particles = population.particles
    arrays |= particles if isinstance(particles, Mapping) else {"particles": particles}
    found = sha256()
    for name, a in sorted(arrays.items()):
        if isinstance(a, np.ndarray) and a.dtype != object:
            found.update(f"{name} {a.dtype.str} {a.shape}".encode() + np.ascontiguousarray(a).tobytes())
    return found.hexdigest()


def _columns(values: Any) -> dict[str, np.ndarray]:
    """The entries (n,) of arrays by name. Raises InputError for objects."""
    by_variable(np.shape, values)
    return flat_columns(values if isinstance(values, Mapping) else {"x": values})


def _kind(particles: Particles) -> str:
    """A short description of the type of the particles."""
    if isinstance(particles, Candidates):
        return f"candidates, {particles.n_built} built"
    if isinstance(particles, Mapping):
        named = [f"{name} {np.dtype(a.dtype)} {a.shape}" for name, a in list(particles.items())[:4]]
        return ", ".join(named) + ", ..." * (len(particles) > 4)
    if isinstance(particles, np.ndarray):
        return f"{particles.dtype} {particles.shape}"
    return f"particles {type(particles[0]).__name__}"


def union(predicted: Population | None, proposed: Population | None) -> Population:
    """Join predicted and proposed particles, with their weights and parents. One of the populations may be None.

    Raises InputError if both are None, or if particles that are mappings have different variables.
    """
    if predicted is None or proposed is None:
        population = predicted if predicted is not None else proposed
        if population is None:
            raise InputError("an update got neither predicted nor proposed particles")
        return population
    a, b = predicted.particles, proposed.particles
    particles: Any
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        particles = np.concatenate([a, b])
    elif isinstance(a, Mapping) and isinstance(b, Mapping):
        if a.keys() != b.keys():
            raise InputError(
                f"predicted and proposed particles have the variables {sorted(a)} and {sorted(b)}, expected the same"
            )
        particles = {name: np.concatenate([a[name], b[name]]) for name in a}
    else:
        particles = (*a, *b)
    none_a, none_b = np.full(len(predicted), -1), np.full(len(proposed), -1)
    parents = {
        name: np.concatenate([predicted.parents.get(name, none_a), proposed.parents.get(name, none_b)])
        for name in ("previous", "proposed")
    }
    return Population(particles, np.concatenate([predicted.log_weights, proposed.log_weights]), parents)
