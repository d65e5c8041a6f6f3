"""The particle filter: a short driver over components.

>>> filter = ParticleFilter(initial=prior, transition=move, update=Reweight(likelihood), n=1000)
>>> state, infos = filter.run(observations, seed=0)
>>> state.population.weights, state.log_evidence

A step moves the particles, proposes new ones, fuses the two with the observation, and resamples:

    predicted = transition.predict(previous, y)
    proposed  = proposal.sample(y, n_proposed)
    fused     = update.update(predicted, proposed, y)
    next      = resampler.resample(fused, n)

Textbook filters leave `proposal` out; MST (Price, Huang, Berenson 2021, Alg. 1) uses all four. `step` is a
pure function of a `State`, so a run can be stopped, stored and resumed anywhere; `run` and `iterate` are loops
over it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.interfaces import Component, Proposal, Resampler, Transition, Trigger, Update
from mstfilter.smc.population import Population, log_mean_exp
from mstfilter.smc.resampling import EssBelow, Systematic
from mstfilter.smc.streams import Key

__all__ = ["Info", "ParticleFilter", "State"]


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
        return 0.0 if self.population is None else log_mean_exp(self.population.log_weights)


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
        Effective sample size after the update, before resampling.
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
        return 0 if previous is None else len(set(previous[previous >= 0].tolist()))


class _Stopwatch:
    """Times the parts of a step and collects their notes."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.notes: dict[str, Mapping[str, Any]] = {}
        self._last = time.perf_counter()

    def lap(self, slot: str, population: Population | None = None) -> None:
        now = time.perf_counter()
        self.seconds[slot] = self.seconds.get(slot, 0.0) + now - self._last
        self._last = now
        if population is not None and population.notes:
            self.notes[slot] = population.notes


