"""The functions that a program calls (`sample`, `observe`, `switch`), and `ProgramRun`, one run of a program.

A program runs once per step for all particles, so a site has one value per particle: an array (n, ...). `switch` is
an
``if`` for arrays. It draws a branch for each particle, and runs each branch on the rows of its particles:

>>> from mstfilter.smc import Normal, Program, observe, sample, switch
>>> def model(previous, y):
...     def near(x):
...         return sample("x", Normal(0.0 if x is None else x, 0.1))
...     def far(x):
...         return sample("x", Normal(0.0 if x is None else x, 3.0))
...     x = switch("jump", [0.9, 0.1], [near, far], None if previous is None else previous["x"])
...     observe("y", Normal(x, 0.2), y)
>>> state, infos = Program(model).bootstrap(300).run([0.1, 4.0], seed=0)
>>> round(float(state.population.mean()["jump"]), 6)                # only a jump explains the second observation
1.0

`ProgramRun` stores the values by name, adds up the log densities of what is observed, and checks that no particle
reaches two sites of one name. Where the values come from is for a handler to say
(`mstfilter.smc.models.programs.handlers`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from typing import Any, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.first_steps import made_runs
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.models.distributions import Categorical, Joint, as_distribution
from mstfilter.smc.models.programs.handlers import Site, SiteHandler, check_shape
from mstfilter.smc.population import frozen_view, take

active_run: ContextVar[ProgramRun | None] = ContextVar("run of a program", default=None)


def sample(name: str, distribution: Any) -> Any:
    """Draw a random value for each particle, and store the value in the particles under `name`.

    The name is unique within a step, but different branches of a `switch` may use the same name. The distribution is
    one of this package, or a frozen one of scipy.stats, with one row of parameters per particle. Returns a read-only
    array ``(n, *event_shape)``.
    """
    return _current().sample(name, distribution)


def observe(name: str, distribution: Any, value: Any) -> None:
    """Weight the particles by the density of an observed value; None (a missing value) has no effect.

    `distribution` is the distribution of the observation given the particle. The value has the event shape of the
    distribution, or shape ``(n, *event_shape)`` if each particle has its own value, such as the measurement that the
    particle associates with an object. Error messages use `name`.
    """
    _current().observe(name, distribution, value)


def switch(name: str, probs: Any, branches: Sequence[Callable[..., Any]], *args: Any) -> Any:
    """Draw a branch for each particle and run each branch on its particles.

    Parameters
    ----------
    name : str
        The index of the branch (n,) is stored in the particles under `name`.
    probs : (k,) or (n, k) array_like
    branches : sequence of callables
        Each branch is called once with the rows of `args` that belong to its particles. A branch may call `sample`,
        `observe` and `switch`. Several branches may sample one name, and their values form one array. The entries of
        particles that do not reach a call are NaN (0 for integers). A branch without particles is also called.
    *args : array (n, ...), mapping of such, or None
        Arguments whose rows are split among the branches. A branch reads values shared by all particles from its
        closure.

    Returns the values returned by the branches, merged by rows.
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


class Call(NamedTuple):
    """A call of `sample` or `observe`, or a branch of `switch`, in a run."""

    what: str  #: description, for messages
    k: int  #: position among the calls of this description
    rows: np.ndarray | None  #: (size,) indices of the particles, ascending; None stands for all
    size: int
    log_prob: Any = 0.0  #: of an observation; (size,), or one for all
    distribution: Distribution | None = None  #: of a site
    value: Any = None  #: (size, ...) of a site

    @property
    def reached(self) -> np.ndarray:
        """(size,) indices of the particles that reach the call."""
        return np.arange(self.size) if self.rows is None else self.rows

    def positions(self, rows: np.ndarray) -> np.ndarray:
        """(k,) positions of `rows` among the particles of the call; -1 for particles that do not reach the call."""
        if self.rows is None:
            return rows
        if not self.size:
            return np.full(len(rows), -1)
        k = np.minimum(np.searchsorted(self.rows, rows), self.size - 1)
        return np.where(self.rows[k] == rows, k, -1)

    def densities(self, values: Any) -> np.ndarray:
        """(size,) log densities of an observation, or of `values` (size, ...) at a site."""
        log_prob = self.log_prob
        if self.distribution is not None:
            with np.errstate(all="ignore"):
                log_prob = self.distribution.log_prob(values)
        log_prob = np.asarray(log_prob, np.float64)
        return log_prob if log_prob.shape == (self.size,) else np.broadcast_to(log_prob, (self.size,))


