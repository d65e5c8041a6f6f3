"""The functions that a program calls (`sample`, `observe`, `switch`), and the handlers that give sites their values.

A `ProgramRun` is one pass of a program over n particles. Its handler decides the value of each site: a draw, a
replayed draw of a guide, the mean of the distribution, or a given value.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distributions import Categorical, as_distribution
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.population import take
from mstfilter.smc.streams import child

active_run: ContextVar[ProgramRun | None] = ContextVar("run of a program", default=None)


def sample(name: str, distribution: Any) -> Any:
    """A random value of the step, kept in the particle under `name`.

    Parameters
    ----------
    name : str
        Unique within a step.
    distribution : Distribution
        Of this package, frozen of scipy.stats, or of torch; parameters have one row per particle.

    Returns
    -------
    ndarray (n, ...)
        One row per particle; a number or array without that axis in a `per_particle` program.
    """
    return _current().sample(name, distribution)


def observe(name: str, distribution: Any, value: Any) -> None:
    """Weight the particles by the probability of an observed value; None is a missing value and has no effect.

    Parameters
    ----------
    name : str
        Used in messages.
    distribution : Distribution
        Of the observation given the particle.
    value : array_like or None
        The observation.
    """
    _current().observe(name, distribution, value)


def switch(name: str, probs: Any, branches: Sequence[Callable[..., Any]], *args: Any) -> Any:
    """Draw a branch for each particle and run each branch on its particles.

    Parameters
    ----------
    name : str
        The index of the branch (n,) is stored in the particles under this name.
    probs : (k,) or (n, k) array_like
        Probabilities of the k branches.
    branches : sequence of callables
        Each is called once with the rows of `args` that belong to its particles, and may `sample`, `observe` and
        `switch`. A site with the same name in several branches is one array; the value is NaN (0 for integers) for
        particles that did not reach the site.
    *args : array (n, ...), mapping of such, or None
        Split by rows. Values shared by all particles, such as the observation, come by closure.

    Returns
    -------
    None, array (n, ...) or mapping
        The values returned by the branches, merged by rows.
    """
    return _current().switch(name, probs, branches, args)


def _current() -> ProgramRun:
    run = active_run.get()
    if run is None:
        raise InputError(
            "sample, observe or switch was called outside of a program",
            "run the function through Program(model).bootstrap(n) or another filter of it",
        )
    return run


@dataclass(frozen=True)
class PerParticle:
    """A program that runs once for every particle; made by `per_particle`.

    Parameters
    ----------
    function : callable
        ``(previous, observation)``; `previous` is the particle's `Trace`.
    """

    function: Callable[[Any, Any], Any]

    def __call__(self, previous: Any, observation: Any) -> Any:
        return self.function(previous, observation)


def per_particle(function: Callable[[Any, Any], Any]) -> PerParticle:
    """Mark a program whose set of sites may differ between particles. It runs once for every particle, so slower."""
    return PerParticle(function)


class Trace(Mapping[str, Any]):
    """An immutable mapping from names to values: a particle of a `per_particle` program.

    Parameters
    ----------
    values : mapping
        Numbers, strings or arrays.
    """

    __slots__ = ("_values",)

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"Trace({self._values!r})"


class Site(NamedTuple):
    """A call of `sample` in a run.

    Parameters
    ----------
    name : str
    distribution : Distribution
    size : int
        Number of particles that reach the site.
    rows : (size,) int array or None
        Their indices; None stands for all particles.
    branch : bool
        Whether the value chooses a branch of `switch`.
    """

    name: str
    distribution: Distribution
    size: int
    rows: np.ndarray | None
    branch: bool

    @property
    def index(self) -> Any:
        """Index of the rows in arrays of all particles."""
        return slice(None) if self.rows is None else self.rows


class SiteHandler(ABC):
    """Decides the values of sites."""

    @abstractmethod
    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        """Values (size, ...) of a site and what they add to the log weights (None: nothing)."""

    @abstractmethod
    def row(self, index: int) -> SiteHandler:
        """The handler of one particle of a `per_particle` program."""


class SampleHandler(SiteHandler):
    """Draws every site."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        return site.distribution.sample(self.rng, site.size), None

    def row(self, index: int) -> SampleHandler:
        return SampleHandler(child(self.rng, "particle", index))


class GuideHandler(SiteHandler):
    """Draws every site, and keeps values and log densities for a `ReplayHandler`.

    Parameters
    ----------
    rng : Generator
    n : int
        Particles.
    """

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        self.rng, self.n = rng, n
        self.values: dict[str, np.ndarray] = {}
        self.log_q: dict[str, np.ndarray] = {}
        self.rows: list[GuideHandler] = []

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        value = site.distribution.sample(self.rng, site.size)
        log_q = self.log_q.setdefault(site.name, np.zeros(self.n))
        log_q[site.index] = site.distribution.log_prob(value)
        return value, None

    def row(self, index: int) -> GuideHandler:
        self.rows.append(GuideHandler(child(self.rng, "particle", index), 1))
        return self.rows[-1]


class ReplayHandler(SiteHandler):
    """Takes the values of a guide and weights them by f / q."""

    def __init__(self, guide: GuideHandler) -> None:
        self.guide = guide

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.guide.values:
            raise InputError(
                f"the guide has no site {site.name!r}, which the model samples",
                f'add sample("{site.name}", ...) to the guide; it has {sorted(self.guide.values)}',
            )
        value = self.guide.values[site.name][site.index]
        return value, site.distribution.log_prob(value) - self.guide.log_q[site.name][site.index]

    def row(self, index: int) -> ReplayHandler:
        return ReplayHandler(self.guide.rows[index])


