"""Running a contract on a component, without a test file: what ``mstfilter check`` does.

>>> for result in run_contract(MyResampler()):
...     print(result.statement, "-", result.failure or result.skipped or "holds")

pytest runs the contract class of the component in this process and without output; a small plugin collects the
outcomes.
"""

from __future__ import annotations

import inspect
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from mstfilter.completion import Completer
from mstfilter.errors import InputError, describe_error
from mstfilter.scene import Evidence
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
from mstfilter.testing import moves, resampling, stages, values
from mstfilter.testing.contract import Contract, copied, number_example
from mstfilter.testing.scenes import scene_example
from mstfilter.tracking import MotionRule

#: Contract of each interface, the more special interface first.
_CONTRACTS: dict[type, type[Contract]] = {
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
    Evidence: values.EvidenceContract,
    **dict.fromkeys(stages.STAGE_OWNERS, stages.StageContract),
    Completer: stages.CompleterContract,
    MotionRule: stages.MotionRuleContract,
}


# "unraisableexception" collects garbage several times per session, which takes longer than most contracts.
_UNUSED_PLUGINS = [
    "cacheprovider",
    "doctest",
    "faulthandler",
    "junitxml",
    "logging",
    "pastebin",
    "stepwise",
    "terminal",
    "threadexception",
    "unittest",
    "unraisableexception",
    "warnings",
]


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


def contract_of(cls: type) -> type[Contract]:
    """The contract of a class of components; InputError if no interface of the class has a contract."""
    for interface, contract in _CONTRACTS.items():
        if issubclass(cls, interface):
            return contract
    names = ", ".join(interface.__name__ for interface in _CONTRACTS)
    raise InputError(f"{cls.__name__} is no component with a contract", f"inherit one of {names}")


def run_contract(
    component: Any, example: Callable[..., Any] | None = None, exact: Callable[..., Any] | None = None
) -> list[CheckResult]:
    """Test all properties of a component, whose interface has a contract.

    ``example(rng, n)`` returns a population and an observation that the component can handle. Default: the function
    ``example`` in the module of its class; without one, a scene for components of images and numbers for others.

    ``exact(rng, n)`` of a `Transition`, `Proposal`, `Update` or `Rejuvenation` returns exact draws and the
    observation; see the contract. Default: the function ``exact`` in the module of its class, if any.
    """
    cls, unused = type(component), copied(component)
    contract = contract_of(cls)
    example = example or _function_beside(cls, "example") or (scene_example if _uses_images(cls, contract) else None)
    if isinstance(component, Resampler) and resampling.makes_particles(copied(unused), example or number_example):
        contract = resampling.TransformResamplerContract
    functions = {
        "make": lambda: component,
        "fresh": lambda: copied(unused),
        "example": example,
        "exact": exact or _function_beside(cls, "exact"),
    }
    methods = {name: staticmethod(function) for name, function in functions.items() if function is not None}
    plugin = _Plugin(type(f"Test{cls.__name__}", (contract,), methods))
    with tempfile.TemporaryDirectory() as folder, _quiet_pytest():
        path = Path(folder, "test_component.py")
        path.touch()  # pytest needs a file to collect; the plugin replaces its content
        options = ["--capture=no", "--assert=plain", "--noconftest", f"--rootdir={folder}", f"-c{os.devnull}"]
        disabled = [f"-pno:{name}" for name in _UNUSED_PLUGINS]
        status = pytest.main([*options, *disabled, str(path)], plugins=[plugin])
    if status not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise RuntimeError(f"pytest ended with status {status!r}")
    return plugin.results


def _function_beside(cls: type, name: str) -> Callable[..., Any] | None:
    """A function in the module of a class."""
    found = getattr(sys.modules.get(cls.__module__), name, None)
    return found if callable(found) else None


def _uses_images(cls: type, contract: type[Contract]) -> bool:
    """Whether a class is a stage of MST or an evidence, or belongs to a package of mstfilter other than smc."""
    if issubclass(contract, stages.StageContract | values.EvidenceContract):
        return True
    return cls.__module__.startswith("mstfilter.") and not cls.__module__.startswith("mstfilter.smc.")


class _Plugin:
    """Makes pytest collect one class, and keeps the outcomes of its tests."""

    def __init__(self, tests: type[Contract]) -> None:
        self.tests = tests
        self.results: list[CheckResult] = []
        self._stopped = False

    @pytest.hookimpl(tryfirst=True)
    def pytest_pycollect_makemodule(self, module_path: Path, parent: Any) -> pytest.Module:
        """A module that holds the class."""
        module: pytest.Module = pytest.Module.from_parent(parent, path=module_path)
        module.obj = ModuleType(module_path.stem)
        setattr(module.obj, self.tests.__name__, self.tests)
        return module

    def pytest_itemcollected(self, item: Any) -> None:
        """Failures are reported by their message; pytest would format the source of each."""
        item.repr_failure = lambda excinfo, style=None: str(excinfo.value)

    def pytest_runtest_setup(self, item: Any) -> None:
        """Skip the test if one failed that it relies on."""
        if self._stopped:
            pytest.skip("not tested: first fix what is broken above")

    def pytest_runtest_makereport(self, item: Any, call: Any) -> None:
        """Keep the outcome; a failure with the same message as an earlier one is reported once."""
        error = None if call.excinfo is None else call.excinfo.value
        if call.when != "call" and error is None:
            return
        if call.when == "teardown":  # a fault that every test looks for replaces the outcome of the test
            self.results.pop()
        failure = skipped = None
        if isinstance(error, pytest.skip.Exception):
            skipped = str(error)
        elif isinstance(error, AssertionError):
            failure = str(error)
        elif error is not None:
            failure = describe_error(error)
        test = item.function
        if failure is not None:
            self._stopped = self._stopped or call.when == "teardown" or getattr(test, "prerequisite", False)
            if any(result.failure == failure for result in self.results):
                failure, skipped = None, "same failure as above"
        statement = (inspect.getdoc(test) or item.name).split("\n")[0]
        statistical = getattr(test, "statistical", False)
        self.results.append(CheckResult(item.name.removeprefix("test_"), statement, statistical, failure, skipped))


@contextmanager
def _quiet_pytest() -> Iterator[None]:
    """Ignore the pytest settings of the environment, and restore the environment afterwards."""
    before = dict(os.environ)
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    for name in ("PYTEST_ADDOPTS", "PYTEST_PLUGINS"):
        os.environ.pop(name, None)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
