"""What all contracts share: the base classes, and helpers that describe failures.

A contract is a pytest class. It defines the arguments of a call (`inputs`), the call, and what every result must
fulfil (`check_result`). Each ``test_`` method checks one more property; the first line of its docstring states the
property, and the message of a failed assertion states how it is violated:

>>> class TriggerContract(Contract):
...     def call(self, component, rng, inputs):
...         return component.wants(inputs["population"], 0)
...     def check_result(self, result, inputs):
...         assert isinstance(result, bool), f"its answer is {result!r}, expected True or False"
...     def test_answers_yes_or_no(self):
...         \"\"\"It returns True or False.\"\"\"
...         self.checked_call(self.make(), self.inputs(5))
"""

from __future__ import annotations

import copy
import functools
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
import pytest

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
    """Mark a test that looks at random samples. It fails with probability `FALSE_ALARM` for a correct component."""
    test.statistical = True  # type: ignore[attr-defined]
    return test


def prerequisite(test: _Test) -> _Test:
    """Mark a test that the tests after it rely on. If it fails, ``mstfilter check`` skips them."""
    test.prerequisite = True  # type: ignore[attr-defined]
    return test


def number_example(rng: np.random.Generator, n: int) -> tuple[Population, Any]:
    """`n` numbers with unequal weights, and a number as observation."""
    return Population(rng.standard_normal(n), 0.5 * rng.standard_normal(n)), 0.5


class Contract:
    """Base class of all contracts. Inherit one of its subclasses and define `make`; pytest does the rest.

    A contract for another interface defines `inputs`, `call` and `check_result`, and adds tests.
    """

    def make(self) -> Any:
        """The component to test."""
        raise NotImplementedError(f"{type(self).__name__} needs a method make(self) that returns the component")

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """A population of `n` particles that the component can handle, and an observation. Default: numbers."""
        return number_example(rng, n)

    def inputs(self, n: int, seed: int = 0) -> dict[str, Any]:
        """Arguments of a typical call, without the generator: the example of `n` particles."""
        population, observation = self.example(np.random.default_rng(seed), n)
        return {"population": population, "observation": observation}

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """Use the component once."""
        raise NotImplementedError

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        """Assert what the result of every call must fulfil."""

    def checked_call(self, component: Any, inputs: dict[str, Any], rng: np.random.Generator | None = None) -> Any:
        """Use the component once; an exception or a wrong result is reported with a description of the inputs."""
        with reports_errors(inputs):
            result = self.call(component, np.random.default_rng(3) if rng is None else rng, inputs)
        self.check_result(result, inputs)
        return result

    def variants(self) -> list[dict[str, Any]]:
        """Arguments of several calls, for properties that hold for any: six particles; for arrays also one."""
        few = self.inputs(6)
        objects = isinstance(getattr(few.get("population"), "particles", None), tuple)
        return [few] if objects else [few, self.inputs(1)]

    def fresh(self) -> Any:
        """A component that has not been used: a copy of what `make` returns, if it can be copied."""
        return copied(self.make())

    def setup_method(self) -> None:
        self._global_state = global_state()

    def teardown_method(self) -> None:
        """After every test, report and undo draws from global generators."""
        fault = _global_draws(self._global_state, global_state())
        restore_global_state(self._global_state)
        assert fault is None, fault

    @prerequisite
    def test_does_not_use_global_generators(self) -> None:
        """It does not use the global generators of numpy and Python."""
        for inputs in self.variants():
            with skips_errors():
                self.call(self.make(), np.random.default_rng(7), inputs)
        self.teardown_method()

    @prerequisite
    def test_does_not_change_input(self) -> None:
        """It leaves its input unchanged."""
        for inputs in self.variants():
            before = copy.deepcopy(_plain(inputs))
            try:
                self.call(self.make(), np.random.default_rng(3), inputs)
            except Exception as error:  # other tests report other errors
                assert not _writes_to_read_only(error), "it changes its input in place: make a copy first"
            for name, value in _plain(inputs).items():
                assert same(value, before[name]), f"it changes its input in place ({name}): make a copy first"

    @prerequisite
    def test_repeats_with_the_same_generator(self) -> None:
        """Equal generators give equal results."""
        for inputs in self.variants():
            for seed in (7, 8):
                with skips_errors():
                    a, b = (_plain(self.call(self.fresh(), np.random.default_rng(seed), inputs)) for _ in range(2))
                assert same(a, b), "two runs with equal generators differ: a random number does not come from `rng`"

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
        return _plain(self.call(component, np.random.default_rng(1), self.inputs(n, seed=seed)))


