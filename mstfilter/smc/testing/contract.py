"""Common parts of all contracts: the base class, its run without pytest, and helpers that describe failures.

A contract is a test class for pytest. A contract defines the arguments of a call (`inputs`), the call (`call`), and
the requirements of every result (`check_result`). Each ``test_`` method checks one more property. The first line of
its docstring states the property, and the message of a failed assertion states how it is violated:

>>> class TriggerContract(Contract):
...     def call(self, component, rng, inputs):
...         return component.wants(inputs["population"], 0)
...     def check_result(self, result, inputs):
...         assert isinstance(result, bool), f"its answer is {result!r}, expected True or False"
...     def test_answers_yes_or_no(self):
...         \"\"\"It returns True or False.\"\"\"
...         self.checked_call(self.make(), self.inputs(5))

pytest is not imported: `SkipTest` skips a test, in pytest too.
"""

from __future__ import annotations

import copy
import functools
import inspect
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, ClassVar, TypeVar
from unittest import SkipTest

import numpy as np

from mstfilter.errors import InputError, describe_error
from mstfilter.smc import (
    Always,
    Info,
    ParticleFilter,
    Population,
    Proposal,
    Reweight,
    RunGenerators,
    State,
    Systematic,
    as_matrix,
    run_many,
    union,
)

#: Largest probability that a statistical test fails for a correct component.
FALSE_ALARM = 1e-6

_Test = TypeVar("_Test", bound=Callable[..., None])


def statistical(test: _Test) -> _Test:
    """Mark a test that uses random samples. The test fails with probability `FALSE_ALARM` for a correct component."""
    test.statistical = True  # type: ignore[attr-defined]
    return test


def prerequisite(test: _Test) -> _Test:
    """Mark a test on which later tests depend. If the marked test fails, `check_properties` skips the later tests."""
    test.prerequisite = True  # type: ignore[attr-defined]
    return test


