"""Contracts of evidence terms and of the stages of MST: boundaries, trees, cuts, completion, motions, updates.

`contract_of` and `run_contract` accept components of every interface, including those in `mstfilter.smc`.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

import mstfilter.smc.testing as numbers
from mstfilter.completion import Completer, ObservedBox, observed_box
from mstfilter.completion.completer import fault_of
from mstfilter.crossover import Crossover, CrossoverUpdate, Structure
from mstfilter.errors import InputError, InputWarning
from mstfilter.partition import PairOdds, PartitionUpdate
from mstfilter.scene import Clip, Hypothesis, Projection, render_hypothesis, scene_cache
from mstfilter.segmentation import BoundaryModel, CutSampler, CutValue, TreeBuilder, TreeCutProposal
from mstfilter.smc import Component, Population, Proposal, Transition, child
from mstfilter.smc.testing.contract import (
    CheckResult,
    Contract,
    check_properties,
    close,
    prerequisite,
    reports_errors,
    same,
    seeded,
    skips_errors,
)
from mstfilter.smc.testing.values import ScoreContract
from mstfilter.testing.scenes import scene_example
from mstfilter.tracking import (
    DenseFlow,
    MaskTracker,
    MotionRule,
    MstRule,
    Registration,
    Track,
    TrackingTransition,
    segments_of,
)
from mstfilter.tracking.rules import fault_of_motions

#: The warnings of a run are properties of their own in a contract.
_quiet = partial(warnings.catch_warnings, action="ignore", category=InputWarning)
#: Interface of a stage -> the component of a filter that uses it.
STAGE_OWNERS: dict[type, Callable[[Any], Component]] = {
    BoundaryModel: lambda stage: TreeCutProposal(boundary=stage),
    TreeBuilder: lambda stage: TreeCutProposal(tree=stage),
    CutValue: lambda stage: TreeCutProposal(value=stage),
    CutSampler: lambda stage: TreeCutProposal(sampler=stage),
    Completer: lambda stage: TreeCutProposal(completer=stage),
    MaskTracker: lambda stage: TrackingTransition(tracker=stage),
    MotionRule: lambda stage: TrackingTransition(rule=stage),
    Registration: lambda stage: TrackingTransition(rule=MstRule(registration=stage)),
    Projection: lambda stage: CrossoverUpdate(free_space=stage),
    Structure: lambda stage: CrossoverUpdate(crossover=Crossover(structure=stage)),
    PairOdds: lambda stage: PartitionUpdate(pairs=stage),
}


class EvidenceContract(ScoreContract):
    """The contract of every `Evidence`. The default example is `scene_example`."""

    example = staticmethod(scene_example)

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> np.ndarray:
        """Log scores, rounded to 9 digits."""
        hypotheses = tuple(inputs["population"].realised().particles)
        return np.round(component.log_score(hypotheses, inputs["observation"]), 9)

    def test_copies_score_the_same(self) -> None:
        """Equal hypotheses have equal scores, also if their labels have other numbers."""
        inputs, rng = self.inputs(9), seeded(2)
        hypotheses = tuple(inputs["population"].realised().particles)

        def renamed(labels: np.ndarray) -> np.ndarray:
            table = np.concatenate([[0], 3 + 5 * rng.permutation(int(labels.max()))])
            return table.astype(np.uint16)[labels]

        for change, fault in (
            (np.copy, "a hypothesis and its copy have different scores"),
            (renamed, "other numbers for the same labels give other scores"),
        ):
            copies = tuple(Hypothesis.from_labels(change(h.labels), h.grid) for h in hypotheses)
            scores = self.checked_call(self.make(), {**inputs, "population": Population(hypotheses + copies)})
            assert close(scores[:9], scores[9:]), fault


class StageContract(Contract):
    """The contract of a stage of MST, which is tested as a part of the proposal, the tracking or the update."""

    example = staticmethod(scene_example)

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """The result of the proposal, transition or update that uses the component."""
        owner = next(use for interface, use in STAGE_OWNERS.items() if isinstance(component, interface))(component)
        population, clip = inputs["population"], inputs["observation"]
        scene_cache.clear()  # a repeated call runs the component again
        if isinstance(owner, Proposal):
            found = owner.sample(rng, clip, len(population))
        elif isinstance(owner, Transition):
            found = owner.predict(rng, population, clip)
        else:
            assert isinstance(owner, CrossoverUpdate | PartitionUpdate)
            found = owner.update(rng, population, population.take(np.arange(min(2, len(population)))), clip)
            if isinstance(owner, CrossoverUpdate):
                found = found.take(np.arange(0, len(found), 5))
        return found.realised()

    @prerequisite
    def test_works_in_its_place(self) -> None:
        """The filter step that uses the component returns hypotheses, also if no hypothesis has an object."""
        inputs = self.inputs(2)
        grid = inputs["observation"].grid
        empty = Hypothesis.from_labels(np.zeros(grid.shape, np.uint16), grid)
        for given in (self.inputs(1), self.inputs(4), {**inputs, "population": Population((empty, empty))}):
            with reports_errors(given):
                result = StageContract.call(self, self.make(), seeded(3), given)
            assert all(isinstance(h, Hypothesis) for h in result.particles), "the result has no hypotheses"


class CompleterContract(StageContract):
    """The contract of every `Completer`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> list[np.ndarray]:
        """The estimated probabilities in the boxes of three objects, computed without a cache."""
        seen = _boxes(component, _correct(inputs), inputs["observation"])
        return [np.array(p) for p in _estimated(component, rng, seen, inputs["observation"])]

    def _seen(self, cut: bool = False) -> tuple[list[ObservedBox], Clip]:
        """Boxes of the three objects in the example, and the example's clip."""
        inputs = self.inputs(1)
        return _boxes(self.make(), _correct(inputs), inputs["observation"], cut), inputs["observation"]

    def _filled(self, seen: list[ObservedBox], clip: Clip, first: int = 0) -> list[np.ndarray]:
        with skips_errors():
            return _estimated(self.make(), seeded(0), seen, clip, first)

    def test_works_for_any_box(self) -> None:
        """The completer works for a box with edges of different lengths, and for a box without voxels."""
        seen, clip = self._seen()
        odd = [_cropped(seen[0], *size) for size in ((7, 6, 5), (0, 0, 0))]
        with reports_errors("boxes of shape (7, 6, 5) and (0, 0, 0)"):
            _estimated(self.make(), seeded(0), odd, clip)

    def test_follows_what_is_seen(self) -> None:
        """The probabilities are not constant, and the visible surface is probably occupied."""
        seen, clip = self._seen()
        fault = fault_of(seen, self._filled(seen, clip))
        assert fault is None, f"{type(self.make()).__name__}.fill {fault}"

    def test_axes_are_those_of_the_grid(self) -> None:
        """The result has the axes of the box: a reversed result fits the visible surface less well."""
        seen, clip = self._seen(cut=True)
        filled = self._filled(seen, clip)
        choices = [axes for n in range(4) for axes in combinations(range(3), n)]
        fit = {axes: _on_surface(filled, seen, axes) for axes in choices}
        best = max(choices, key=lambda axes: fit[axes])
        assert fit[()] >= fit[best] - 0.05, (
            f"the visible surface has a mean probability of {fit[()]:.2f}, and of {fit[best]:.2f} if the axes {best} "
            "of the result are reversed"
        )

    def test_objects_do_not_depend_on_others(self) -> None:
        """The result for an object depends neither on other objects nor on the order of the objects."""
        seen, clip = self._seen()
        every, last = self._filled(seen, clip), self._filled(seen[-1:], clip, len(seen) - 1)
        assert same(np.asarray(every[-1]), np.asarray(last[0])), (
            "an object is completed differently without the others"
        )


