"""What a probabilistic program calls: `sample`, `observe`, `switch`; and the run that they belong to.

A `Run` is one pass of a program over n particles. What a site's value is (drawn, replayed, its mean) is the business
of the run's handler; see `mstfilter.smc.program_runs`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.adapters import as_distribution
from mstfilter.smc.distribution import Distribution
from mstfilter.smc.distributions import Categorical
from mstfilter.smc.population import take

__all__ = ["Handler", "Run", "current", "observe", "sample", "switch"]

_RUN: ContextVar[Run | None] = ContextVar("run of a program", default=None)


class Handler(ABC):
    """Decides the values of sites."""

    @abstractmethod
    def site(
        self, name: str, distribution: Distribution, size: int, rows: np.ndarray | None, branch: bool
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Values of a site for `size` particles and what the log weights gain (None: nothing).

        `rows` are the particles concerned (None: all); `branch` says that the site chooses a branch.
        """

    @abstractmethod
    def row(self, index: int) -> Handler:
        """The handler of one particle of a `per_particle` program."""


class Run:
    """One pass of a program.

    Parameters
    ----------
    handler : Handler
        Decides the values.
    n : int
        Particles.
    single : bool
        Whether the program sees one particle's values without the particle axis.
    """

    def __init__(self, handler: Handler, n: int, single: bool = False) -> None:
        self.handler, self.n, self.single = handler, n, single
        self.values: dict[str, np.ndarray] = {}
        self.returned: dict[str, Any] = {}
        self.gain = np.zeros(n)
        self._rows: np.ndarray | None = None
        self._split: set[str] = set()  # sites that were met inside a branch

    def sample(self, name: str, distribution: Any, branch: bool = False) -> Any:
        """A site."""
        rows = self._rows
        size = self.n if rows is None else len(rows)
        value, gain = self.handler.site(name, as_distribution(distribution), size, rows, branch)
        self._store(name, value, rows)
        if gain is not None:
            self._add(gain, f"site {name!r}")
        return value[0] if self.single else value

    def observe(self, name: str, distribution: Any, value: Any) -> None:
        """An observation; None is missing."""
        if value is not None:
            self._add(as_distribution(distribution).log_prob(value), f"observation {name!r}")

    def switch(self, name: str, probs: Any, branches: Sequence[Callable[..., Any]], args: tuple[Any, ...]) -> Any:
        """Branches by a drawn number."""
        distribution = Categorical(probs)
        if distribution.probs.shape[-1] != len(branches):
            raise InputError(
                f"switch {name!r} has {distribution.probs.shape[-1]} probabilities for {len(branches)} branches"
            )
        index = self.sample(name, distribution, branch=True)
        if self.single:
            return branches[int(index)](*args)
        outer, results, groups = self._rows, [], []
        for k, branch in enumerate(branches):  # empty groups too: every branch's sites exist at every step
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
        whole = self.values[name]
        dtype = np.result_type(whole, value)
        if dtype != whole.dtype:
            whole = whole.astype(dtype)
        whole[rows] = value
        self.values[name] = whole

    def _add(self, log_prob: Any, what: str) -> None:
        log_prob = np.asarray(log_prob)
        if self.single:
            self.gain += log_prob.sum()
            return
        target = self.gain if self._rows is None else self.gain[self._rows]
        if log_prob.ndim > 1 or (log_prob.ndim == 1 and len(log_prob) not in (1, len(target))):
            raise InputError(
                f"log probability of {what} has shape {log_prob.shape}, expected one number a particle, "
                f"({len(target)},)",
                "give the distribution one row a particle: parameters (n,) or (n, d)",
            )
        if self._rows is None:
            self.gain += log_prob
        else:
            self.gain[self._rows] += log_prob


def _blank(value: np.ndarray, n: int) -> np.ndarray:
    """n rows in place of a site that was not visited: NaN where there is one, else 0."""
    fill = np.nan if np.issubdtype(value.dtype, np.floating) else 0
    return np.full((n, *value.shape[1:]), fill, dtype=value.dtype)


def _merge(results: list[Any], groups: list[np.ndarray], n: int, name: str) -> Any:
    """What the branches returned, each in its rows."""
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
    whole = np.zeros((n, *inner), dtype=np.result_type(*arrays))
    for group, array in zip(groups, arrays, strict=True):
        whole[group] = array
    return whole


def current() -> Run:
    """The run that is going on.

    Raises
    ------
    InputError
        Outside of a program.
    """
    run = _RUN.get()
    if run is None:
        raise InputError(
            "sample, observe or switch was called outside of a program",
            "run the function through Program(model).bootstrap(n) or another filter of it",
        )
    return run


def sample(name: str, distribution: Any) -> Any:
    """A random value of the step, kept in the particle under `name`.

    Parameters
    ----------
    name : str
        Once a step.
    distribution : Distribution
        Ours, a frozen one of scipy.stats, or one of torch; parameters have one row a particle.

    Returns
    -------
    ndarray (n, ...)
        One row a particle; a number or array without that axis in a `per_particle` program.
    """
    return current().sample(name, distribution)


def observe(name: str, distribution: Any, value: Any) -> None:
    """Weigh the particles by the probability of an observed value; None is missing and weighs nothing.

    Parameters
    ----------
    name : str
        For messages.
    distribution : Distribution
        Of the observation given the particle.
    value : array_like or None
        What was observed.
    """
    current().observe(name, distribution, value)


def switch(name: str, probs: Any, branches: Sequence[Callable[..., Any]], *args: Any) -> Any:
    """Draw a branch for each particle and run each branch on its particles.

    Parameters
    ----------
    name : str
        The number of the branch (n,) is kept under this name.
    probs : (k,) or (n, k) array_like
        Probabilities of the k branches.
    branches : sequence of callables
        Each is called once with the rows of `args` that belong to its particles, and may `sample`, `observe` and
        `switch`. A site with the same name in several branches is one array; where a particle did not visit a site
        its value is NaN (0 for whole numbers).
    *args : array (n, ...), mapping of such, or None
        Split by rows. What all particles share, such as the observation, comes by closure.

    Returns
    -------
    None, array (n, ...) or mapping
        What the branches returned, put together by rows.
    """
    return current().switch(name, probs, branches, args)
