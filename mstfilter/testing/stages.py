"""The contract of the stages of MST: boundaries, trees, cuts, completion, motions and the parts of fusion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mstfilter.completion import Completer
from mstfilter.fusion import Crossover, Division, FusionUpdate, PairOdds, PartitionUpdate, Projection, Structure
from mstfilter.scene import Hypothesis
from mstfilter.segmentation import BoundaryModel, CutSampler, CutValue, TreeBuilder, TreeCutProposal
from mstfilter.smc import Component, Population, Proposal, Transition
from mstfilter.testing.contract import RandomContract, prerequisite
from mstfilter.testing.scenes import scene_example
from mstfilter.tracking import MaskTracker, MotionRule, MstRule, Registration, TrackingTransition

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
    Projection: lambda stage: FusionUpdate(free_space=stage),
    Structure: lambda stage: FusionUpdate(crossover=Crossover(structure=stage)),
    Division: lambda stage: FusionUpdate(division=stage),
    PairOdds: lambda stage: PartitionUpdate(pairs=stage),
}


class StageContract(RandomContract):
    """The contract of a stage of MST, which is tested in its place in the proposal, the tracking or the fusion."""

    def example(self, rng: np.random.Generator, n: int) -> tuple[Population, Any]:
        """`n` hypotheses and a clip."""
        return scene_example(rng, n)

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        owner = next(use for interface, use in STAGE_OWNERS.items() if isinstance(component, interface))(component)
        population, clip = inputs["population"], inputs["observation"]
        if isinstance(owner, Proposal):
            found = owner.sample(rng, clip, len(population))
        elif isinstance(owner, Transition):
            found = owner.predict(rng, population, clip)
        else:
            assert isinstance(owner, FusionUpdate | PartitionUpdate)
            found = owner.update(rng, population, population.take(np.arange(min(2, len(population)))), clip)
            if isinstance(owner, FusionUpdate):
                found = found.take(np.arange(0, len(found), 5))
        return found.realised()

    def check_result(self, result: Any, inputs: dict[str, Any]) -> None:
        assert all(isinstance(h, Hypothesis) for h in result.particles), "the result has no hypotheses"

    @prerequisite
    def test_works_in_its_place(self) -> None:
        """It works in a filter: the step that uses it gives hypotheses."""
        for n in (1, 4):
            self.checked_call(self.make(), self.inputs(n))

    def test_works_for_an_empty_scene(self) -> None:
        """It works for hypotheses without objects."""
        inputs = self.inputs(2)
        clip = inputs["observation"]
        empty = Hypothesis.from_labels(np.zeros(clip.grid.shape, np.uint16), clip.grid)
        self.checked_call(self.make(), {**inputs, "population": Population((empty, empty))})