def _correct(inputs: dict[str, Any]) -> Hypothesis:
    """The hypothesis with the largest number of objects."""
    return max(inputs["population"].particles, key=lambda h: h.n_objects)


def _on_surface(filled: list[np.ndarray], seen: list[ObservedBox], axes: tuple[int, ...]) -> float:
    """Mean probability of the visible surface, with some axes of the probabilities reversed."""
    return float(np.mean([np.flip(p, axes)[one.surface].mean() for p, one in zip(filled, seen, strict=True)]))


def _boxes(completer: Completer, hypothesis: Hypothesis, clip: Clip, cut: bool = False) -> list[ObservedBox]:
    """The boxes of the objects of a hypothesis in the first frame. With `cut`, half of each mask is removed."""
    image, _ = render_hypothesis(hypothesis, clip.before.camera)
    masks = [image == k for k in np.unique(image[image > 0])]
    if cut:
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        masks = [mask & (u - v < (u - v)[mask].mean()) for mask in masks]
    return [observed_box(clip.before, mask, clip.grid, completer)[1] for mask in masks]


def _estimated(
    completer: Completer, rng: np.random.Generator, seen: list[ObservedBox], clip: Clip, first: int = 0
) -> list[np.ndarray]:
    """The estimated probabilities in the boxes. Box k uses the random stream `first` + k."""
    bound = completer.at(clip)
    with _quiet():
        return bound.estimate([child(rng, "box", first + k) for k in range(len(seen))], seen)


