"""Textbook filters: the same driver, assembled for a state-space model.

>>> bootstrap(model, n=1000)                                   # Gordon, Salmond, Smith 1993
>>> guided(model, lambda x, y: Normal(...), n=100)             # Doucet, Godsill, Andrieu 2000
>>> auxiliary(model, log_priority, n=100)                      # Pitt and Shephard 1999
>>> resample_move(model, RandomWalkMove(model, 0.5), n=100)    # Gilks and Berzuini 2001

Each is a `ParticleFilter`, so any part can be replaced: ``replace(bootstrap(model, 100), resampler=...)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.smc.interfaces import Lookahead, Rejuvenation, Resampler, Trigger
from mstfilter.smc.particle_filter import ParticleFilter
from mstfilter.smc.population import Population
from mstfilter.smc.state_space import GuidedInitial, GuidedTransition, Prior, StateSpaceModel, bootstrap

__all__ = ["PriorityLookahead", "auxiliary", "bootstrap", "guided", "resample_move"]


def guided(
    model: StateSpaceModel,
    proposal: Callable[[Any, Any], Any],
    n: int,
    initial: Callable[[Any], Any] | None = None,
    resampler: Resampler | None = None,
    trigger: Trigger | None = None,
) -> ParticleFilter:
    """The guided filter: moves by q(x_t | x_{t-1}, y_t), weights by f g / q.

    Parameters
    ----------
    model : StateSpaceModel
        With its log densities.
    proposal : callable
        ``(particles, y) -> distribution`` of x_t.
    n : int
        Particles.
    initial : callable, optional
        ``(y) -> distribution`` of x_0; the model's prior where left out.
    resampler, trigger : Resampler, Trigger, optional
        Systematic at an effective sample size below half where left out.
    """
    return replace(
        bootstrap(model, n, resampler, trigger),
        initial=Prior(model) if initial is None else GuidedInitial(model, initial),
        transition=GuidedTransition(model, proposal),
    )


@dataclass(frozen=True)
class PriorityLookahead(Lookahead):
    """Priority by a function.

    Parameters
    ----------
    function : callable
        ``(particles, y) -> (n,)`` log priority of x_{t-1} given y_t.
    """

    function: Callable[[Any, Any], np.ndarray]

    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        """(n,) log priority."""
        return self.function(population.particles, observation)


def auxiliary(
    model: StateSpaceModel,
    log_priority: Callable[[Any, Any], np.ndarray],
    n: int,
    proposal: Callable[[Any, Any], Any] | None = None,
    initial: Callable[[Any], Any] | None = None,
    resampler: Resampler | None = None,
    trigger: Trigger | None = None,
) -> ParticleFilter:
    """The auxiliary filter (Pitt and Shephard 1999): selects by weight times priority, then takes that off again.

    Parameters
    ----------
    model : StateSpaceModel
        With its log densities where there is a proposal.
    log_priority : callable
        ``(particles, y) -> (n,)``, close to log p(y_t | x_{t-1}); any finite one is exact.
    n : int
        Particles.
    proposal, initial : callable, optional
        As in `guided`. With p(y_t | x_{t-1}) as priority and p(x_t | x_{t-1}, y_t) as proposal the filter is fully
        adapted.
    resampler, trigger : Resampler, Trigger, optional
        Systematic at an effective sample size (of the weights times the priorities) below half where left out.
    """
    if proposal is None:
        filter = bootstrap(model, n, resampler, trigger)
        if initial is not None:
            filter = replace(filter, initial=GuidedInitial(model, initial))
    else:
        filter = guided(model, proposal, n, initial, resampler, trigger)
    return replace(filter, lookahead=PriorityLookahead(log_priority))


def resample_move(
    model: StateSpaceModel,
    move: Rejuvenation,
    n: int,
    resampler: Resampler | None = None,
    trigger: Trigger | None = None,
) -> ParticleFilter:
    """The bootstrap filter with a move at the end of each step that resampled (Gilks and Berzuini 2001)."""
    return replace(bootstrap(model, n, resampler, trigger), rejuvenation=move)
