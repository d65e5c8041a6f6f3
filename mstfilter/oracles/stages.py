"""The stages of `mst` and the changes that replace each by the truth: arms of an error budget.

>>> mstfilter.preset("mst", *STAGES["motions"])
>>> list(budget_arms())[:3]
['mst', 'true boundary', 'true masks']

One stage at a time says what a perfect one would bring to today's filter; all but one says what a stage costs a
filter that is perfect elsewhere. The two differ because stages mend one another's faults.
"""

from __future__ import annotations

__all__ = ["ALL", "STAGES", "budget_arms", "overrides_of"]

#: Changes to the preset ``mst`` by stage. Fields that are named beside a component keep those of ``mst``.
STAGES: dict[str, tuple[str, ...]] = {
    "boundary": ('proposal.boundary={component="true_boundary", form="cleaned"}',),
    "masks": ("proposal=true_masks",),
    "completion": ("proposal.completer=true_completion",),
    "motions": ("transition=true_motions",),
    "choice": ('update.evidence=["true_quality"]', "update.n_scored=100"),
    "fusion": ("update=true_fusion",),
    "free space": ("update.free_space=true_free_space",),
    "selection": ("resampler=true_best",),
}

#: The stages of a filter that is perfect throughout. True masks need no boundary, true fusion leaves no choice.
ALL: tuple[str, ...] = ("masks", "completion", "motions", "fusion", "free space", "selection")


def overrides_of(*stages: str) -> tuple[str, ...]:
    """Changes to ``mst`` that replace several stages, in an order in which none undoes another."""
    return tuple(change for stage in STAGES if stage in stages for change in STAGES[stage])


def budget_arms() -> dict[str, tuple[str, ...]]:
    """Arms of the error budget by name: ``mst``, one stage true, all true, all true but one."""
    arms: dict[str, tuple[str, ...]] = {"mst": ()}
    arms |= {f"true {stage}": overrides_of(stage) for stage in STAGES}
    arms["all true"] = overrides_of(*ALL)
    arms |= {f"all but {left}": overrides_of(*(s for s in ALL if s != left)) for left in ALL}
    return arms