def _cropped(box: ObservedBox, a: int, b: int, c: int) -> ObservedBox:
    """The first ``a x b x c`` voxels of a box."""
    parts = {f.name: getattr(box, f.name)[:a, :b, :c] for f in fields(box) if f.name != "height"}
    return ObservedBox(**parts, height=box.height[:c])


class MotionRuleContract(StageContract):
    """The contract of every `MotionRule`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> list[Any]:
        """Kind, motion, support and score of all candidate motions and of the chosen motion of each object."""
        found = []
        for label, track in _tracks(inputs):
            with _quiet():
                candidates = component.candidates(child(rng, "segment", label), track)
            chosen = component.choose(child(rng, "choice", label), candidates)
            found += [(c.kind, c.T.as_matrix(), c.support, c.score) for c in (*candidates, chosen)]
        return found

    def test_motions_stay_in_the_workspace(self) -> None:
        """No candidate moves an object farther than the workspace is wide."""
        component, rng = self.make(), seeded(0)
        for label, track in _tracks(self.inputs(1)):
            with skips_errors(), _quiet():
                candidates = component.candidates(child(rng, "segment", label), track)
            fault = fault_of_motions(candidates, track)
            assert fault is None, f"{type(component).__name__}.candidates {fault}"


def _tracks(inputs: dict[str, Any]) -> list[tuple[int, Track]]:
    """Label and track of each visible object of a hypothesis in the clip."""
    clip = inputs["observation"]
    flow = DenseFlow().track(clip)
    segments = segments_of(_correct(inputs), clip.before)
    return [(label, Track(one, clip, flow)) for label, one in segments.items() if len(one.support)]


# --- the check of any component: what ``mstfilter check`` does -----------------------------------------------------


def contract_of(cls: type) -> type[Contract]:
    """The contract of a class of components, for example `UpdateContract` for an `Update`.

    Raises InputError if no interface of the class has a contract.
    """
    for base in cls.__mro__:
        if base.__module__.startswith("mstfilter."):
            name = f"{base.__name__}Contract"
            contract = globals().get(name) or getattr(numbers, name, None)
            if contract is not None:
                return contract
        if base in STAGE_OWNERS:
            return StageContract
    named = [name.removesuffix("Contract") for name in dir(numbers) if name.endswith("Contract")]
    interfaces = [*filter(None, named), "Evidence", *(stage.__name__ for stage in STAGE_OWNERS)]
    raise InputError(f"{cls.__name__} is no component with a contract", f"inherit one of {', '.join(interfaces)}")


def run_contract(
    component: Any, example: Callable[..., Any] | None = None, exact: Callable[..., Any] | None = None
) -> list[CheckResult]:
    """Test all properties of a component whose interface has a contract.

    ``example(rng, n)`` returns a population and an observation that the component can process. The default is the
    function ``example`` in the module of the component's class. Without such a function, components that use images
    get a scene, and other components get numbers.

    For a `Transition`, `Proposal`, `Update` or `Rejuvenation`, ``exact(rng, n)`` returns exact draws and the
    observation, as the contract describes. The default is the function ``exact`` in the module of the class, if any.
    """
    cls = type(component)
    contract = contract_of(cls)
    of_scenes = cls.__module__.startswith("mstfilter.") and not cls.__module__.startswith("mstfilter.smc.")
    example = example or _function_beside(cls, "example") or (scene_example if of_scenes else None)
    return check_properties(component, contract, example, exact or _function_beside(cls, "exact"))


def _function_beside(cls: type, name: str) -> Callable[..., Any] | None:
    """The function with a given name in the module of a class."""
    found = getattr(sys.modules.get(cls.__module__), name, None)
    return found if callable(found) else None
