"""Handlers determine the values of the sites of a program. A site is a call of `sample`.

A program says which distributions its values have, but not where the values come from. The same program can therefore
simulate, filter, and weigh given values, if something else answers its calls (the effect handlers of Pyro and Gen):

`SampleHandler`    draws each value from the model
`SimulateHandler`  draws observed values too
`GuideHandler`     draws values for a guide and notes their densities
`ReplayHandler`    hands the draws of the guide to the model, and weighs them by the ratio of the densities
`GivenHandler`     takes values from somewhere else, such as a path, and weighs them by their density

>>> import numpy as np
>>> from mstfilter.smc import Normal, sample
>>> from mstfilter.smc.models.programs.filters import run_program
>>> from mstfilter.smc.models.programs.handlers import GivenHandler
>>> def model(previous, y):
...     sample("x", Normal(0.0, 1.0))
>>> particles, log_density = run_program(model, GivenHandler({"x": np.array([0.0, 1.0])}), None, None, 2)
>>> log_density.round(3)
array([-0.919, -1.419])
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.interfaces import Distribution


class Site(NamedTuple):
    """A call of `sample` in the run of a program."""

    name: str
    distribution: Distribution
    size: int  #: number of particles that reach the site
    rows: np.ndarray | None  #: (size,) int, indices; None stands for all particles

    @property
    def index(self) -> Any:
        """Index of the rows in arrays of all particles."""
        return slice(None) if self.rows is None else self.rows


class SiteHandler(ABC):
    """Determines the values of sites (calls of `sample`)."""

    observes = True  #: whether the program may call `observe`
    draws = True  #: False if the handler takes given values

    @abstractmethod
    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        """Values (size, ...) of a site, and the change of the log weights (None: no change)."""

    def missing(self, site: Site) -> None:  # noqa: B027 (optional)
        """Called for an observation whose value is None, with its name, distribution and particles."""

    def finish(self, values: dict[str, np.ndarray]) -> None:  # noqa: B027 (optional)
        """Called at the end of a run of the program, with the values of all sites."""


class SampleHandler(SiteHandler):
    """Draws the value of every site from its distribution."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        return site.distribution.sample(self.rng, site.size), None


class SimulateHandler(SampleHandler):
    """Draws the value of every site, and of every observation that is missing, to make data."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self.observed: dict[str, Any] = {}  #: observation of the first particle, by name

    def missing(self, site: Site) -> None:
        drawn = site.distribution.sample(self.rng, site.size)
        if site.rows is None or 0 in site.rows[:1]:
            self.observed[site.name] = drawn[0]


class GuideHandler(SiteHandler):
    """Draws the value of every site of a guide, and stores values and log densities for a `ReplayHandler`."""

    observes = False

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        self.rng, self.n = rng, n
        self.values: dict[str, np.ndarray] = {}
        self.log_q: dict[str, np.ndarray] = {}
        self.reached: dict[str, np.ndarray] = {}  #: (n,) whether each particle reached the site

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        value = site.distribution.sample(self.rng, site.size)
        log_q = self.log_q.setdefault(site.name, np.full(self.n, np.nan))
        log_q[site.index] = site.distribution.log_prob(value)
        self.reached.setdefault(site.name, np.zeros(self.n, bool))[site.index] = True
        return value, None

    def finish(self, values: dict[str, np.ndarray]) -> None:
        self.values = dict(values)


class ReplayHandler(SiteHandler):
    """Takes the values of a guide, and weights particles by f / q (density of the model / density of the guide).

    What the guide has not drawn, a site or some particles of it, is drawn from the model, where f / q is 1.
    """

    def __init__(self, guide: GuideHandler, rng: np.random.Generator) -> None:
        self.guide, self.rng = guide, rng

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        reached = self.guide.reached.get(site.name, np.zeros(self.guide.n, bool))[site.index]
        if not reached.any():
            return site.distribution.sample(self.rng, site.size), None
        value, log_q = self.guide.values[site.name][site.index], self.guide.log_q[site.name][site.index]
        check_shape("the values of the guide", value, site.distribution, site.size)
        if reached.all():
            return value, site.distribution.log_prob(value) - log_q
        rows = reached.reshape(-1, *(1,) * (value.ndim - 1))
        value = np.where(rows, value, site.distribution.sample(self.rng, site.size))
        return value, np.where(reached, site.distribution.log_prob(value) - log_q, 0.0)

    def finish(self, values: dict[str, np.ndarray]) -> None:
        unused = sorted(set(self.guide.values) - set(values))
        if unused:
            raise InputError(
                f"the model has no site {unused[0]!r}, which the guide samples", f"it has {sorted(values)}"
            )


def check_shape(what: str, value: np.ndarray, distribution: Distribution, size: int) -> None:
    """Raise InputError if a value does not have the event shape of a distribution."""
    shape = distribution.value_shape(size)
    if value.shape != shape:
        raise InputError(
            f"{what} have shape {value.shape}, expected {shape} by the {type(distribution).__name__}",
            "the mean of a distribution states the event shape: it is (), (n,), (1, d) or (n, d)",
        )


class GivenHandler(SiteHandler):
    """Takes the value of each site from given values.

    Parameters
    ----------
    values : mapping of arrays (m, ...)
        Given values by the name of the site.
    rows : (n,) int, optional
        The rows of `values` that belong to the n particles. By default, all rows are used.
    weigh : bool or collection of str
        Whether the particles are weighted by the density of the values; or the names of the sites for which they are.
    """

    draws = False

    def __init__(
        self, values: Mapping[str, np.ndarray], rows: np.ndarray | None = None, weigh: bool | Collection[str] = True
    ) -> None:
        self.values, self.rows, self.weigh = values, rows, weigh
        self.names: set[str] = set()  #: of the sites that the program has sampled
        self.reached: set[str] = set()  #: of those that some particle has reached

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.values:
            raise InputError("there is no value for it")
        self.names.add(site.name)
        if site.size:
            self.reached.add(site.name)
        value = self.values[site.name][site.index if self.rows is None else self.rows[site.index]]
        check_shape("the values", value, site.distribution, site.size)
        weigh = self.weigh if isinstance(self.weigh, bool) else site.name in self.weigh
        return value, site.distribution.log_prob(value) if weigh else None
