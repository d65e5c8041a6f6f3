"""Contract classes for pytest, and `verify`, which needs no pytest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.interfaces import Proposal, Resampler, Size, Transition, Trigger, Update
from mstfilter.smc.population import Population
from mstfilter.smc.similarity import Equivalence, Similarity
from mstfilter.testing import choices, moves, properties
from mstfilter.testing.properties import Example, NotApplicable, Outcome, Property, Suite
from mstfilter.testing.resampling_law import RESAMPLER

__all__ = [
    "Contract",
    "EquivalenceContract",
    "ProposalContract",
    "ResamplerContract",
    "SimilarityContract",
    "SizeContract",
    "TransitionContract",
    "TriggerContract",
    "UpdateContract",
    "verify",
]


class Contract:
    """Tests that a component keeps what its interface promises. Inherit one of the subclasses, define `make`."""

    suite: ClassVar[Suite]

    def __init_subclass__(cls, suite: Suite | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if suite is not None:
            cls.suite = suite
            for prop in suite.properties:
                setattr(cls, f"test_{prop.name}", _test_of(prop))

    def make(self) -> Any:
        """The component to test."""
        raise NotImplementedError(f"{type(self).__name__} has no make(self) that returns the component to test")

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """A population of `n` particles that the component works on, and an observation. Default: numbers."""
        return properties.example(rng, n)


def _test_of(prop: Property) -> Callable[[Contract], None]:
    def test(self: Contract) -> None:
        try:
            prop.check(self.make(), self.example)
        except NotApplicable as reason:
            import pytest

            pytest.skip(str(reason))

    test.__name__ = f"test_{prop.name}"
    test.__doc__ = prop.says
    return test


class ResamplerContract(Contract, suite=RESAMPLER):
    """What every `Resampler` keeps. The three statistical tests alarm falsely with probability 1e-6 each at most."""


class TransitionContract(Contract, suite=moves.TRANSITION):
    """What every `Transition` keeps. The one statistical test alarms falsely with probability 1e-6 at most."""


class ProposalContract(Contract, suite=moves.PROPOSAL):
    """What every `Proposal` keeps."""


class UpdateContract(Contract, suite=moves.UPDATE):
    """What every `Update` keeps."""


class TriggerContract(Contract, suite=choices.TRIGGER):
    """What every `Trigger` keeps."""


class SizeContract(Contract, suite=choices.SIZE):
    """What every `Size` keeps."""


class SimilarityContract(Contract, suite=choices.SIMILARITY):
    """What every `Similarity` keeps."""


class EquivalenceContract(Contract, suite=choices.EQUIVALENCE):
    """What every `Equivalence` keeps."""


_SUITES: dict[type, Suite] = {
    Resampler: RESAMPLER,
    Transition: moves.TRANSITION,
    Proposal: moves.PROPOSAL,
    Update: moves.UPDATE,
    Trigger: choices.TRIGGER,
    Size: choices.SIZE,
    Similarity: choices.SIMILARITY,
    Equivalence: choices.EQUIVALENCE,
}


def kind_of_class(cls: type) -> str:
    """The kind of component that a class is."""
    for interface, suite in _SUITES.items():
        if issubclass(cls, interface):
            return suite.kind
    names = ", ".join(interface.__name__ for interface in _SUITES)
    raise InputError(f"{cls.__name__} is no component", f"inherit one of {names}")


def verify(component: Any, example: Example | None = None) -> Iterator[Outcome]:
    """Look at all properties of a component, one after the other.

    Parameters
    ----------
    component : component
        Of any kind that has a contract.
    example : callable, optional
        ``(rng, n) -> (population, observation)`` that the component works on. Default: numbers.

    Yields
    ------
    Outcome
        ``broken`` says in words how a property does not hold; None where it does.
    """
    kind = kind_of_class(type(component))
    suite = next(s for s in _SUITES.values() if s.kind == kind)
    yield from suite.run(component, example or properties.example)
