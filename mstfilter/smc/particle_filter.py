"""The particle filter: a short driver over components.

>>> filter = ParticleFilter(initial=prior, transition=move, update=Reweight(likelihood), n=1000)
>>> state, infos = filter.run(observations, seed=0)
>>> state.population.weights, state.log_evidence

A step moves the particles, proposes new ones, fuses the two with the observation, and resamples:

    predicted = transition.predict(previous, y)
    proposed  = proposal.sample(y, n_proposed)
    fused     = update.update(predicted, proposed, y)
    next      = resampler.resample(fused, n)

Textbook filters leave `proposal` out; MST (Price, Huang, Berenson 2021, Alg. 1) uses all four. Guided filters have
a transition that weighs its moves, auxiliary filters a `lookahead`, resample-move filters a `rejuvenation`. `step`
is a pure function of a `State`, so a run can be stopped, stored and resumed anywhere; `run` and `iterate` are loops
over it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.smc.fields import part, whole
from mstfilter.smc.interfaces import (
    Codec,
    Component,
    Lookahead,
    Proposal,
    Rejuvenation,
    Resampler,
    Size,
    Transition,
    Trigger,
    Update,
)
from mstfilter.smc.once import identity, keep_memory, unused
from mstfilter.smc.population import Population
from mstfilter.smc.resampling import EssBelow, Systematic
from mstfilter.smc.state import Info, State
from mstfilter.smc.streams import Key
from mstfilter.smc.watch import Watch

if TYPE_CHECKING:
    from mstfilter.smc.checkpoint import Checkpoint

__all__ = ["Info", "ParticleFilter", "SLOTS", "State"]

#: Fields of a filter that hold components whose weights matter.
SLOTS = ("initial", "transition", "proposal", "update", "resampler", "lookahead", "rejuvenation")
_INTERFACES: dict[str, type] = {
    "initial": Proposal,
    "transition": Transition,
    "proposal": Proposal,
    "update": Update,
    "resampler": Resampler,
    "trigger": Trigger,
    "lookahead": Lookahead,
    "rejuvenation": Rejuvenation,
    "size": Size,
}


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
        Brings in the observation. Left out where the transition weighs particles itself (probabilistic programs).
    resampler : Resampler
        Selection.
    trigger : Trigger
        When to resample. More than `n` particles are resampled in any case.
    lookahead : Lookahead, optional
        Auxiliary filter: selects by weight times priority. Needs ``resample="before"``.
    rejuvenation : Rejuvenation, optional
        Resample-move: moves the particles at the end of a step that resampled.
    size : Size, optional
        How many particles a resampling makes; `n` where left out.
    n : int
        Particles to start with, and to keep.
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
    lookahead: Lookahead | None = None
    rejuvenation: Rejuvenation | None = None
    size: Size | None = None
    n: int = 100
    n_proposed: int = 0
    resample: Literal["after", "before"] = "before"

    def __post_init__(self) -> None:
        whole("n", self.n)
        whole("n_proposed", self.n_proposed, at_least=0)
        for name, interface in _INTERFACES.items():
            part(name, getattr(self, name), interface, optional=name not in ("resampler", "trigger"))
        if self.initial is None and self.proposal is None:
            raise InputError("the filter has neither `initial` nor `proposal`: no particles to start from")
        if self.resample not in ("after", "before"):
            raise InputError(f'resample is {self.resample!r}, expected "after" or "before"')
        if self.lookahead is not None and self.resample == "after":
            raise InputError(
                'a lookahead sees the next observation, which resample="after" comes before',
                'use resample="before"',
            )

    @property
    def properly_weighted(self) -> bool:
        """Whether every component is, and no proposal adds particles to weights that carry the evidence so far."""
        if self.proposal is not None:
            return False
        parts = (getattr(self, slot) for slot in SLOTS)
        return all(part.properly_weighted for part in parts if isinstance(part, Component))

    def start(self, seed: int | Key = 0) -> State:
        """The state before the first observation."""
        return State(0, None, seed if isinstance(seed, Key) else Key(seed), self.properly_weighted)

    def step(self, state: State, observation: Any) -> tuple[State, Info]:
        """Assimilate one observation (None: it is missing, the particles are only moved).

        Raises
        ------
        InputError
            What a component could not work with, with the step and the slot.
        """
        watch = Watch()
        try:
            return self._step(state, observation, watch)
        except InputError as error:
            raise type(error)(f"step {state.t}, {watch.slot}: {error.message}", *error.hints) from error

    def _step(self, state: State, observation: Any, watch: Watch) -> tuple[State, Info]:
        streams = state.key.child("step", state.t)
        past, before = self._select_before(state, observation, streams, watch)
        predicted = self._predict(past, observation, streams, watch)
        proposed = self._propose(predicted, observation, streams, watch)
        fused = self._fuse(predicted, proposed, observation, streams, watch)
        chosen, ancestors = self._select_after(fused, past, state.t, streams, watch)
        if self.rejuvenation is not None and "resampler" in watch.seconds:
            chosen = self._rejuvenate(self.rejuvenation, chosen, past, observation, streams, watch)
        watch.enter("build")
        chosen = chosen.realised()
        watch.leave()

        parents = {name: index for name, index in chosen.parents.items() if name != "ancestor"}
        if before is not None and "previous" in parents:
            old = parents["previous"]
            parents["previous"] = before if old is identity(len(before)) else np.where(old >= 0, before[old], -1)
        ess = fused.ess  # kept by the population: the trigger of the next step asks again
        population = chosen.labelled(parents)
        info = Info(
            t=state.t,
            n=len(population),
            n_candidates=len(fused),
            ess=ess,
            resampled="resampler" in watch.seconds,
            ancestors=ancestors,
            parents=parents,
            log_weights=population.log_weights,
            notes=watch.notes,
            seconds=watch.seconds,
        )
        return State(state.t + 1, population, state.key, state.properly_weighted), info

    def _select_before(
        self, state: State, observation: Any, streams: Key, watch: Watch
    ) -> tuple[Population | None, np.ndarray | None]:
        """x_{t-1} as it goes into the prediction, and which ones survived a resampling (None: there was none)."""
        if state.population is None or self.resample == "after":
            return state.population, None
        population, priority = state.population, None
        if self.lookahead is not None and observation is not None:
            watch.enter("lookahead")
            priority = self._priority(self.lookahead, population, observation)
            population = population.reweighted(priority)
            watch.leave()
        watch.enter("resampler")
        if not self.trigger.wants(population, state.t):
            return state.population, None
        n = self.n if self.size is None else self.size.choose(population)
        selected = self.resampler.resample(streams.child("resampler").generator(), population.labelled({}), n)
        ancestors = selected.parents.get("ancestor")
        if priority is not None:
            if ancestors is None:
                raise InputError("a lookahead needs a resampler that reports ancestors, and this one does not")
            selected = selected.reweighted(-priority[ancestors])
        watch.leave(selected)
        return selected, np.full(len(selected), -1) if ancestors is None else ancestors

    @staticmethod
    def _priority(lookahead: Lookahead, population: Population, observation: Any) -> np.ndarray:
        priority = np.asarray(lookahead.log_priority(population, observation), dtype=np.float64)
        if priority.shape != (len(population),):
            raise InputError(f"log priorities have shape {priority.shape}, expected ({len(population)},)")
        wrong = np.flatnonzero(~np.isfinite(priority))
        if len(wrong):
            raise InputError(
                f"log priority of particle {wrong[0]} is {priority[wrong[0]]} ({len(wrong)} of {len(priority)} are "
                "not finite)",
                "a particle that is never selected would bias the filter: bound the priority from below",
            )
        return priority

    def _predict(self, past: Population | None, observation: Any, streams: Key, watch: Watch) -> Population | None:
        """Predicted particles; None at the first step of a filter that starts from its proposal."""
        if past is None:
            if self.initial is None or self.initial == self.proposal:
                return None
            watch.enter("initial")
            population = self.initial.sample(streams.child("initial").generator(), observation, self.n)
            if len(population) != self.n:
                raise InputError(f"asked for {self.n} particles it returned {len(population)}")
            watch.leave(population)
            return population
        stayed = {"previous": identity(len(past))}
        population = past.realised().labelled(stayed)
        if self.transition is None:
            return population
        watch.enter("transition")
        moved = self.transition.predict(streams.child("transition").generator(), population, observation)
        if "previous" not in moved.parents and len(moved) == len(population):
            moved = moved.labelled({**moved.parents, **stayed}, moved.notes)
        watch.leave(moved)
        return moved

    def _propose(
        self, predicted: Population | None, observation: Any, streams: Key, watch: Watch
    ) -> Population | None:
        """Particles from the observation; None where there is no proposal or nothing was observed."""
        if self.proposal is None or (observation is None and predicted is not None):
            return None
        watch.enter("proposal")
        if observation is None:
            raise InputError("the first observation is missing and the filter starts from its proposal")
        n = self.n_proposed or self.n
        proposed = self.proposal.sample(streams.child("proposal").generator(), observation, n)
        proposed = proposed.labelled({"proposed": identity(len(proposed))}, proposed.notes)
        watch.leave(proposed)
        return proposed

    def _fuse(
        self,
        predicted: Population | None,
        proposed: Population | None,
        observation: Any,
        streams: Key,
        watch: Watch,
    ) -> Population:
        """What the update makes of predicted and proposed particles."""
        if observation is None or self.update is None:
            fused = predicted if predicted is not None else proposed
            assert fused is not None
            return fused
        watch.enter("update")
        rng = streams.child("update").generator() if self.update.draws else unused()
        fused = self.update.update(rng, predicted, proposed, observation)
        watch.leave(fused)
        return fused

    def _select_after(
        self, fused: Population, past: Population | None, t: int, streams: Key, watch: Watch
    ) -> tuple[Population, np.ndarray]:
        """The particles to keep, and which candidates they were."""
        watch.enter("resampler")
        after, n, limit = self.resample == "after", self.n, self.n
        if self.size is not None:
            # Before the prediction the size was chosen already; only particles beyond that are taken away.
            limit = max(self.n, 0 if past is None else len(past))
            if after or len(fused) > limit:
                n = self.size.choose(fused)
                limit = n if after else limit
        if len(fused) <= limit and not (after and self.trigger.wants(fused, t)):
            return fused, identity(len(fused))
        chosen = self.resampler.resample(streams.child("resampler").generator(), fused, n)
        watch.leave(chosen if chosen.notes is not fused.notes else None)
        return chosen, np.asarray(chosen.parents.get("ancestor", np.full(len(chosen), -1)))

    def _rejuvenate(
        self,
        rejuvenation: Rejuvenation,
        chosen: Population,
        past: Population | None,
        observation: Any,
        streams: Key,
        watch: Watch,
    ) -> Population:
        """Particles after the move, with the parents they had."""
        watch.enter("rejuvenation")
        population, previous = chosen.realised(), None
        if past is not None:
            index = population.parents.get("previous")
            if index is None or (index < 0).any():
                raise InputError("rejuvenation needs a parent for every particle, and some have none")
            previous = past if index is identity(len(past)) else past.take(index)
        moved = rejuvenation.move(streams.child("rejuvenation").generator(), population, previous, observation)
        if len(moved) != len(population):
            raise InputError(f"a move returned {len(moved)} of {len(population)} particles, expected all in order")
        watch.leave(moved if moved.notes is not population.notes else None)
        return moved.labelled(population.parents, moved.notes)

    def iterate(
        self,
        observations: Iterable[Any],
        state: State | int = 0,
        *,
        checkpoint: str | Path | None = None,
        codec: Codec | None = None,
    ) -> Iterator[tuple[State, Info]]:
        """States and infos, one an observation, as they come in.

        Parameters
        ----------
        observations : iterable
            One a step; None where one is missing.
        state : State or int
            Where to go on from, or a seed.
        checkpoint : path, optional
            A file that holds the state after every step. Where it exists, the run goes on from it: as many of the
            `observations` are skipped as it has seen, and the end is that of a run that was never stopped.
        codec : Codec, optional
            Stores particles other than arrays, mappings of arrays and dataclasses of arrays.
        """
        observations, current, store = self._begin(observations, state, checkpoint, codec)
        for observation in observations:
            current, info = self.step(current, observation)
            if store is not None:
                store.save(self, current)
            yield current, info

    def run(
        self,
        observations: Iterable[Any],
        seed: int | State = 0,
        *,
        checkpoint: str | Path | None = None,
        codec: Codec | None = None,
    ) -> tuple[State, list[Info]]:
        """The last state and the infos of all steps; parameters as in `iterate`.

        The infos of a run that went on from a checkpoint are those of the steps made now.
        """
        observations, state, store = self._begin(observations, seed, checkpoint, codec)
        infos = []
        for observation in observations:
            state, info = self.step(state, observation)
            if store is not None:
                store.save(self, state)
            infos.append(info)
        return state, infos

    def _begin(
        self, observations: Iterable[Any], state: State | int, checkpoint: str | Path | None, codec: Codec | None
    ) -> tuple[Iterable[Any], State, Checkpoint | None]:
        """What is left to observe, the state to go on from, and where to store it."""
        keep_memory()
        current = state if isinstance(state, State) else self.start(state)
        if checkpoint is None:
            return observations, current, None
        from mstfilter.smc.checkpoint import Checkpoint

        store = Checkpoint(Path(checkpoint), codec)
        stored = store.load(self, current)
        if stored is None:
            return observations, current, store
        return islice(observations, stored.t - current.t, None), stored, store