class RandomContract(Contract):
    """Base class of contracts for components that draw random numbers."""

    @prerequisite
    def test_draws_only_if_declared(self) -> None:
        """It does not use its generator if it declares ``draws = False``."""
        component = self.make()
        if getattr(component, "draws", True) is not False:
            return
        for inputs in self.variants():
            rng = np.random.default_rng(7)
            with skips_errors():
                self.call(component, rng, inputs)
            unused = rng.bit_generator.state == np.random.default_rng(7).bit_generator.state
            assert unused, "it declares draws = False and draws from its generator"


@dataclass(frozen=True)
class _Examples(Proposal):
    """The particles of an example, as the first ones of a filter."""

    example: Callable[..., Any]

    batched: ClassVar[bool] = True

    def sample(self, rng: Any, observation: Any, n: int) -> Population:
        if not isinstance(rng, RunGenerators):
            return Population(self.example(rng, n)[0].particles)
        parts = [Population(self.example(g, n // len(rng))[0].particles) for g in rng.generators()]
        return functools.reduce(union, parts)


def check_batched(slot: str, component: Any, example: Callable[..., Any]) -> None:
    """Check in a filter that runs of a batch equal single runs; nothing if the component is not `batched`.

    The numbers of runs include that of the particles, since arrays of another axis fit then.
    """
    if not component.batched:
        return
    y = example(np.random.default_rng(0), 2)[1]
    slots = {
        "initial": _Examples(example),
        "update": Reweight(_row_sums, True),
        "resampler": Systematic(),
        slot: component,
    }
    for n, n_runs in ((5, 3), (5, 5), (1, 4), (4, 1)):
        filter = ParticleFilter(n=n, **{"trigger": Always(), **slots})
        with reports_errors(f"a batch of {n_runs} runs of {n} particles"):
            last: dict[int, Any] = {}
            run_many(filter, [y] * 3, range(n_runs), kept=functools.partial(_keep, last))
            alone = [filter.run([y] * 3, seed)[0].population for seed in range(n_runs)]
        for r, expected in enumerate(alone):
            assert expected is not None and same(_plain(last[r])[:2], _plain(expected)[:2]), (
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
    """The component; skips a test of the weights if it declares ``properly_weighted = False``."""
    if not component.properly_weighted:
        pytest.skip("the component declares properly_weighted = False")
    return component


@contextmanager
def reports_errors(what: str | dict[str, Any]) -> Iterator[None]:
    """Turn any exception of a component into an AssertionError that describes the call, or its inputs."""
    try:
        yield
    except AssertionError:
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
    """Skip a general test if the component raises an exception, which the tests of its interface report."""
    try:
        yield
    except Exception as error:
        pytest.skip(f"a call raises {type(error).__name__}, see the other tests")


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


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal: arrays bit by bit, dataclasses by field. Without equality they count as equal."""
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


def _global_draws(before: tuple[Any, Any], after: tuple[Any, Any]) -> str | None:
    """The fault if a global generator has another state than before."""
    if not same(before[0], after[0]):
        return "it draws from numpy's global generator (np.random.*): draw from `rng`"
    if before[1] != after[1]:
        return "it draws from Python's global generator (random.*): draw from `rng`"
    return None


def restore_global_state(state: tuple[Any, Any]) -> None:
    """Set the global generators to states that `global_state` returned."""
    np.random.set_state(state[0])  # noqa: NPY002
    random.setstate(state[1])