@dataclass(frozen=True)
class ParticleFilter:
    """A particle filter assembled from components.

    Parameters
    ----------
    initial : Proposal
        Where particles come from at the first step. Where it is the `proposal` itself (or left out), the first
        step has no prediction: proposed particles meet the first observation alone, as in MST. Else they are
        drawn from it and the first observation updates them before any prediction.
    transition : Transition
        Prediction.
    proposal : Proposal, optional
        New particles at every step.
    update : Update
        Brings in the observation.
    resampler : Resampler
        Selection.
    trigger : Trigger
        When to resample. More than `n` particles are resampled in any case.
    n : int
        Particles to keep.
    n_proposed : int
        Particles that the proposal is asked for at each step (`n` where 0).
    resample : {"after", "before"}
        After the update (MST), or before the next prediction (textbook: estimates at time t then use all weights).
    """

    initial: Proposal | None = None
    transition: Transition | None = None
    proposal: Proposal | None = None
    update: Update | None = None
    resampler: Resampler = Systematic()  # noqa: RUF009 (frozen)
    trigger: Trigger = EssBelow()  # noqa: RUF009 (frozen)
    n: int = 100
    n_proposed: int = 0
    resample: Literal["after", "before"] = "before"

    def __post_init__(self) -> None:
        if self.n < 1:
            raise InputError(f"n is {self.n}, expected at least one particle")
        if self.initial is None and self.proposal is None:
            raise InputError("the filter has neither `initial` nor `proposal`: no particles to start from")
        if self.resample not in ("after", "before"):
            raise InputError(f'resample is {self.resample!r}, expected "after" or "before"')

    @property
    def properly_weighted(self) -> bool:
        """Whether every component is."""
        parts = (self.initial, self.transition, self.proposal, self.update, self.resampler)
        return all(part.properly_weighted for part in parts if isinstance(part, Component))

    def start(self, seed: int | Key = 0) -> State:
        """The state before the first observation."""
        return State(0, None, seed if isinstance(seed, Key) else Key(seed), self.properly_weighted)

    def step(self, state: State, observation: Any) -> tuple[State, Info]:
        """Assimilate one observation (None: it is missing, the particles are only moved)."""
        t, watch = state.t, _Stopwatch()
        streams = state.key.child("step", t)
        predicted, before = self._predict(state, observation, streams, watch)
        proposed = self._propose(predicted, observation, streams, watch)

        if observation is None or self.update is None:
            fused = predicted if predicted is not None else proposed
            assert fused is not None
        else:
            fused = self.update.update(streams.child("update").generator(), predicted, proposed, observation)
            watch.lap("update", fused)

        chosen, ancestors = fused, np.arange(len(fused))
        late = self.resample == "after" and self.trigger.wants(fused, t)
        if len(fused) > self.n or late:
            chosen = self.resampler.resample(streams.child("resampler").generator(), fused, self.n)
            ancestors = np.asarray(chosen.parents.get("ancestor", np.full(len(chosen), -1)))
            watch.lap("resampler", chosen if chosen.notes is not fused.notes else None)
        chosen = chosen.realised()
        watch.lap("build")

        parents = {name: index for name, index in chosen.parents.items() if name != "ancestor"}
        if before is not None and "previous" in parents:
            previous = parents["previous"]
            parents["previous"] = np.where(previous >= 0, before[previous], -1)
        population = Population(chosen.particles, chosen.log_weights, parents)
        info = Info(
            t=t,
            n=len(population),
            n_candidates=len(fused),
            ess=fused.ess,
            resampled="resampler" in watch.seconds,
            ancestors=ancestors,
            parents=parents,
            log_weights=population.log_weights,
            notes=watch.notes,
            seconds=watch.seconds,
        )
        return State(t + 1, population, state.key, state.properly_weighted), info

    def _predict(
        self, state: State, observation: Any, streams: Key, watch: _Stopwatch
    ) -> tuple[Population | None, np.ndarray | None]:
        """Predicted particles, and which previous ones survived a resampling before (None: not resampled)."""
        if state.population is None:
            if self.initial is None or self.initial is self.proposal:
                return None, None
            rng = streams.child("initial").generator()
            population = self.initial.sample(rng, observation, self.n)
            watch.lap("initial", population)
            return population, None
        population, before = state.population, None
        if self.resample == "before" and self.trigger.wants(population, state.t):
            population = self.resampler.resample(streams.child("resampler").generator(), population, self.n)
            before = np.asarray(population.parents.get("ancestor", np.full(len(population), -1)))
            watch.lap("resampler")
        identity = {"previous": np.arange(len(population))}
        population = replace(population.realised(), parents=identity, notes={})
        if self.transition is not None:
            moved = self.transition.predict(streams.child("transition").generator(), population, observation)
            if "previous" not in moved.parents and len(moved) == len(population):
                moved = replace(moved, parents={**moved.parents, **identity})
            watch.lap("transition", moved)
            population = moved
        return population, before

    def _propose(
        self, predicted: Population | None, observation: Any, streams: Key, watch: _Stopwatch
    ) -> Population | None:
        """Particles from the observation; None where there is no proposal or nothing was observed."""
        if self.proposal is None or (observation is None and predicted is not None):
            return None
        if observation is None:
            raise InputError("the first observation is missing and the filter starts from its proposal")
        n = self.n_proposed or self.n
        proposed = self.proposal.sample(streams.child("proposal").generator(), observation, n)
        proposed = replace(proposed, parents={"proposed": np.arange(len(proposed))})
        watch.lap("proposal", proposed)
        return proposed

    def iterate(self, observations: Iterable[Any], state: State | int = 0) -> Iterator[tuple[State, Info]]:
        """States and infos, one an observation; `state` is one to go on from, or a seed."""
        current = state if isinstance(state, State) else self.start(state)
        for observation in observations:
            current, info = self.step(current, observation)
            yield current, info

    def run(self, observations: Iterable[Any], seed: int | State = 0) -> tuple[State, list[Info]]:
        """The last state and the infos of all steps."""
        state = seed if isinstance(seed, State) else self.start(seed)
        infos = []
        for observation in observations:
            state, info = self.step(state, observation)
            infos.append(info)
        return state, infos
