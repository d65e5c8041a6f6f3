"""What the lists of faulty and of right components are made of: entries, and inputs that a user would write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.mst.testing import scene_example as scene_example
from mstfilter.smc import Normal, Population


@dataclass(frozen=True)
class Entry:
    """A component, or a model, that `check` tests."""

    name: str
    kind: str  #: as `mstfilter list` names it
    what: str  #: the fault; for right ones what is unusual
    make: Callable[[], Any]  #: without arguments: the component
    example: Callable[..., Any] | None = None  #: as in a user's file
    exact: Callable[..., Any] | None = None


class Entries(list[Entry]):
    """A list of entries, to which `add` adds a class or a function without arguments."""

    def add(self, kind: str, what: str, **functions: Any) -> Callable[[Callable[[], Any]], Any]:
        def added(make: Callable[[], Any]) -> Any:
            name = make.__name__ if make.__name__ != "<lambda>" else what
            self.append(Entry(name, kind, what, make, **functions))
            return make

        return added


def plane_example(rng, n):
    """Particles in the plane."""
    return Population(rng.standard_normal((n, 2)), rng.standard_normal(n)), np.array([0.3, -0.1])


def words_example(rng, n):
    """Particles that are strings."""
    words = [str(w) for w in rng.choice(["shelf", "box", "can", "bottle", "tin"], n)]
    return Population(tuple(words), rng.standard_normal(n)), None


def mapping_example(rng, n):
    """Particles that are a mapping of arrays."""
    return Population({"x": rng.standard_normal((n, 2)), "v": rng.standard_normal(n)}, rng.standard_normal(n)), 0.2


def integer_example(rng, n):
    """Particles that are states 0 .. 4."""
    return Population(rng.integers(5, size=n), rng.standard_normal(n)), 2


def object_example(rng, n):
    """Particles that are tuples."""
    return Population(tuple((float(a), int(b)) for a, b in rng.normal(0, 9, (n, 2))), rng.standard_normal(n)), 0.5


def exact_ar1(rng, n, rho=0.9, sd=0.5, d=0):
    """x_{t-1}, x_t given it, y_t; the move does not use y_t."""
    previous = rng.standard_normal((n, d) if d else n)
    return Population(previous), Population(rng.normal(rho * previous, sd)), 0.4 if not d else np.array([0.3, -0.1])


def exact_moved(rng, n):
    """The same with log p(y_t | x_t), for guided moves."""
    return *exact_ar1(rng, n), lambda x: Normal(x, 1.0).log_prob(0.4)


def exact_weighted(rng, n):
    """Draws of x ~ N(0, 1), the same weighted by y ~ N(x, 0.5^2), y."""
    prior = Population(rng.standard_normal(n))
    return prior, prior.reweighted(Normal(prior.particles, 0.5).log_prob(0.4)), 0.4


def exact_prior(rng, n):
    """Draws of x_0 ~ N(0, 1), y."""
    return Population(rng.standard_normal(n)), 0.4


def exact_rejuvenated(rng, n):
    """x_{t-1}, draws of p(x_t | x_{t-1}, y_t) for x_t ~ N(0.9 x_{t-1}, 0.5^2) and y_t ~ N(x_t, 1), y_t."""
    previous = rng.standard_normal(n)
    mean = 0.9 * previous + 0.2 * (0.4 - 0.9 * previous)
    return Population(previous), Population(rng.normal(mean, np.sqrt(0.2))), 0.4
