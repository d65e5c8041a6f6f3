"""The check of a component by the contract of its interface, without a test file: what ``mstfilter check`` does."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from mstfilter.completion import Completer
from mstfilter.errors import InputError
from mstfilter.fusion import Evidence
from mstfilter.smc.testing import NUMBER_CONTRACTS, CheckResult, Contract, check_properties
from mstfilter.testing import stages
from mstfilter.testing.scenes import scene_example
from mstfilter.tracking import MotionRule

#: Contract of each interface, the more special interface first.
_CONTRACTS: dict[type, type[Contract]] = {
    **NUMBER_CONTRACTS,
    Evidence: stages.EvidenceContract,
    **dict.fromkeys(stages.STAGE_OWNERS, stages.StageContract),
    Completer: stages.CompleterContract,
    MotionRule: stages.MotionRuleContract,
}


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
    cls = type(component)
    contract = contract_of(cls)
    example = example or _function_beside(cls, "example") or (scene_example if _uses_images(cls) else None)
    return check_properties(component, contract, example, exact or _function_beside(cls, "exact"))


def _function_beside(cls: type, name: str) -> Callable[..., Any] | None:
    """A function in the module of a class."""
    found = getattr(sys.modules.get(cls.__module__), name, None)
    return found if callable(found) else None


def _uses_images(cls: type) -> bool:
    """Whether a class of components belongs to a package of mstfilter other than smc."""
    return cls.__module__.startswith("mstfilter.") and not cls.__module__.startswith("mstfilter.smc.")