class CentreHandler(SiteHandler):
    """Sets every site to the mean of its distribution (mode if discrete)."""

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        centre = np.asarray(site.distribution.centre)
        inner = centre.shape[1:] if centre.ndim and len(centre) in (1, site.size) else centre.shape
        return np.broadcast_to(centre, (site.size, *inner)), None

    def row(self, index: int) -> CentreHandler:
        return self


class ScoreHandler(SiteHandler):
    """Takes given values, weights them by their density, and keeps the sites.

    Parameters
    ----------
    values : mapping
        Value of each site.
    single : bool
        Whether they are the values of one particle, without the particle axis.
    """

    def __init__(self, values: Mapping[str, Any], single: bool = False) -> None:
        self.values, self.single = values, single
        self.sites: list[Site] = []

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.values:
            raise InputError(f"there is no value for site {site.name!r}")
        self.sites.append(site)
        value = np.asarray(self.values[site.name])[None] if self.single else self.values[site.name]
        value = value[site.index]
        return value, site.distribution.log_prob(value)

    def row(self, index: int) -> ScoreHandler:
        return ScoreHandler(self.values, self.single)


class ProgramRun:
    """One pass of a program.

    Parameters
    ----------
    handler : SiteHandler
        Decides the values.
    n : int
        Particles.
    single : bool
        Whether the program sees one particle's values without the particle axis.
    """

    def __init__(self, handler: SiteHandler, n: int, single: bool = False) -> None:
        self.handler, self.n, self.single = handler, n, single
        self.values: dict[str, np.ndarray] = {}
        self.returned: dict[str, Any] = {}
        self.gain = np.zeros(n)
        self._rows: np.ndarray | None = None
        self._split: set[str] = set()  # sites inside a branch

    def sample(self, name: str, distribution: Any, branch: bool = False) -> Any:
        rows = self._rows
        size = self.n if rows is None else len(rows)
        value, gain = self.handler.value(Site(name, as_distribution(distribution), size, rows, branch))
        self._store(name, value, rows)
        if gain is not None:
            self._add(gain, f"site {name!r}")
        return value[0] if self.single else value

    def observe(self, name: str, distribution: Any, value: Any) -> None:
        if value is not None:
            self._add(as_distribution(distribution).log_prob(value), f"observation {name!r}")

    def switch(self, name: str, probs: Any, branches: Sequence[Callable[..., Any]], args: tuple[Any, ...]) -> Any:
        distribution = Categorical(probs)
        if distribution.probs.shape[-1] != len(branches):
            raise InputError(
                f"switch {name!r} has {distribution.probs.shape[-1]} probabilities for {len(branches)} branches"
            )
        index = self.sample(name, distribution, branch=True)
        if self.single:
            return branches[int(index)](*args)
        outer, results, groups = self._rows, [], []
        for k, branch in enumerate(branches):  # also empty groups: the sites of all branches exist at every step
            group = np.flatnonzero(index == k)
            self._rows = group if outer is None else outer[group]
            groups.append(group)
            try:
                results.append(branch(*(None if a is None else take(a, group) for a in args)))
            finally:
                self._rows = outer
        return _merge(results, groups, len(index), name)

    def _store(self, name: str, value: np.ndarray, rows: np.ndarray | None) -> None:
        if rows is None:
            if name in self.values:
                raise InputError(f"site {name!r} is sampled twice in one step", "give every site its own name")
            self.values[name] = value
            return
        if name not in self.values:
            self.values[name] = _blank(value, self.n)
            self._split.add(name)
        if name not in self._split:
            raise InputError(f"site {name!r} is sampled inside and outside of a branch", "give them two names")
        values = self.values[name]
        values = values.astype(np.result_type(values, value), copy=False)
        values[rows] = value
        self.values[name] = values

    def _add(self, log_prob: Any, what: str) -> None:
        log_prob = np.asarray(log_prob)
        if self.single:
            self.gain += log_prob.sum()
            return
        target = self.gain if self._rows is None else self.gain[self._rows]
        if log_prob.ndim > 1 or (log_prob.ndim == 1 and len(log_prob) not in (1, len(target))):
            raise InputError(
                f"log probability of {what} has shape {log_prob.shape}, expected one number per particle, "
                f"({len(target)},)",
                "give the distribution one row per particle: parameters (n,) or (n, d)",
            )
        if self._rows is None:
            self.gain += log_prob
        else:
            self.gain[self._rows] += log_prob


def _blank(value: np.ndarray, n: int) -> np.ndarray:
    """(n, ...) values of a site that was not reached: NaN for floats, else 0."""
    fill = np.nan if np.issubdtype(value.dtype, np.floating) else 0
    return np.full((n, *value.shape[1:]), fill, dtype=value.dtype)


def _merge(results: list[Any], groups: list[np.ndarray], n: int, name: str) -> Any:
    """Values returned by the branches, each in its rows."""
    if all(r is None for r in results):
        return None
    if all(isinstance(r, Mapping) for r in results):
        if any(set(r) != set(results[0]) for r in results):
            raise InputError(f"branches of switch {name!r} return different names: {[sorted(r) for r in results]}")
        return {key: _merge([r[key] for r in results], groups, n, name) for key in results[0]}
    if any(r is None or isinstance(r, Mapping) for r in results):
        raise InputError(f"branches of switch {name!r} return different kinds of values")
    arrays = [np.asarray(r) for r in results]
    inner = next((a.shape[1:] for a in arrays if a.ndim), ())
    merged = np.zeros((n, *inner), dtype=np.result_type(*arrays))
    for group, array in zip(groups, arrays, strict=True):
        merged[group] = array
    return merged
