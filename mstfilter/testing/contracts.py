"""Contract classes for pytest, and `verify`, which needs no pytest."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion import Evidence
from mstfilter.smc import (
    Codec,
    Equivalence,
    Lookahead,
    Population,
    Proposal,
    Rejuvenation,
    Resampler,
    Similarity,
    Size,
    Transition,
    Trigger,
    Update,
)
from mstfilter.testing import choices, moves, optional, properties, scenes, terms
from mstfilter.testing.properties import Exact, Example, NotApplicable, Outcome, Property, Suite
from mstfilter.testing.resampling_law import RESAMPLER

__all__ = [
    "CodecContract",
    "Contract",
    "EquivalenceContract",
    "EvidenceContract",
    "LookaheadContract",
    "ProposalContract",
    "RejuvenationContract",
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

    def _exact(self) -> Exact | None:
        """Exact draws, where a contract has use for them and they are given."""
        return None


def _test_of(prop: Property) -> Callable[[Contract], None]:
    def test(self: Contract) -> None:
        try:
            prop.look(self.make(), self.example, self._exact())
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


class LookaheadContract(Contract, suite=optional.LOOKAHEAD):
    """What every `Lookahead` keeps."""


class RejuvenationContract(Contract, suite=optional.REJUVENATION):
    """What every `Rejuvenation` keeps. The one statistical test alarms falsely with probability 1e-6 at most.

    It needs `exact`: a kernel that does not keep the law cannot be told from one that does without draws from it.
    """

    def exact(self, rng: np.random.Generator, n: int) -> tuple[Population | None, Population, Any]:
        """`n` rows of x_{t-1} (None: the first step), exact draws of x_t given them and y_t, and y_t."""
        raise NotImplementedError

    def _exact(self) -> Exact | None:
        return None if type(self).exact is RejuvenationContract.exact else self.exact


class CodecContract(Contract, suite=optional.CODEC):
    """What every `Codec` keeps."""


class SimilarityContract(Contract, suite=choices.SIMILARITY):
    """What every `Similarity` keeps."""


class EquivalenceContract(Contract, suite=choices.EQUIVALENCE):
    """What every `Equivalence` keeps."""


class EvidenceContract(Contract, suite=terms.EVIDENCE):
    """What every `Evidence` keeps. The default example is a scene."""

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """`n` hypotheses and a clip."""
        return scenes.scene_example(rng, n)


_SUITES: dict[type, Suite] = {
    Resampler: RESAMPLER,
    Transition: moves.TRANSITION,
    Proposal: moves.PROPOSAL,
    Update: moves.UPDATE,
    Trigger: choices.TRIGGER,
    Size: choices.SIZE,
    Lookahead: optional.LOOKAHEAD,
    Rejuvenation: optional.REJUVENATION,
    Codec: optional.CODEC,
    Similarity: choices.SIMILARITY,
    Equivalence: choices.EQUIVALENCE,
    Evidence: terms.EVIDENCE,
}


def kind_of_class(cls: type) -> str:
    """The kind of component that a class is."""
    for interface, suite in _SUITES.items():
        if issubclass(cls, interface):
            return suite.kind
    names = ", ".join(interface.__name__ for interface in _SUITES)
    raise InputError(f"{cls.__name__} is no component", f"inherit one of {names}")


def verify(component: Any, example: Example | None = None, exact: Exact | None = None) -> Iterator[Outcome]:
    """Look at all properties of a component, one after the other.

    Parameters
    ----------
    component : component
        Of any kind that has a contract.
    example : callable, optional
        ``(rng, n) -> (population, observation)`` that the component works on. Default: numbers (`Evidence`: a scene).
    exact : callable, optional
        For a `Rejuvenation`: ``(rng, n) -> (previous, population, observation)``, rows of x_{t-1} and exact draws of
        x_t given them and the observation. Default: the function ``exact`` in the module of its class, if any.

    Yields
    ------
    Outcome
        ``broken`` says in words how a property does not hold; None where it does.
    """
    kind = kind_of_class(type(component))
    suite = next(s for s in _SUITES.values() if s.kind == kind)
    if exact is None:
        found = getattr(sys.modules.get(type(component).__module__), "exact", None)
        exact = found if callable(found) else None
    default = scenes.scene_example if suite is terms.EVIDENCE else properties.example
    yield from suite.run(component, example or default, exact)
