"""The check of any component: what ``mstfilter check`` does."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

import mstfilter.smc.testing as numbers
from mstfilter.base.errors import InputError
from mstfilter.mst.testing import hypotheses, stages
from mstfilter.mst.testing.scenes import scene_example
from mstfilter.scene import Hypothesis
from mstfilter.smc import ParticleFilter, Population, Program, StateSpaceModel
from mstfilter.smc.testing.contract import CheckResult, Contract, check_properties, seeded

#: Contract of number components -> contract of the same components if their particles are hypotheses.
_OF_SCENES: dict[type[Contract], type[Contract]] = {
    numbers.TransitionContract: hypotheses.SceneTransitionContract,
    numbers.ProposalContract: hypotheses.SceneProposalContract,
    numbers.SimilarityContract: hypotheses.SceneSimilarityContract,
}


class Check(NamedTuple):
    """How a component is tested."""

    contract: type[Contract]
    example: Callable[..., Any] | None  #: None: that of the contract
    input: str  #: what the particles are, in words


def contract_of(cls: type) -> type[Contract]:
    """The contract of a class of components, for example `UpdateContract` for an `Update`.

    Raises InputError if no interface of the class has a contract.
    """
    for base in cls.__mro__:
        if base.__module__.startswith("mstfilter."):
            name = f"{base.__name__}Contract"
            for module in (stages, hypotheses, numbers):
                contract = getattr(module, name, None)
                if contract is not None:
                    return contract
        if base in stages.STAGE_OWNERS:
            return stages.StageContract
    named = [name.removesuffix("Contract") for name in dir(numbers) if name.endswith("Contract")]
    interfaces = [*filter(None, named), "Evidence", *(stage.__name__ for stage in stages.STAGE_OWNERS)]
    raise InputError(f"{cls.__name__} is no component with a contract", f"inherit one of {', '.join(interfaces)}")


def check_of(component: Any, example: Callable[..., Any] | None = None) -> Check:
    """How `run_contract` tests a component: the contract, and the particles.

    ``example(rng, n)`` is the given function, or the function ``example`` in the module of the component's class.
    Without one, stages of MST and components that work on hypotheses get a scene; others get numbers or vectors.
    """
    if is_model(component):
        return Check(numbers.ModelContract, None, "a run of a filter with 200 particles")
    cls = type(component)
    contract = contract_of(cls)
    example = example or _function_beside(cls, "example")
    if example is not None:
        particles = example(seeded(), 2)[0].particles
        of_scenes = all(isinstance(one, Hypothesis) for one in particles)
        return Check(_for(contract, of_scenes), example, f"those of {_name_of(example)}")
    if issubclass(contract, (stages.StageContract, hypotheses.EvidenceContract)):
        return Check(contract, None, _SCENES)
    of_package = cls.__module__.startswith("mstfilter.") and not cls.__module__.startswith("mstfilter.smc.")
    numbers_work = _works(component, contract, None)
    if numbers_work and not of_package:
        return Check(contract, None, _NUMBERS)
    if of_package or _works(component, _for(contract, True), scene_example):
        return Check(_for(contract, True), scene_example, _SCENES)
    if _works(component, contract, vector_example):
        return Check(contract, vector_example, "vectors (n, 2)")
    if numbers_work is None or not _knows_scenes(cls):
        return Check(contract, None, f"{_NUMBERS}; for others write example(rng, n) beside the class")
    return Check(_for(contract, True), scene_example, _SCENES)


def is_model(component: Any) -> bool:
    """Whether a component is a model: a `StateSpaceModel`, a `Program`, its function, or a filter made of one."""
    return isinstance(component, StateSpaceModel | Program | ParticleFilter | FunctionType | functools.partial)


_NUMBERS = "numbers (n,)"
_SCENES = "hypotheses of a scene, and the clip of a push"


def vector_example(rng: np.random.Generator, n: int) -> tuple[Population, np.ndarray]:
    """A population of `n` weighted vectors (n, 2), and an observation (2,)."""
    return Population(rng.standard_normal((n, 2)), 0.5 * rng.standard_normal(n)), np.array([0.3, -0.1])


def _for(contract: type[Contract], of_scenes: bool) -> type[Contract]:
    return _OF_SCENES.get(contract, contract) if of_scenes else contract


def _works(component: Any, contract: type[Contract], example: Callable[..., Any] | None) -> bool | None:
    """Whether calls with the particles of an example return a result, which is no hypothesis for numbers.

    None if the component accepts the particles, and the package rejects what it makes of them.
    """
    methods = {"make": staticmethod(lambda: component)}
    if example is not None:
        methods["example"] = staticmethod(example)
    tests = type("Trial", (contract,), methods)()
    try:
        with np.errstate(all="ignore"):
            results = [tests.call(component, seeded(3), inputs) for inputs in (tests.inputs(6), tests.inputs(3, 1))]
    except InputError:
        return None
    except Exception:
        return False
    if example is scene_example:
        return True
    return not any(
        isinstance(one, Hypothesis)
        for result in results
        if isinstance(result, Population) and isinstance(result.particles, tuple)
        for one in result.particles
    )


def _knows_scenes(cls: type) -> bool:
    """Whether the module of a class imports anything of this package that is about scenes."""
    module = sys.modules.get(cls.__module__)
    homes = (str(getattr(value, "__module__", "")).split(".") for value in vars(module or cls).values())
    return any(home[0] == "mstfilter" and home[1:2] not in ([], *_NEUTRAL) for home in homes)


_NEUTRAL = [["smc"], ["base"]]


def run_contract(
    component: Any,
    example: Callable[..., Any] | None = None,
    exact: Callable[..., Any] | None = None,
    budget: float | None = None,
    progress: Callable[[CheckResult], None] | None = None,
    observations: Sequence[Any] | None = None,
) -> list[CheckResult]:
    """Test all properties of a component whose interface has a contract, or of a model.

    ``example(rng, n)`` returns a population and an observation that the component can process. The default is the
    function ``example`` in the module of the component's class. Without such a function, components that use images
    get a scene, and other components get numbers.

    For a `Transition`, `Proposal`, `Update` or `Rejuvenation`, ``exact(rng, n)`` returns exact draws and the
    observation, as the contract describes. The default is the function ``exact`` in the module of the class, if any.

    With a `budget` in seconds, properties that cannot be tested in time are skipped, and `CheckResult.out_of_time`
    says so. `progress` is called with each result as soon as there is one. `observations` are those of a run of a
    model; without them they are drawn from the model, if it can be simulated.
    """
    check = check_of(component, example)
    if is_model(component):
        contract = type("ModelContract", (numbers.ModelContract,), {"observations": observations})
        return check_properties(component, contract, budget=budget, progress=progress)
    exact = exact or _function_beside(type(component), "exact")
    return check_properties(component, check.contract, check.example, exact, budget, progress)


def _function_beside(cls: type, name: str) -> Callable[..., Any] | None:
    """The function with a given name in the module of a class."""
    found = getattr(sys.modules.get(cls.__module__), name, None)
    return found if callable(found) else None


def _name_of(function: Callable[..., Any]) -> str:
    return str(getattr(function, "__name__", "example"))
