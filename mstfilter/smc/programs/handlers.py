"""Handlers, which determine the values of the sites of a program.

A value is a draw, a replayed draw of a guide, or given.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.distributions import Categorical
from mstfilter.smc.interfaces import Distribution


class Site(NamedTuple):
    """A call of `sample` in a run."""

    name: str
    distribution: Distribution
    size: int  #: number of particles that reach the site
    rows: np.ndarray | None  #: (size,) int, indices; None stands for all particles
    branch: bool  #: whether the value chooses a branch of `switch`

    @property
    def index(self) -> Any:
        """Index of the rows in arrays of all particles."""
        return slice(None) if self.rows is None else self.rows


class SiteHandler(ABC):
    """Determines the values of sites.

    Attributes
    ----------
    observes : bool
        Whether the program may observe.
    draws : bool
        Whether the values are new rather than given.
    strict : bool
        Whether a log density of NaN or +inf is an error.
    """

    observes = True
    draws = True
    strict = False

    @abstractmethod
    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        """Values (size, ...) of a site, and the change of the log weights (None: no change)."""

    def finish(self, values: dict[str, np.ndarray]) -> None:  # noqa: B027 (optional)
        """End a pass in which the sites have the given values."""


class SampleHandler(SiteHandler):
    """Draws every site."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        return site.distribution.sample(self.rng, site.size), None


class GuideHandler(SiteHandler):
    """Draws every site for n particles, and stores values and log densities for a `ReplayHandler`."""

    observes = False

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        self.rng, self.n = rng, n
        self.values: dict[str, np.ndarray] = {}
        self.log_q: dict[str, np.ndarray] = {}
        self.sites: dict[str, list[Site]] = {}

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        value = site.distribution.sample(self.rng, site.size)
        log_q = self.log_q.setdefault(site.name, np.zeros(self.n))
        log_q[site.index] = site.distribution.log_prob(value)
        self.sites.setdefault(site.name, []).append(site)
        return value, None

    def finish(self, values: dict[str, np.ndarray]) -> None:
        self.values = dict(values)


class ReplayHandler(SiteHandler):
    """Takes the values of a guide and weights them by f / q."""

    def __init__(self, guide: GuideHandler) -> None:
        self.guide = guide

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.guide.values:
            raise InputError(
                "the guide has no such site",
                f'add sample("{site.name}", ...) to the guide; it has {sorted(self.guide.values)}',
            )
        value = self.guide.values[site.name][site.index]
        self._compare(site, self.guide.sites[site.name])
        check_shape("the values of the guide", value, site.distribution, site.size)
        return value, site.distribution.log_prob(value) - self.guide.log_q[site.name][site.index]

    def _compare(self, site: Site, drawn: list[Site]) -> None:
        """Raise unless the guide draws the values that the model needs."""
        model, everywhere = site.distribution, False
        for other in drawn:
            guide, everywhere = other.distribution, everywhere or other.rows is None
            if guide.discrete != model.discrete:
                kinds = [f"{'discrete' if d.discrete else 'continuous'} {type(d).__name__}" for d in (guide, model)]
                raise InputError(f"the guide draws from a {kinds[0]}, the model from a {kinds[1]}")
            if isinstance(guide, Categorical) and isinstance(model, Categorical):
                k, needed = guide.probs.shape[-1], model.probs.shape[-1]
                if k < needed or (site.branch and k != needed):
                    raise InputError(
                        f"the guide chooses from {k} {'branches' if site.branch else 'categories'}, the model from "
                        f"{needed}",
                        "give the guide as many; it may give those that the observation excludes a probability of 0",
                    )
        if everywhere:
            return
        reached = np.zeros(self.guide.n, dtype=bool)
        for other in drawn:
            reached[other.rows] = True
        missing = site.size - int(reached[site.index].sum())
        if missing:
            raise InputError(
                f"the guide does not draw it for {missing} of {site.size} particles",
                "sample it in the same branches as in the model, or outside of the branches",
            )

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


class CopyHandler(SiteHandler):
    """Gives the particles the values that the particles `rows` have in `values`."""

    draws = False

    def __init__(self, values: Mapping[str, np.ndarray], rows: np.ndarray) -> None:
        self.values, self.rows = values, rows

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.values:
            raise InputError("the particle reaches it alone, and not among the others")
        shape = site.distribution.value_shape(site.size)
        if self.values[site.name].shape[1:] != shape[1:]:
            return np.zeros(shape), None  # an error later
        return self.values[site.name][self.rows[site.index]], None


class ScoreHandler(SiteHandler):
    """Takes given values of each site, weights them by their density, and records the sites.

    With `strict`, a log density of NaN or +inf is an error.
    """

    draws = False

    def __init__(self, values: Mapping[str, np.ndarray], strict: bool = False) -> None:
        self.values, self.strict = values, strict
        self.sites: list[Site] = []

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        if site.name not in self.values:
            raise InputError("there is no value for it")
        self.sites.append(site)
        value = self.values[site.name][site.index]
        check_shape("the values", value, site.distribution, site.size)
        return value, site.distribution.log_prob(value)