def seeded(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def number_example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """`n` numbers with unequal weights, and a number as observation."""
    return Population(rng.standard_normal(n), 0.5 * rng.standard_normal(n)), 0.5


class Contract:
    """Base class of all contracts. Inherit one of its subclasses and define `make`. pytest does the rest.

    A contract for another interface defines `inputs`, `call` and `check_result`, and adds tests.
    """

    def make(self) -> Any:
        """The component to test."""
        raise NotImplementedError(f"{type(self).__name__} needs a method make(self) that returns the component")

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """A population of `n` particles (by default numbers) that the component can handle, and an observation."""
        return number_example(rng, n)

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        """Arguments of a typical call, without the generator: the example of `n` particles."""
        population, observation = self.example(seeded(seed), n)
        return {"population": population, "observation": observation}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Call the component once."""
        raise NotImplementedError

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        """Assert the requirements of every result."""

    def checked_call(self, component: Any, inputs: dict[str, Any], rng: np.random.Generator | None = None) -> Any:
        """Call the component once. An exception or a wrong result is reported with a description of the inputs."""
        with reports_errors(inputs):
            result = self.call(component, seeded(3) if rng is None else rng, inputs)
        self.check_result(result, inputs)
        return result

    def check_relation(
        self,
        inputs: dict[str, Any],
        changes: dict[str, Any],
        fault: str,
        expected: Callable[[Any], Any] = lambda result: result,
    ) -> None:
        """Check that changed arguments give the `expected` change of the result (by default none)."""
        component = self.make()
        result = expected(self.checked_call(component, inputs))
        assert close(self.checked_call(component, {**inputs, **changes}), result), fault

    def variants(self) -> list[dict[str, Any]]:
        """Arguments of calls for which the properties must hold: six particles, and for arrays also one particle."""
        few = self.inputs(6)
        objects = isinstance(getattr(few.get("population"), "particles", None), tuple)
        return [few] if objects else [few, self.inputs(1)]

    def fresh(self) -> Any:
        """A component that has not been used: a copy of the result of `make`, if it can be copied."""
        return copied(self.make())

    def setup_method(self) -> None:
        self._global_state = global_state()

    def teardown_method(self) -> None:
        """After every test, report and undo draws from global generators."""
        before, after = self._global_state, global_state()
        restore_global_state(before)
        assert same(before[0], after[0]), "it draws from numpy's global generator (np.random.*): draw from `rng`"
        assert before[1] == after[1], "it draws from Python's global generator (random.*): draw from `rng`"

    @prerequisite
    def test_does_not_use_global_generators(self) -> None:
        """It does not use the global generators of numpy and Python."""
        for inputs in self.variants():
            with skips_errors():
                self.call(self.make(), seeded(7), inputs)
        self.teardown_method()

    @prerequisite
    def test_does_not_change_input(self) -> None:
        """It leaves its input unchanged."""
        for inputs in self.variants():
            before = copy.deepcopy(_plain(inputs))
            try:
                self.call(self.make(), seeded(3), inputs)
            except Exception as error:  # other tests report other errors
                assert not _writes_to_read_only(error), "it changes its input in place: make a copy first"
            for name, value in _plain(inputs).items():
                assert same(value, before[name]), f"it changes its input in place ({name}): make a copy first"

    @prerequisite
    def test_repeats_with_the_same_generator(self) -> None:
        """Equal generators give equal results; with ``draws = False`` it does not use its generator."""
        for inputs in self.variants():
            for seed in (7, 8):
                rng = seeded(seed)
                with skips_errors():
                    a, b = (_plain(self.call(self.fresh(), r, inputs)) for r in (rng, seeded(seed)))
                assert same(a, b), "two runs with equal generators differ: a random number does not come from `rng`"
                unused = rng.bit_generator.state == seeded(seed).bit_generator.state
                assert unused or getattr(self.make(), "draws", True), (
                    "it declares draws = False and draws from its generator"
                )

    @prerequisite
    def test_keeps_no_state(self) -> None:
        """A call does not change the result of later calls."""
        arguments = [(9, 1), (6, 0), (6, 2)]
        used = self.fresh()
        with skips_errors():
            expected = [self._plain_call(self.fresh(), *a) for a in arguments]
            found = [self._plain_call(used, *arguments[k]) for k in (0, 1, 2, 1)]
        for k, result in zip((0, 1, 2, 1), found, strict=True):
            assert same(result, expected[k]), (
                "a component that was used before gives another result than a new one: it keeps state, for example "
                "values of its first call"
            )

    def _plain_call(self, component: Any, n: int, seed: int) -> Any:
        return _plain(self.call(component, seeded(1), self.inputs(n, seed=seed)))


@dataclass(frozen=True)
class _Examples(Proposal):
    """The particles of an example, used as the first particles of a filter."""

    example: Callable[..., Any]

    batched: ClassVar[bool] = True

    def sample(self, rng: Any, observation: Any, n: int) -> Population:
        if not isinstance(rng, RunGenerators):
            return Population(self.example(rng, n)[0].particles)
        parts = [Population(self.example(g, n // len(rng))[0].particles) for g in rng.generators()]
        return functools.reduce(union, parts)


class BatchedContract(Contract):
    """Base class of contracts for components that may process the particles of several runs together."""

    slot: ClassVar[str]  #: of a `ParticleFilter` that takes the component

    def test_batched_runs_equal_single_runs(self) -> None:
        """If it declares ``batched = True``, every run of a batch equals the run alone."""
        component = self.make()
        if not component.batched:
            return
        example = number_example if self.slot in ("resampler", "trigger") else self.example  # they use weights only
        y = example(seeded(), 2)[1]
        slots = {"initial": _Examples(example), "update": Reweight(_row_sums, True), "resampler": Systematic()}
        # The numbers of runs include that of the particles, since arrays of another axis fit then.
        for n, n_runs in ((5, 3), (5, 5), (1, 4), (4, 1)):
            filter = ParticleFilter(n=n, **{"trigger": Always(), **slots, self.slot: component})
            with reports_errors(f"a batch of {n_runs} runs of {n} particles"):
                last: dict[int, Any] = {}
                run_many(filter, [y] * 3, range(n_runs), kept=functools.partial(_keep, last))
                alone = [filter.run([y] * 3, seed)[0].population for seed in range(n_runs)]
            for r, expected in enumerate(alone):
                assert same(_plain(last[r])[:2], _plain(expected)[:2]), (
                    f"run {r} of {n_runs} runs of {n} particles in a batch is not the run alone: are runs mixed?"
                )


def _keep(populations: dict[int, Any], state: State, info: Info) -> float:
    """A collector that keeps the last population of each run."""
    populations[state.key.seed] = state.population
    return 0.0


def _row_sums(particles: Any, observation: Any) -> np.ndarray:
    """Unequal log weights."""
    return 3 * np.sin(as_matrix(particles)).sum(axis=1)


def copied(component: Any) -> Any:
    """A deep copy of a component, or the component if it cannot be copied."""
    try:
        return copy.deepcopy(component)
    except Exception:  # for example a lock or a module in a field
        return component


def skip_unless_properly_weighted(component: Any) -> Any:
    """The component. Skips a test of the weights if it declares ``properly_weighted = False``."""
    if not component.properly_weighted:
        raise SkipTest("the component declares properly_weighted = False")
    return component


@dataclass(frozen=True)
class CheckResult:
    """The outcome of one property."""

    name: str  #: name of the test without ``test_``
    statement: str  #: the property: the first line of the docstring of the test
    #: Whether the test looks at random samples, and so fails for a correct component with probability
    #: `FALSE_ALARM`.
    statistical: bool
    failure: str | None = None  #: how the property is violated; None if it holds or was not tested
    skipped: str | None = None  #: why it was not tested


def check_properties(
    component: Any,
    contract: type[Contract],
    example: Callable[..., Any] | None = None,
    exact: Callable[..., Any] | None = None,
) -> list[CheckResult]:
    """Test all properties of a component that a contract states.

    ``example(rng, n)`` and ``exact(rng, n)`` replace the methods of the contract with these names.
    """
    unused = copied(component)
    functions = {"make": lambda: component, "fresh": lambda: copied(unused), "example": example, "exact": exact}
    methods = {name: staticmethod(function) for name, function in functions.items() if function is not None}
    tests = type(f"Test{type(component).__name__}", (contract,), methods)
    results: list[CheckResult] = []
    failure: str | None
    skipped: str | None
    stopped = False
    for name in _test_names(tests):
        test = getattr(tests, name)
        if stopped:
            failure, skipped = None, "not tested: first fix what is broken above"
        else:
            failure, skipped, stopped = _outcome(tests(), name)
        if failure is not None and any(result.failure == failure for result in results):
            failure, skipped = None, "same failure as above"
        statement = (inspect.getdoc(test) or name).split("\n")[0]
        statistical = getattr(test, "statistical", False)
        results.append(CheckResult(name.removeprefix("test_"), statement, statistical, failure, skipped))
    return results


def _test_names(tests: type) -> list[str]:
    """The test methods in the order of pytest: those of the base classes first."""
    names: dict[str, None] = {}
    for cls in reversed(tests.__mro__):
        for name in vars(cls):
            if name.startswith("test_"):
                names.pop(name, None)  # an overridden test is in the place of the derived class
                names[name] = None
    return list(names)


def _outcome(contract: Contract, name: str) -> tuple[str | None, str | None, bool]:
    """Failure and reason of a skip of a test, and whether later tests depend on it."""
    failure = skipped = None
    test = getattr(contract, name)
    contract.setup_method()
    try:
        test()
    except SkipTest as reason:
        skipped = str(reason)
    except AssertionError as error:
        failure = str(error)
    except Exception as error:
        failure = describe_error(error)
    try:
        contract.teardown_method()
    except AssertionError as error:  # a fault that every test looks for replaces the outcome of the test
        return str(error), None, True
    return failure, skipped, failure is not None and getattr(test, "prerequisite", False)


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
        number = isinstance(error, AttributeError) and "'float' object" in str(error)
        hint = "; the input is a number: for scenes write `example = scene_example` in the file" if number else ""
        raise AssertionError(f"{what}: it raises {describe_error(error)}{hint}") from error


@contextmanager
def skips_errors() -> Iterator[None]:
    """Skip a general test if the component raises an exception, since the tests of its interface report it."""
    try:
        yield
    except Exception as error:
        raise SkipTest(f"a call raises {type(error).__name__}, see the other tests") from error


def _description(inputs: dict[str, Any]) -> str:
    """The sizes of populations, and arguments that are None or numbers: "6 particles, observation=None"."""
    words = []
    for name, value in inputs.items():
        if isinstance(value, Population):
            words.append(f"{len(value)} {'' if name == 'population' else f'{name} '}particles")
        elif value is None or isinstance(value, int):
            words.append(f"{name}={value}")
    return ", ".join(words)


def _writes_to_read_only(error: Exception) -> bool:
    return isinstance(error, ValueError) and any(word in str(error) for word in ("read-only", "its input in place"))


def close(a: Any, b: Any) -> bool:
    """Whether numbers, arrays, or the log weights of populations are equal up to rounding."""
    a, b = (value.log_weights if isinstance(value, Population) else value for value in (a, b))
    return np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-9, atol=2e-9)


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal: arrays bit by bit, dataclasses by field; True without an equality."""
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
    """A population, or a mapping that holds some, as lists of particles, log weights and parents."""
    if isinstance(value, Population):
        return [value.realised().particles, value.log_weights, dict(value.parents)]
    if isinstance(value, dict):
        return {name: _plain(inner) for name, inner in value.items()}
    return value


def global_state() -> tuple[Any, Any]:
    """States of the global generators of numpy and Python."""
    return np.random.get_state(), random.getstate()  # noqa: NPY002


def restore_global_state(state: tuple[Any, Any]) -> None:
    """Set the global generators to states that `global_state` returned."""
    np.random.set_state(state[0])  # noqa: NPY002
    random.setstate(state[1])
