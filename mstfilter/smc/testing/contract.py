"""The base class of all contracts, and a function that runs a contract without pytest.

A contract is a test class for pytest. The contract defines the arguments of calls (`inputs`, `variants`), the call
(`call`), and the requirements of every result (`check_result`). Each further ``test_`` method checks one property.
The first line of the docstring of a test states the property, and the message of a failure states the violation:

>>> from mstfilter.smc import EssBelow
>>> from mstfilter.smc.testing import Contract, check_properties
>>> class TriggerContract(Contract):
...     returns = bool
...     def call(self, component, rng, inputs):
...         return component.wants(inputs["population"], 0)
...     def test_even_weights_are_kept(self):
...         '''Particles of equal weight are not resampled.'''
...         population = self.inputs(6)["population"]
...         even = population.take([0] * 6)
...         assert not self.make().wants(even, 0), "it resamples equal weights"
>>> results = check_properties(EssBelow(0.5), TriggerContract)
>>> results[-1].statement, results[-1].failure
('Particles of equal weight are not resampled.', None)

General tests, which every contract inherits, are those of repeatability, of inputs that stay as they are, and of
generators of the component's own. This module does not import pytest, because pytest accepts `unittest.SkipTest`.
"""

from __future__ import annotations

import copy
import inspect
import math
import random
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar
from unittest import SkipTest, mock

import numpy as np

from mstfilter.base.errors import InputError, describe_error
from mstfilter.base.fields import copied
from mstfilter.smc import Population, as_matrix

#: Largest probability that a statistical test fails for a correct component.
FALSE_ALARM = 1e-6

_Test = TypeVar("_Test", bound=Callable[..., None])


def statistical(test: _Test) -> _Test:
    """Mark a test with random samples, which fails for a correct component with probability `FALSE_ALARM`."""
    test.statistical = True  # type: ignore[attr-defined]
    return test


def prerequisite(test: _Test) -> _Test:
    """Mark a test on which later tests depend. If the test fails, `check_properties` skips the later tests."""
    test.prerequisite = True  # type: ignore[attr-defined]
    return test


class OutOfTime(SkipTest):
    """The time of a test is used up. The message says what was tested until then."""


_GENERATOR = np.random.default_rng  # the function itself: a test replaces it for the component


def seeded(seed: int = 0) -> np.random.Generator:
    return _GENERATOR(seed)


