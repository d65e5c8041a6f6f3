"""Handlers determine the values of the sites of a program. A site is a call of `sample`.

A handler draws a value, replays the draw of a guide, or takes a given value.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
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
        self.log_q: dict[str, np.ndarray] = {}  #: NaN for particles that do not reach the site

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        value = site.distribution.sample(self.rng, site.size)
        log_q = self.log_q.setdefault(site.name, np.full(self.n, np.nan))
        log_q[site.index] = site.distribution.log_prob(value)
        return value, None

    def finish(self, values: dict[str, np.ndarray]) -> None:
        self.values = dict(values)


class ReplayHandler(SiteHandler):
    """Takes the values of a guide, and weights particles by f / q (density of the model / density of the guide)."""

    def __init__(self, guide: GuideHandler) -> None:
        self.guide = guide

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.guide.values:
            raise InputError(
                "the guide has no such site",
                f'add sample("{site.name}", ...) to the guide; it has {sorted(self.guide.values)}',
            )
        value, log_q = self.guide.values[site.name][site.index], self.guide.log_q[site.name][site.index]
        check_shape("the values of the guide", value, site.distribution, site.size)
        missing = int(np.isnan(log_q).sum())
        if missing:
            raise InputError(
                f"the guide does not draw it for {missing} of {site.size} particles",
                "sample it in the same branches as in the model, or outside of the branches",
            )
        return value, site.distribution.log_prob(value) - log_q

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
    weigh : bool
        Whether the particles are weighted by the density of the values.
    """

    draws = False

    def __init__(self, values: Mapping[str, np.ndarray], rows: np.ndarray | None = None, weigh: bool = True) -> None:
        self.values, self.rows, self.weigh = values, rows, weigh
        self.names: set[str] = set()  #: of the sites that the program has sampled

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.values:
            raise InputError("there is no value for it")
        self.names.add(site.name)
        value = self.values[site.name][site.index if self.rows is None else self.rows[site.index]]
        check_shape("the values", value, site.distribution, site.size)
        return value, site.distribution.log_prob(value) if self.weigh else None
