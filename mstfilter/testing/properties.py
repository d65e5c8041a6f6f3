"""Properties as plain functions: each takes a component and examples, and raises `Broken` where it does not hold.

>>> suite = Suite("resampler")
>>> @suite.property("it returns n particles")
... def gives_n_particles(component, example):
...     ...
>>> [outcome.broken for outcome in suite.run(Systematic(), example)]
[None]

An `example(rng, n)` makes what a component works on: a population of n particles and an observation. The default
is n numbers; give your own where the component needs other particles.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc import Population

__all__ = [
    "Broken",
    "Exact",
    "Example",
    "NotApplicable",
    "Outcome",
    "Property",
    "Suite",
    "example",
    "guarded",
    "same",
]

Example = Callable[[np.random.Generator, int], tuple[Population, Any]]

#: Exact draws: ``(rng, n) -> (previous, population, observation)``.
Exact = Callable[[np.random.Generator, int], tuple[Population | None, Population, Any]]

#: False-alarm rate of each statistical property: how often a correct component is said to break it, at most.
FALSE_ALARM = 1e-6


class Broken(AssertionError):
    """A property does not hold; the message says how."""


class NotApplicable(Exception):
    """A property says nothing about this component; the message says why."""


def needs_proper_weights(component: Any) -> None:
    """Leave a property aside where the component does not promise proper weights."""
    if not component.properly_weighted:
        raise NotApplicable("the component says that it is not properly weighted")


@dataclass(frozen=True)
class Property:
    """Something that every component of a kind keeps.

    Parameters
    ----------
    name : str
        Of the function that checks it.
    says : str
        The property in words.
    check : callable
        ``(component, example) -> None``; raises `Broken`. With `needs_exact` it gets exact draws for the example.
    statistical : bool
        Whether it looks at random samples; then it alarms falsely with a probability of at most `FALSE_ALARM`.
    essential : bool
        Whether nothing else can be judged where it does not hold.
    needs_exact : bool
        Whether it compares with exact draws; it is left aside where there are none.
    """

    name: str
    says: str
    check: Callable[[Any, Any], None]
    statistical: bool = False
    essential: bool = False
    needs_exact: bool = False

    def look(self, component: Any, example: Example, exact: Exact | None) -> None:
        """Check it; raises `Broken` or `NotApplicable`."""
        if self.needs_exact and exact is None:
            raise NotApplicable("there are no exact draws to compare with: write exact(rng, n)")
        self.check(component, exact if self.needs_exact else example)


@dataclass(frozen=True)
class Outcome:
    """What came of one property.

    Parameters
    ----------
    property : Property
        Which.
    broken : str or None
        How it does not hold; None where it does.
    skipped : str or None
        Why it was not looked at.
    """

    property: Property
    broken: str | None = None
    skipped: str | None = None


@dataclass
class Suite:
    """The properties of one kind of component, in the order in which they are looked at."""

    kind: str
    properties: list[Property] = field(default_factory=list)

    def property(
        self, says: str, statistical: bool = False, essential: bool = False, needs_exact: bool = False
    ) -> Callable[[Callable[[Any, Any], None]], Callable[[Any, Any], None]]:
        """Decorator: the function becomes a property of this kind."""

        def add(check: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
            self.properties.append(Property(check.__name__, says, check, statistical, essential, needs_exact))
            return check

        return add

    def run(self, component: Any, example: Example, exact: Exact | None = None) -> Iterator[Outcome]:
        """Look at all properties, until one that the others need does not hold; the same fault is told only once."""
        told: set[str] = set()
        stopped = False
        for prop in self.properties:
            if stopped:
                yield Outcome(prop, skipped="not looked at: first mend what is broken above")
                continue
            try:
                with _global_state():
                    prop.look(component, example, exact)
            except NotApplicable as reason:
                yield Outcome(prop, skipped=f"not looked at: {reason}")
            except Broken as broken:
                words = str(broken)
                stopped = prop.essential
                yield Outcome(prop, skipped="same fault as above") if words in told else Outcome(prop, broken=words)
                told.add(words)
            else:
                yield Outcome(prop)


def example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """The default example: n unevenly weighted numbers, and an observation that is a number."""
    return Population(rng.standard_normal(n), 0.5 * rng.standard_normal(n)), 0.5


@contextmanager
def guarded(what: str) -> Iterator[None]:
    """Turn whatever a component raises into `Broken`, in words."""
    try:
        yield
    except (Broken, NotApplicable):
        raise
    except ValueError as error:
        if "read-only" in str(error):
            raise Broken("it changes its input in place: make a copy first") from error
        raise Broken(f"{what}: it raises {_named(error)}") from error
    except IndexError as error:
        raise Broken(f"{what}: an index is out of range ({error}); off by one?") from error
    except Exception as error:
        raise Broken(f"{what}: it raises {_named(error)}") from error


@contextmanager
def only_in_place() -> Iterator[None]:
    """Let faults pass that are the business of other properties: all but a change of the input in place."""
    try:
        with guarded("run once"):
            yield
    except Broken as broken:
        if "in place" in str(broken):
            raise


def _named(error: Exception) -> str:
    return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal: arrays bit for bit, dataclasses by field; what has no equality is equal."""
    if a is b:
        return True
    if type(a) is not type(b):
        return bool(isinstance(a, (float, np.floating)) and isinstance(b, (float, np.floating)) and a == b)
    if isinstance(a, np.ndarray):
        if a.dtype == object:
            return a.shape == b.shape and all(same(x, y) for x, y in zip(a.ravel(), b.ravel(), strict=True))
        return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, Mapping):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, str):
        return bool(a == b)
    if isinstance(a, Sequence):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if type(a).__eq__ is object.__eq__:
        return True
    return bool(np.all(a == b))