class ProgramRun:
    """One run of a program over n particles. The handler determines the values of the sites."""

    def __init__(self, handler: SiteHandler, n: int) -> None:
        self.handler, self.n = handler, n
        self.values: dict[str, np.ndarray] = {}
        self.returned: dict[str, Any] = {}
        self.gain = np.zeros(n)
        self._last, self.inside = ("", "", ""), False  # the last call, and whether it is being processed
        runs = made_runs()
        self.calls: list[Call] | None = None if runs is None else []  # if they are recorded
        self.function: Any = None  # of the program
        if runs is not None:
            runs.append(self)
        self._rows: np.ndarray | None = None
        self._path: tuple[tuple[str, int], ...] = ()
        self._where = ""  # the branch, for messages
        self._paths: dict[str, list[tuple[tuple[str, int], ...]]] = {}

    @property
    def what(self) -> str:
        """Description of the last site or observation, for error messages."""
        kind, name, where = self._last
        return f"{kind} {name!r}{where}" if kind else ""

    @property
    def _size(self) -> int:
        """Number of particles in the current branch."""
        return self.n if self._rows is None else len(self._rows)

    def sample(self, name: str, distribution: Any) -> Any:
        self._last, self.inside = ("site", name, self._where), True
        rows, size, distribution = self._rows, self._size, as_distribution(distribution)
        if isinstance(distribution, Joint):
            raise InputError("a site has one variable", "call sample once for each variable, in order")
        self._check_name(name)
        value, gain = self.handler.value(Site(name, distribution, size, rows))
        value = frozen_view(np.asarray(value))
        if gain is None:
            if value.shape != (size,):
                check_shape("its draws", value, distribution, size)
            if self.handler.draws and not distribution.draws_numbers:
                _check_draws(value, distribution)
        self._note(distribution=distribution, value=value)
        self._store(name, value, rows)
        if gain is not None:
            self._add(gain, size)
        self.inside = False
        return value

    def observe(self, name: str, distribution: Any, value: Any) -> None:
        self._last, self.inside = ("observation", name, self._where), True
        if not self.handler.observes:
            raise InputError("a guide does not observe, the model weights the particles", "remove it from the guide")
        if value is None:
            self.handler.missing(Site(name, as_distribution(distribution), self._size, self._rows))
        else:
            distribution = as_distribution(distribution)
            found: tuple[int, ...] = () if isinstance(value, float) else np.shape(value)
            self._check_event(distribution, found)
            if found and any(value is v for v in self.values.values()):
                raise InputError(
                    "the value is that of a site, which is drawn and not observed",
                    'a factor is an observation of a constant, such as observe("factor", Normal(x, 1.0), 0.0)',
                )
            if self.calls is not None:
                distribution.check_parameters()
            log_prob = distribution.log_prob(value)
            self._note(log_prob=log_prob)
            self._add(log_prob, self._size)
        self.inside = False

    def _check_event(self, distribution: Distribution, found: tuple[int, ...]) -> None:
        """Raise InputError unless an observed value of shape `found` is one event, or one event per particle."""
        size = self._size
        event = distribution.value_shape(size)[1:]
        if found == event or found in ((1, *event), (size, *event)) or (found, event) == ((), (1,)):
            return
        if len(found) > 1 and found[0] == size and not distribution.parameter_shape:
            return  # the entries of each particle have the same parameters
        hints = ["a vector of k entries needs parameters (n, k) or (1, k), such as Normal(x[:, None], 1.0)"]
        if len(found) < len(event):
            hints = ["give all entries of the vector, or observe one entry by its parameters, such as x[:, 0]"]
        if size in event:
            hints.append("arrays (n, 1) and (n,) combine to (n, n): use x[:, 0], or z[:, None]")
        raise InputError(f"the value has shape {found}, expected {event}", *hints)

    def switch(self, name: str, probs: Any, branches: Sequence[Callable[..., Any]], args: tuple[Any, ...]) -> Any:
        self._last, self.inside = ("switch", name, ""), True
        distribution = Categorical(probs)
        if distribution.probs.shape[-1] != len(branches):
            raise InputError(f"{distribution.probs.shape[-1]} probabilities for {len(branches)} branches")
        for k, argument in enumerate(args):
            _check_rows(argument, self._size, k)
        index = self.sample(name, distribution)
        outer, path, where, results, groups = self._rows, self._path, self._where, [], []
        for k, branch in enumerate(branches):  # also empty groups: the sites of all branches exist at every step
            group = np.flatnonzero(index == k)
            self._rows, self._path = group if outer is None else outer[group], (*path, (name, k))
            self._where = f" in branch {k} of {name!r}"
            groups.append(group)
            self._last = (f"branch {k} of switch", name, "")
            self._note()
            try:
                results.append(branch(*(None if a is None else take(a, group) for a in args)))
            finally:
                self._rows, self._path, self._where = outer, path, where
        self._last, self.inside = ("switch", name, ""), True
        merged = _merge(results, groups, len(index))
        self.inside = False
        return merged

    def _note(self, **fields: Any) -> None:
        """Append the present call to `calls` if calls are recorded."""
        if self.calls is not None:
            k = sum(call.what == self.what for call in self.calls)
            self.calls.append(Call(self.what, k, self._rows, self._size, **fields))

    def _check_name(self, name: str) -> None:
        """Raise InputError if a particle may reach two sites with the same name."""
        if not isinstance(name, str):
            raise InputError(f"the name of a site is a {type(name).__name__}", 'write sample("x", distribution)')
        if name not in self._paths:
            self._paths[name] = [self._path]
            return
        for other in self._paths[name]:
            apart = [(mine, theirs) for mine, theirs in zip(self._path, other, strict=False) if mine != theirs]
            if not apart:
                raise InputError("sampled twice in one step", "give every site its own name")
            (mine, _), (theirs, _) = apart[0]
            if mine != theirs:
                raise InputError(
                    f"sampled in branches of two switches, {theirs!r} and {mine!r}, and a particle may reach both",
                    "give every site its own name",
                )
        self._paths[name].append(self._path)

    def _store(self, name: str, value: np.ndarray, rows: np.ndarray | None) -> None:
        if rows is None:
            self.values[name] = value
            return
        values = self.values.get(name)
        if values is None:  # particles that reach no such site keep the value NaN, or 0 if it is no float
            fill = np.nan if np.issubdtype(value.dtype, np.floating) else 0
            values = np.full((self.n, *value.shape[1:]), fill, dtype=value.dtype)
        if values.shape[1:] != value.shape[1:]:
            raise InputError(
                f"values have event shape {value.shape[1:]} here, {values.shape[1:]} in another branch",
                "give the sites two names",
            )
        values = values.astype(np.result_type(values, value), copy=False)
        values[rows] = value
        self.values[name] = values

    def _add(self, log_prob: Any, size: int) -> None:
        log_prob = np.asarray(log_prob)
        if log_prob.shape not in ((size,), (), (1,)):
            raise InputError(f"log_prob has shape {log_prob.shape}, expected one number per particle, ({size},)")
        if self.calls is not None and size and not log_prob.max() < np.inf:
            wrong = np.flatnonzero(~(np.atleast_1d(log_prob) < np.inf))
            raise InputError(
                f"log density is {np.atleast_1d(log_prob)[wrong[0]]} for {len(wrong)} of {size} particles",
                "is a parameter out of range, such as a negative scale, or is the observation NaN?",
                "one that is missing is None",
            )
        if self._rows is None:
            self.gain += log_prob
        else:
            self.gain[self._rows] += log_prob