class Contract:
    """Base class of all contracts. Inherit the contract of an interface, define `make`, and run pytest.

    A contract for a new interface defines `inputs`, `call` and `check_result`, and adds tests.
    """

    returns: ClassVar[type] = object  #: type of the result of a call
    until = math.inf  #: value of `time.monotonic` at which a test ends; `check_properties` sets it
    tested = "out of time"  #: what is said if the test ends there; a test may say how far it came

    def make(self) -> Any:
        """The component to test."""
        raise NotImplementedError(f"{type(self).__name__} needs a method make(self) that returns the component")

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """A population of `n` weighted particles for the component (by default floats), and an observation."""
        return Population(rng.standard_normal(n), 0.5 * rng.standard_normal(n)), 0.5

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        """Arguments of a typical call, without the generator. By default, `example` makes the arguments."""
        population, observation = self.example(seeded(seed), n)
        return {"population": population, "observation": observation}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Call the component once."""
        raise NotImplementedError

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        """Assert the requirements that every result must meet, except its type."""

    def checked_call(self, component: Any, inputs: dict[str, Any], rng: np.random.Generator | None = None) -> Any:
        """Call the component once and check the result. The message of an exception describes the inputs."""
        self.check_time()
        with reports_errors(inputs):
            result = self.call(component, seeded(3) if rng is None else rng, inputs)
        kind, expected = type(result).__name__, self.returns.__name__
        assert isinstance(result, self.returns), f"it returns {kind}, expected {expected}"
        self.check_result(result, inputs)
        return result

    def variants(self) -> list[dict[str, Any]]:
        """Arguments of the calls that the tests make: six particles, and for array particles also one particle."""
        few = self.inputs(6)
        objects = isinstance(getattr(few.get("population"), "particles", None), tuple)
        return [few] if objects else [few, self.inputs(1)]

    @cached_property
    def remarks(self) -> list[str]:
        """What the test that is running says although the property holds."""
        return []

    def check_time(self, seconds: float = 0.0, what: str = "") -> None:
        """End the test if its time is used up, or if less than `seconds` are left for what comes next."""
        left = self.until - time.monotonic()
        if left <= 0 or seconds > left:
            raise OutOfTime(what or self.tested)

    @property
    def on_numbers(self) -> bool:
        """Whether the particles are those of the base class: independent normal numbers, with observation 0.5."""
        return type(self).example is Contract.example

    def fresh(self) -> Any:
        """A component that has not been called: a copy of the result of `make`, if the component can be copied."""
        return copied(self.make())

    @prerequisite
    def test_result_is_valid(self) -> None:
        """Every result has the type, the size and the values that the interface requires."""
        for inputs in self.variants():
            self.checked_call(self.make(), inputs)

    @prerequisite
    def test_does_not_change_input(self) -> None:
        """A call leaves its input unchanged."""
        for inputs in self.variants():
            before = copy.deepcopy(_plain(inputs))
            try:
                self.call(self.make(), seeded(3), inputs)
            except Exception as error:  # other tests report other errors
                assert not _writes_to_read_only(error), "it changes its input in place: make a copy first"
            for name, value in _plain(inputs).items():
                assert same(value, before[name]), f"it changes its input in place ({name}): make a copy first"

    @prerequisite
    def test_depends_on_its_arguments_only(self) -> None:
        """Equal arguments and generators give equal results. With ``draws = False`` the generator is not used."""
        used, draws, found = self.fresh(), getattr(self.make(), "draws", True), []
        uses = own = False
        for inputs in (self.inputs(6, 1), *self.variants()):
            self.check_time()
            rngs = [seeded(7) for _ in range(3)]
            components = self.fresh(), self.fresh(), used
            with skips_errors(), _own_generators(type(used).__module__) as generators:
                found.append([_plain(self.call(*c, inputs)) for c in zip(components, rngs, strict=True)])
            advanced = rngs[0].bit_generator.state != seeded(7).bit_generator.state
            assert draws or not advanced, "it declares draws = False and draws from its generator"
            if draws and not (advanced or uses):  # child streams do not advance a generator
                with skips_errors():
                    uses = not same(found[-1][0], _plain(self.call(self.fresh(), seeded(8), inputs)))
            uses, own = uses or advanced, own or bool(generators)
        assert all(same(one, again) for one, again, _ in found), (
            "two runs with equal generators differ: a random number does not come from `rng`"
        )
        assert all(same(one, later) for one, _, later in found), (
            "a component that was used before gives another result than a new one: it keeps state, for example "
            "values of its first call"
        )
        if draws and not uses:
            self.check_unused_generator(own)

    def check_unused_generator(self, own: bool) -> None:
        """Judge a component with ``draws = True`` that never uses its generator. `own`: it makes another one."""
        cls = type(self.make())
        declared = any("draws" in vars(base) for base in cls.__mro__ if not base.__module__.startswith("mstfilter."))
        assert not own, "it never uses its generator, and draws from another one: use `rng` only"
        assert not declared, "it declares draws = True and never uses its generator"
        if isinstance(getattr(cls, "draws", None), property):
            self.remarks.append("it never uses its generator; draws = False in the class says so")


class ScaleContract(Contract):
    """Base class of contracts for components that take weighted particles."""

    #: Name of the argument with the weights; in the first of the variants, no other argument has weights.
    weighted: ClassVar[str] = "population"

    def test_scale_of_weights_is_irrelevant(self) -> None:
        """A common factor of the input weights has no effect, except the same factor of the output weights."""
        component, inputs = self.make(), self.variants()[0]
        population, result = inputs[self.weighted], self.checked_call(component, inputs)
        for shift in (0.5, 50.0, -50.0, 1e4, -1e4):
            given = population.reweighted(np.full(len(population), shift))
            fault = f"log weights + {shift:g} (overflow or underflow?)"
            try:
                with np.errstate(all="ignore"):
                    found = self.checked_call(component, {**inputs, self.weighted: given})
            except AssertionError as error:
                raise AssertionError(f"{fault}: {error}") from error
            if not isinstance(result, Population):
                assert result == found, f"{fault} change its answer"
                continue
            a, b = (_selected(one) for one in (result, found))
            if not all(map(close, a, b)):  # rounding may decide a draw, as in the alias method
                self._compare_laws(component, inputs, given, f"{fault} change the particles")
                continue
            kept = close(found.log_weights - shift, result.log_weights)
            assert kept or not component.properly_weighted, f"{fault} do not add it to those of the result"

    def features(self, result: Population, given: Population) -> np.ndarray:
        """(k,) numbers whose distributions describe the results for the input `given`."""
        change = result.log_weights - given.log_mean_weight
        return np.concatenate([np.ravel(one) for one in (*_selected(result), change)])

    def _compare_laws(self, component: Any, inputs: dict[str, Any], scaled: Population, fault: str) -> None:
        """Compare the distributions of results for the input and for the same input with a common factor."""
        from scipy.stats import ks_2samp

        samples = []
        for given in (inputs[self.weighted], scaled):
            arguments = {**inputs, self.weighted: given}
            with np.errstate(all="ignore"):
                results = [self.checked_call(component, arguments, seeded(k)) for k in range(10, 210)]
            samples.append([self.features(one, given) for one in results])
        sizes = {len(row) for rows in samples for row in rows}
        assert len(sizes) == 1, fault
        columns = np.round(samples, 9).transpose(2, 0, 1)
        assert all(ks_2samp(x, y, method="asymp").pvalue >= FALSE_ALARM / (10 * len(columns)) for x, y in columns), (
            fault
        )


def _selected(population: Population) -> list[np.ndarray]:
    """Arrays that describe the particles of a result: parents, and coordinates of array particles."""
    numbers = isinstance(population.particles, (np.ndarray, Mapping))
    return [*population.parents.values(), *([as_matrix(population.particles)] if numbers else [])]


def skip_unless_properly_weighted(component: Any) -> Any:
    """Return the component, or skip the test if the component declares ``properly_weighted = False``."""
    if not component.properly_weighted:
        raise SkipTest("the component declares properly_weighted = False")
    return component


@dataclass(frozen=True)
class CheckResult:
    """The result of the test of one property."""

    name: str  #: name of the test without ``test_``
    statement: str  #: the property: the first line of the docstring of the test
    #: Whether the test looks at random samples, and so fails for a correct component with probability
    #: `FALSE_ALARM`.
    statistical: bool
    failure: str | None = None  #: how the property is violated; None if it holds or was not tested
    skipped: str | None = None  #: why it was not tested
    out_of_time: bool = False  #: whether it was skipped because the time was used up
    remark: str = ""  #: what else the test found


_STOPPED = "not tested: first fix what is broken above"


def check_properties(
    component: Any,
    contract: type[Contract],
    example: Callable[..., Any] | None = None,
    exact: Callable[..., Any] | None = None,
    budget: float | None = None,
    progress: Callable[[CheckResult], None] | None = None,
) -> list[CheckResult]:
    """Test all properties that a contract states for a component.

    Parameters
    ----------
    example, exact : callable, optional
        Functions ``(rng, n)`` that replace the methods of the contract with these names.
    budget : float, optional
        Seconds for all tests together. A property takes at most half of the time that is left. A test that cannot
        end in its time is skipped. A single call of the component is not interrupted.
    progress : callable, optional
        Called with each result as soon as there is one.
    """
    unused = copied(component)
    functions = {"make": lambda: component, "fresh": lambda: copied(unused), "example": example, "exact": exact}
    methods = {name: staticmethod(function) for name, function in functions.items() if function is not None}
    tests = type(f"Test{type(component).__name__}", (contract,), methods)
    end = math.inf if budget is None else time.monotonic() + budget
    results: list[CheckResult] = []
    stopped = False
    names = (name for cls in reversed(tests.__mro__) for name in vars(cls) if name.startswith("test_"))
    distinct = list(dict.fromkeys(names))  # those of base classes first
    instance = tests()  # one for all tests, which share draws
    for name in distinct:
        test, now = getattr(tests, name), time.monotonic()
        instance.remarks, instance.tested = [], contract.tested
        instance.until = end if name == distinct[-1] else now + 0.5 * (end - now)
        outcome = {"skipped": _STOPPED} if stopped else _outcome(getattr(instance, name))
        stopped = stopped or ("failure" in outcome and getattr(test, "prerequisite", False))
        if "failure" in outcome and any(result.failure == outcome["failure"] for result in results):
            outcome = {"skipped": "same failure as above"}
        statement = (inspect.getdoc(test) or name).split("\n")[0]
        statistical = getattr(test, "statistical", False)
        remark = "; ".join(dict.fromkeys(instance.remarks))
        results.append(CheckResult(name.removeprefix("test_"), statement, statistical, **outcome, remark=remark))
        if progress is not None:
            progress(results[-1])
    return results


def _outcome(test: Callable[[], None]) -> dict[str, Any]:
    """The fields of a `CheckResult` that a test decides."""
    try:
        test()
    except SkipTest as reason:
        return {"skipped": str(reason), "out_of_time": isinstance(reason, OutOfTime)}
    except AssertionError as error:
        return {"failure": str(error)}
    except Exception as error:
        return {"failure": describe_error(error)}
    return {}


@contextmanager
def _own_generators(module: str) -> Iterator[list[str]]:
    """A list that is not empty after the block if code of a module made a generator, or a global one was used."""
    made: list[str] = []

    def default_rng(*arguments: Any, **named: Any) -> np.random.Generator:
        if sys._getframe(1).f_globals.get("__name__") == module:
            made.append("default_rng")
        return _GENERATOR(*arguments, **named)

    before = random.getstate(), repr(np.random.get_state())  # noqa: NPY002
    with mock.patch.object(np.random, "default_rng", default_rng):
        yield made
    if before != (random.getstate(), repr(np.random.get_state())):  # noqa: NPY002
        made.append("global")


@contextmanager
def reports_errors(what: str | dict[str, Any]) -> Iterator[None]:
    """Convert any exception of a component to an AssertionError that describes the call or its inputs."""
    try:
        yield
    except (AssertionError, SkipTest):
        raise
    except Exception as error:
        if _writes_to_read_only(error):
            raise AssertionError("it changes its input in place: make a copy first") from error
        what = what if isinstance(what, str) else _description(what)
        if isinstance(error, InputError):  # says what is wrong and where, as in a run
            raise AssertionError("; ".join([f"{what}: {error.message}", *error.hints])) from error
        raise AssertionError(f"{what}: it raises {describe_error(error)}") from error


@contextmanager
def skips_errors() -> Iterator[None]:
    """Skip a general test if the component raises an exception. Other tests report the exception."""
    try:
        yield
    except Exception as error:
        raise SkipTest(f"a call raises {type(error).__name__}, see the other tests") from error


def _description(inputs: dict[str, Any]) -> str:
    """Sizes of populations, and arguments that are None or integers, as in "6 particles, observation=None"."""
    sizes = [f"{len(value)} {name} particles" for name, value in inputs.items() if isinstance(value, Population)]
    values = [f"{name}={value}" for name, value in inputs.items() if value is None or isinstance(value, int)]
    return ", ".join(sizes + values).replace("population ", "")


def _writes_to_read_only(error: Exception) -> bool:
    return isinstance(error, ValueError) and any(word in str(error) for word in ("read-only", "its input in place"))


def close(a: Any, b: Any) -> bool:
    """Whether numbers or arrays are equal up to rounding."""
    return np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-9, atol=2e-9)


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal: arrays bit by bit, dataclasses field by field. True for types without ``==``."""
    if a is b:
        return True
    if type(a) is not type(b):
        return bool(isinstance(a, (float, np.floating)) and isinstance(b, (float, np.floating)) and a == b)
    if isinstance(a, np.ndarray) and a.dtype != object:
        return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, Mapping):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, Sequence | np.ndarray) and not isinstance(a, str):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if type(a).__eq__ is object.__eq__:
        return True
    return bool(np.all(a == b))


def _plain(value: Any) -> Any:
    """Convert a population, or populations in a mapping, to lists of particles, log weights and parents."""
    if isinstance(value, Population):
        return [value.realised().particles, value.log_weights, dict(value.parents)]
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return value