def same_population(a: Population, b: Population) -> bool:
    """Equal particles, weights and parents."""
    return (
        same(a.log_weights, b.log_weights)
        and same(dict(a.parents), dict(b.parents))
        and same(a.realised().particles, b.realised().particles)
    )


def add_generator_properties(suite: Suite, run: Callable[[Any, Example, np.random.Generator], Any]) -> None:
    """The discipline of everything that draws: its own generator and nothing else.

    Parameters
    ----------
    suite : Suite
        Gets the properties.
    run : callable
        ``(component, example, rng) -> result`` uses the component once.
    """

    @suite.property("the same generator gives the same result", essential=True)
    def repeats_with_the_same_generator(component: Any, example: Example) -> None:
        results = []
        with guarded("run twice"), _global_state():
            for seed in (7, 7, 8, 8, 9, 9):
                np.random.seed(seed)  # noqa: NPY002 (a global draw is the next property's business)
                random.seed(seed)
                results.append(run(component, example, np.random.default_rng(seed)))
        for a, b in zip(results[::2], results[1::2], strict=True):
            if not (same_population(a, b) if isinstance(a, Population) else same(a, b)):
                raise Broken("two runs with equal generators differ: something random does not come from `rng`")

    @suite.property("it leaves the global generators of numpy and Python alone", essential=True)
    def leaves_global_generators_alone(component: Any, example: Example) -> None:
        with guarded("run once"), _global_state():
            before = np.random.get_state(), random.getstate()  # noqa: NPY002
            run(component, example, np.random.default_rng(7))
            after = np.random.get_state(), random.getstate()  # noqa: NPY002
        if not same(before[0], after[0]):
            raise Broken("it draws from numpy's global generator (np.random.*): draw from `rng` instead")
        if before[1] != after[1]:
            raise Broken("it draws from Python's global generator (random.*): draw from `rng` instead")


@contextmanager
def _global_state() -> Iterator[None]:
    """Put the global generators back afterwards."""
    numpy_state, python_state = np.random.get_state(), random.getstate()  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(numpy_state)  # noqa: NPY002
        random.setstate(python_state)


class Untouched:
    """Remembers values, and says whether they are still the same."""

    def __init__(self, **values: Any) -> None:
        self._values = values
        self._before = {name: copy.deepcopy(_open(value)) for name, value in values.items()}

    def verify(self) -> None:
        """Raise `Broken` where one has changed."""
        for name, value in self._values.items():
            if not same(_open(value), self._before[name]):
                raise Broken(f"it changes its input in place ({name}): make a copy first")


def _open(value: Any) -> Any:
    """A population as plain parts."""
    if isinstance(value, Population):
        return [value.realised().particles, value.log_weights, dict(value.parents)]
    return value
