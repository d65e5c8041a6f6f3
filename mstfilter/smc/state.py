"""What a filter carries from step to step (`State`) and what it reports of each (`Info`).

>>> state, info = filter.step(state, observation)
>>> state.t, state.population, state.log_evidence
>>> info.ess, info.resampled, info.unique_ancestors

A `State` is all that is needed to go on, so it can be stored (`mstfilter.smc.checkpoint`) and taken up again in
another process to the same result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mstfilter.smc.population import Population
from mstfilter.smc.streams import Key

__all__ = ["Info", "State"]


@dataclass(frozen=True, eq=False)
class State:
    """All that is needed to go on.

    Parameters
    ----------
    t : int
        Number of observations seen so far.
    population : Population or None
        The particles after the last of them; None before the first.
    key : Key
        Names the random streams of the run.
    properly_weighted : bool
        Whether the weights are those of an exact filter.
    """

    t: int
    population: Population | None
    key: Key
    properly_weighted: bool = True

    @property
    def log_evidence(self) -> float | None:
        """Log of the unbiased estimate of p(y_1 .. y_t); None where a component is not properly weighted."""
        if not self.properly_weighted:
            return None
        return 0.0 if self.population is None else self.population.log_mean_weight


@dataclass(frozen=True, eq=False)
class Info:
    """What happened in a step.

    Parameters
    ----------
    t : int
        Index of the observation, from 0.
    n : int
        Particles after the step.
    n_candidates : int
        Particles after the update, before resampling.
    ess : float
        Effective sample size after the update, before any resampling after it.
    resampled : bool
        Whether the resampler was called in this step.
    ancestors : (n,) int
        Where it was called after the update: which candidate each particle was; else 0 .. n-1.
    parents : mapping
        ``"previous"`` and ``"proposed"`` parents of the particles after the step, where they are known.
    log_weights : (n,) float
        After the step.
    notes : mapping
        What each component recorded, by slot.
    seconds : mapping
        Wall time by slot. Not reproducible.
    """

    t: int
    n: int
    n_candidates: int
    ess: float
    resampled: bool
    ancestors: np.ndarray
    parents: Mapping[str, np.ndarray]
    log_weights: np.ndarray
    notes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def unique_ancestors(self) -> int:
        """How many different particles of the previous population have descendants (proposals not counted)."""
        previous = self.parents.get("previous")
        return 0 if previous is None else len(np.unique(previous[previous >= 0]))