def _check_draws(value: np.ndarray, distribution: Distribution) -> None:
    """Raise InputError if a draw is NaN, or if a continuous distribution draws integers."""
    if value.dtype.kind == "f":
        if not math.isfinite(np.vdot(value, value)) and np.isnan(value).any():
            rows = np.unique(np.nonzero(np.isnan(value))[0])
            raise InputError(
                f"its draw is NaN in row {rows[0]} ({len(rows)} of {len(value)})", "is a parameter out of range?"
            )
    elif value.dtype.kind in "iub" and not distribution.discrete:
        raise InputError(
            f"its draws are {value.dtype}, and a {type(distribution).__name__} is continuous",
            "set discrete = True in the class, or draw floats",
        )


def _check_rows(argument: Any, size: int, k: int) -> None:
    """Raise InputError unless the argument of a `switch` has one row per particle."""
    for value in argument.values() if isinstance(argument, Mapping) else (argument,):
        if value is not None and (np.ndim(value) == 0 or len(value) != size):
            raise InputError(
                f"argument {k} of the branches has shape {np.shape(value)}, expected one row for each of {size} "
                "particles",
                "a branch can use values that all particles share, such as the observation, without an argument",
            )


def _merge(results: list[Any], groups: list[np.ndarray], n: int) -> Any:
    """Merge the values returned by the branches: each branch fills the rows of its particles."""
    if all(r is None for r in results):
        return None
    if all(isinstance(r, Mapping) for r in results):
        if any(set(r) != set(results[0]) for r in results):
            raise InputError(f"branches return different names: {[sorted(r) for r in results]}")
        return {key: _merge([r[key] for r in results], groups, n) for key in results[0]}
    if any(r is None or isinstance(r, Mapping) for r in results):
        raise InputError("branches return different kinds of values: None, arrays or mappings")
    arrays = [np.asarray(r) for r in results]
    inner = max(arrays, key=np.ndim).shape[1:]
    merged = np.zeros((n, *inner), dtype=np.result_type(*arrays))
    for k, (group, array) in enumerate(zip(groups, arrays, strict=True)):
        if array.shape not in ((), inner, (1, *inner), (len(group), *inner)):
            raise InputError(
                f"branch {k} returns an array of shape {array.shape}, expected one row for each of its particles, "
                f"{(len(group), *inner)}",
                "a branch takes arrays of particles as arguments, which hold its particles only",
            )
        merged[group] = array
    return merged
