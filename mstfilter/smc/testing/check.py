"""Running a contract on a component, without a test file and without pytest."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from unittest import SkipTest

from mstfilter.errors import describe_error
from mstfilter.smc import (
    Codec,
    DensityTransition,
    Equivalence,
    Lookahead,
    Proposal,
    Rejuvenation,
    Resampler,
    Similarity,
    Size,
    TransformResampler,
    Transition,
    Trigger,
    Update,
    WeightResampler,
)
from mstfilter.smc.testing import moves, resampling, values
from mstfilter.smc.testing.contract import Contract, copied

#: Contract of each interface, the more special interface first.
NUMBER_CONTRACTS: dict[type, type[Contract]] = {
    WeightResampler: resampling.WeightResamplerContract,
    TransformResampler: resampling.TransformResamplerContract,
    Resampler: resampling.ResamplerContract,
    DensityTransition: moves.DensityTransitionContract,
    Transition: moves.TransitionContract,
    Proposal: moves.ProposalContract,
    Update: moves.UpdateContract,
    Rejuvenation: moves.RejuvenationContract,
    Trigger: values.TriggerContract,
    Size: values.SizeContract,
    Lookahead: values.LookaheadContract,
    Similarity: values.SimilarityContract,
    Equivalence: values.EquivalenceContract,
    Codec: values.CodecContract,
}


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

    ``example(rng, n)`` and ``exact(rng, n)`` take the place of the methods of the contract with these names.
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
    """Failure and reason of a skip of a test, and whether the tests after it rely on it."""
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
