"""The particle filter: a short loop over components.

A filter keeps a weighted set of particles x_t^1 .. x_t^n which stands for what is known after the observations y_0 ..
y_t: if all components are properly weighted, the weighted mean of any function of the particles estimates its
posterior expectation. A new observation y needs three things: particles are selected in proportion to their weights,
moved by the model, and weighted by how well they explain y. Each is a component, and a step calls one after the other
(it resamples if the `trigger` says so)::

    past      = resampler.resample(previous, n)          only with resample="before", the textbook order
    predicted = transition.predict(past, y)
    proposed  = proposal.sample(y, n_proposed)
    fused     = update.update(predicted, proposed, y)
    next      = resampler.resample(fused, n)             with resample="after", the order of MST

A `Proposal` makes particles from the observation alone, without the past. Textbook filters have none in a step: what
textbooks call the proposal density is a guided `Transition` here. The bootstrap filter of x_0 ~ N(0, 1), x_t ~ N(0.9
x_{t-1}, 0.5^2) and y_t ~ N(x_t, 1) moves by the model and weights by the likelihood:

>>> from mstfilter.smc import Dynamics, Normal, ParticleFilter, Prior, Reweight, StateSpaceModel
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> filter = ParticleFilter(Prior(model), Dynamics(model), update=Reweight(model.log_likelihood), n=1000)
>>> states, observations = model.simulate(50, seed=1)
>>> state, infos = filter.run(observations, seed=0)
>>> mean = state.population.mean()                                         # E[x_49 | y_0 .. y_49]
>>> log_evidence = state.log_evidence                                      # an estimate of log p(y_0 .. y_49)

`bootstrap(model, n=1000)` is the same filter. Guided filters have a transition that also weights particles, and MST
(Price, Huang, Berenson 2021) uses all four components above. With ``resample="before"``, a step also resamples after
an update that returned more than n particles, unless the resampler chooses the number itself (`Sized`).

`step` is a pure function of a `State`, so a run can be stopped, stored and resumed at any step. Reference: Chopin and
Papaspiliopoulos (2020), "An introduction to sequential Monte Carlo", chapter 10.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, ClassVar, Literal

import numpy as np

from mstfilter.base.errors import InputError, check_integer, place_in_user_file
from mstfilter.base.fields import NonNegativeInt, PositiveInt
from mstfilter.base.lazy import progress_of
from mstfilter.base.processes import together
from mstfilter.smc.components import EssBelow
from mstfilter.smc.first_steps import Examined, recorded
from mstfilter.smc.inputs import AtStep, check_observations, same_component, split_input, usual_slip
from mstfilter.smc.interfaces import (
    Component,
    Info,
    Infos,
    Lookahead,
    Proposal,
    Rejuvenation,
    Resampler,
    State,
    Transition,
    Trigger,
    Update,
)
from mstfilter.smc.population import Population, digest_of, identity
from mstfilter.smc.resampling import Systematic
from mstfilter.smc.streams import Key

_SLOTS = ("initial", "transition", "proposal", "update", "resampler", "trigger", "lookahead", "rejuvenation")
_WITHOUT_STEP = ("resampler", "trigger")  # they see the population only
#: For components that draw no random numbers. Saves the time to make a stream.
_UNUSED = Key(0).child("unused").generator()


@dataclass(frozen=True)
class ParticleFilter(AtStep):
    """A particle filter made of components.

    Parameters
    ----------
    initial : Proposal
        Draws the particles of the first step. The first observation updates the initial particles. The second step
        makes the first prediction. If `initial` is None or equals `proposal`, step 0 has only proposed particles.
    transition : Transition
        Moves the particles from the previous time to the present time. None leaves the particles unchanged.
    proposal : Proposal, optional
        Draws new particles from the observation at every step.
    update : Update
        Weights the particles by the observation. An update is not needed if the transition weights the particles.
    resampler : Resampler
        Selects particles by weight.
    trigger : Trigger
        Decides whether a step resamples. A population of more than `n` particles is resampled anyway,
        unless the resampler chooses their number (`Sized`).
    lookahead : Lookahead, optional
        Auxiliary filter: particles are selected by weight times priority. Requires ``resample="before"``.
    rejuvenation : Rejuvenation, optional
        Resample-move filter: moves the particles at the end of a step that resampled; with ``resample="after"`` at
        the end of every step. (There the trigger has seen the particles that would be moved. If it decided about
        the move, the evidence would be biased.)
    n : int
        Number of particles at the start and after each resampling. The resampler `Sized` chooses other numbers.
    n_proposed : int
        Number of particles that `proposal` draws at each step. If 0, `proposal` draws `n` particles.
    resample : {"after", "before"}
        With "after", particles are resampled after the update, as in MST. With "before", particles are resampled
        before the next prediction, as in textbooks, and the result of a step has the weights of its update.
    """

    initial: Proposal | None = None
    transition: Transition | None = None
    proposal: Proposal | None = None
    update: Update | None = None
    resampler: Resampler = Systematic()  # noqa: RUF009 (frozen)
    trigger: Trigger = EssBelow()  # noqa: RUF009 (frozen)
    lookahead: Lookahead | None = None
    rejuvenation: Rejuvenation | None = None
    n: PositiveInt = 100
    n_proposed: NonNegativeInt = 0
    resample: Literal["after", "before"] = "before"

    step_functions: ClassVar = {slot: None for slot in _SLOTS if slot not in _WITHOUT_STEP}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.initial is None and self.proposal is None:
            raise InputError("the filter has neither `initial` nor `proposal`: no particles to start from")
        if self.lookahead is not None and self.resample == "after":
            raise InputError(
                'a lookahead needs the next observation, which is not known yet if resample="after"',
                'use resample="before"',
            )

    def __repr__(self) -> str:
        parts = {slot: type(getattr(self, slot)).__name__ for slot in _SLOTS if getattr(self, slot) is not None}
        lines = [f"ParticleFilter(n={self.n}, n_proposed={self.n_proposed}, resample={self.resample!r})"]
        return "\n  ".join([*lines, ", ".join(f"{slot} {name[:24]}" for slot, name in parts.items())])

    @cached_property
    def properly_weighted(self) -> bool:
        """Whether all components are properly weighted and there is no `proposal`.

        The weights of proposed particles do not contain the evidence of earlier observations.
        """
        if self.proposal is not None:
            return False
        components = (getattr(self, slot) for slot in _SLOTS)
        return all(c.properly_weighted for c in components if isinstance(c, Component))

    @cached_property
    def starts_from_proposal(self) -> bool:
        """Whether the first step has only proposed particles."""
        return self.initial is None or same_component(self.initial, self.proposal)

    def start(self, seed: int | Key = 0, population: Population | None = None, t: int = 0) -> State:
        """The state before the first observation, or a state with given particles.

        Parameters
        ----------
        seed : int or Key
            The random numbers of the run.
        population : Population, optional
            Particles after t observations, such as a stored posterior: the next step moves them and updates them by
            observation t. Their log weights are kept, so the log evidence begins with the log of their mean weight.
            The random streams depend on `seed` and on the particles. So they are new ones even if a run with the same
            seed made the particles.
        t : int
            Number of observations before, for functions of the time.
        """
        key = seed if isinstance(seed, Key) else Key(seed)
        check_integer("t", t, at_least=0)
        if population is None:
            if t:
                raise InputError(
                    f"t is {t}, and there are no particles after {t} observations", "give population=..."
                )
            return State(0, None, key, self.properly_weighted)
        return State(t, population, key.child("given", digest_of(population)), self.properly_weighted)

    def step(self, state: State, observation: Any) -> tuple[State, Info]:
        """Process one observation. If the observation is None (missing), the proposal and the update are skipped.

        For an observation with an input u, pass ``WithInput(observation, u)``.

        Raises InputError if a component raises InputError. The message starts with the step and the component. The
        functions of a model are examined at the first two steps of a run (`mstfilter.smc.first_steps`).
        """
        return self._step(state, observation, Examined.of_run() if state.t < 2 else None)

    def _step(self, state: State, observation: Any, examined: Examined | None) -> tuple[State, Info]:
        step = _Step(self, state, observation, examined)
        past = step.before(state.population)
        predicted, proposed = step.extend(past)
        fused = step.update(predicted, proposed)
        chosen = step.after(fused, past)
        return step.finish(step.rejuvenate(chosen, past), fused, past)

    def iterate(self, observations: Iterable[Any], seed: int | State = 0) -> Iterator[tuple[State, Info]]:
        """Yield the `State` and the `Info` of every step.

        Parameters
        ----------
        observations : iterable
            For each step an observation, a `WithInput`, or None if the observation is missing.
        seed : int or State
            A seed, or the state to continue from.

        The functions of a model are examined until three observations have been seen (`mstfilter.smc.first_steps`).
        """
        keep_freed_memory()
        check_observations(observations)
        current = seed if isinstance(seed, State) else self.start(seed)
        examined, seen = Examined.of_run(), 0
        for observation in observations:
            current, info = self._step(current, observation, examined)
            if examined is not None:
                seen += split_input(observation)[0] is not None
                examined = None if seen == 3 else examined
            yield current, info

    def run(
        self,
        observations: Iterable[Any],
        seed: int | State = 0,
        *,
        progress: bool | Callable[[int, int | None], None] = False,
    ) -> tuple[State, Infos]:
        """Run all steps, and return the last `State` and the `Infos`. `seed` may be a state to continue from.

        ``progress=True`` shows a progress bar. A function `progress` is called as ``progress(done, total)``.

        To keep weights or particles of all steps, use `iterate`, or collectors (`mstfilter.smc.history`).
        """
        total = len(observations) if isinstance(observations, Sized) else None
        last, infos = seed if isinstance(seed, State) else self.start(seed), Infos()
        with progress_of(progress, "filter") as advance:
            advance(0, total)
            for state, info in self.iterate(observations, last):
                last = state
                infos.append(info)
                advance(len(infos), total)
        return last, infos


class _Step:
    """The calls of the components in one step. Their errors name step and slot; `Info` gets their times and notes."""

    def __init__(self, filter: ParticleFilter, state: State, observation: Any, examined: Examined | None) -> None:
        self.y, u = split_input(observation)
        self.filter, self.state, self.examined = filter.at_step(state.t, u), state, examined
        self.only_proposed = state.population is None and filter.starts_from_proposal
        self.resampled_before = self.resampled_after = False
        self.notes: dict[str, Mapping[str, Any]] = {}
        self.seconds: dict[str, float] = {}

    def slot(self, name: str) -> _Slot:
        return _Slot(name, self.state.t, self.seconds)

    def call(self, slot: str, method: str, *arguments: Any, n: int | None = None, stream: str = "") -> Population:
        """The population that a component returns, of size `n` if it is given."""
        component = getattr(self.filter, slot)
        make = partial(getattr(component, method), self.rng(stream or slot, component), *arguments)
        if self.examined is None:
            found = _checked(make(), component, n)
        else:
            with recorded():
                found = _checked(make(), component, n)
                self.examine(self.examined, slot, component, arguments[0], found)
        if found.notes:
            self.notes[slot] = found.notes
        return found

    def rng(self, stream: str, component: Component) -> np.random.Generator:
        """The random stream of a component in this step."""
        return self.state.key.child(stream, self.state.t).generator() if component.draws else _UNUSED

    def examine(self, examined: Examined, slot: str, component: Component, before: Any, after: Population) -> None:
        """Let a component examine the functions of its model, if this is one of the first steps of a run."""
        missing = self.y is None
        if type(component).examine is Component.examine or not examined.wants(slot, missing):
            return
        before = before if isinstance(before, Population) else None
        examined.note(slot, missing, component.examine(self.rng(slot, component), before, self.y, after))

    def before(self, previous: Population | None) -> Population | None:
        """The particles x_{t-1} to move, resampled if the filter does so before the prediction."""
        if previous is None or self.filter.resample == "after":
            return previous
        priority = self.priority(previous)
        population = previous if priority is None else previous.reweighted(priority)
        with self.slot("resampler"):
            if not self.filter.trigger.wants(population, self.state.t):
                return previous
            self.resampled_before = True
            past = self.resample(population.labelled({}), "resampler")
            if priority is None:
                return past
            ancestors = past.parents["ancestor"]
            if (ancestors < 0).any():
                raise InputError("a lookahead needs a resampler that reports ancestors")
            return past.reweighted(-priority[ancestors])

    def priority(self, previous: Population) -> np.ndarray | None:
        """(n,) log priorities of the particles for the selection; None if there is no lookahead or observation."""
        lookahead = self.filter.lookahead
        if lookahead is None or self.y is None:
            return None
        with self.slot("lookahead"):
            priority = _priority(lookahead, previous, self.y)
            if self.examined is not None:
                self.examine(self.examined, "lookahead", lookahead, previous, previous)
        return priority

    def resample(self, population: Population, stream: str) -> Population:
        """Resampled particles. The ancestors are -1 if the resampler does not report ancestors."""
        selected = self.call("resampler", "resample", population, self.filter.n, stream=stream)
        if "ancestor" in selected.parents:
            return selected
        return selected.with_ancestors(np.full(len(selected), -1))

    def extend(self, past: Population | None) -> tuple[Population | None, Population | None]:
        """The predicted and the proposed particles, which are independent given the observation."""
        if self.filter.proposal is None:
            return self.predict(past), None
        found = together(lambda: self.predict(past), self.propose)
        for slot in ("transition", "proposal"):  # in this order, whichever is complete first
            if slot in self.notes:
                self.notes[slot] = self.notes.pop(slot)
        return found

    def predict(self, past: Population | None) -> Population | None:
        """The moved particles; at the first step the initial ones, or None if the filter starts from its proposal."""
        if past is None:
            if self.only_proposed:
                return None
            with self.slot("initial"):
                return self.call("initial", "sample", self.y, self.filter.n, n=self.filter.n)
        stayed = {"previous": identity(len(past))}
        population = past.realised()
        if self.filter.transition is None:
            return population.labelled(stayed)
        given = stayed | {"ancestor": past.parents["ancestor"]} if "ancestor" in past.parents else stayed
        with self.slot("transition"):
            moved = self.call("transition", "predict", population.labelled(given), self.y)
        parents = {name: index for name, index in moved.parents.items() if name != "ancestor"}
        if len(moved) == len(population):
            parents.setdefault("previous", stayed["previous"])
        return moved.labelled(parents, moved.notes)

    def propose(self) -> Population | None:
        """Particles drawn from the observation; None if the observation is missing."""
        if self.y is None and not self.only_proposed:
            return None
        with self.slot("proposal"):
            if self.y is None:
                raise InputError("the first observation is missing and the filter starts from its proposal")
            proposed = self.call("proposal", "sample", self.y, self.filter.n_proposed or self.filter.n)
        return proposed.labelled({"proposed": identity(len(proposed))}, proposed.notes)

    def update(self, predicted: Population | None, proposed: Population | None) -> Population:
        """The particles after the update."""
        if self.y is not None and self.filter.update is not None:
            with self.slot("update"):
                return self.call("update", "update", predicted, proposed, self.y)
        unchanged = predicted if predicted is not None else proposed
        assert unchanged is not None
        return unchanged

    def after(self, fused: Population, past: Population | None) -> Population:
        """The particles to keep: all, or resampled ones if there are too many or if the filter does so at the end."""
        filter, after, most = self.filter, self.filter.resample == "after", self.filter.n
        if filter.resampler.chooses_n and past is not None:
            most = max(most, len(past))
        if len(fused) <= most and not after:
            return fused
        with self.slot("resampler"):
            if len(fused) <= most and not filter.trigger.wants(fused, self.state.t):
                return fused
            self.resampled_after = True
            # A step that resamples before the prediction may resample a second time, so it needs another stream.
            return self.resample(fused.labelled(fused.parents), "resampler" if after else "second resampler")

    def rejuvenate(self, chosen: Population, past: Population | None) -> Population:
        """Move the particles, after a resampling. The parents of particles do not change."""
        wanted = self.resampled_before or self.resampled_after or self.filter.resample == "after"
        if self.filter.rejuvenation is None or not wanted:
            return chosen
        with self.slot("rejuvenation"):
            population, previous = chosen.realised().labelled(chosen.parents), None
            if past is not None:
                index = population.parents.get("previous")
                if index is None or (index < 0).any():
                    raise InputError("rejuvenation needs a parent for every particle, and some have none")
                previous = past if index is identity(len(past)) else past.take(index)
            moved = self.call("rejuvenation", "move", population, previous, self.y, n=len(population))
        return moved.labelled(population.parents)

    def finish(self, chosen: Population, fused: Population, past: Population | None) -> tuple[State, Info]:
        """The next `State` and the `Info` of the step."""
        t, key = self.state.t, self.state.key
        ess = fused.ess  # stored in the population, where the trigger of the next step reads it
        with self.slot("build"):
            population = chosen.realised()
        population = population.traced_through(past if self.resampled_before else None)
        resampled = self.resampled_before or self.resampled_after
        info = Info(t, len(population), len(fused), ess, resampled, self.notes, self.seconds)
        return State(t + 1, population, key, self.state.properly_weighted and self.filter.properly_weighted), info


class _Slot:
    """The block in which a component is called: measures wall time, and adds the step and the slot to errors."""

    def __init__(self, name: str, t: int, seconds: dict[str, float]) -> None:
        self.name, self.t, self.seconds = name, t, seconds

    def __enter__(self) -> None:
        self.began = time.perf_counter()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        self.seconds[self.name] = self.seconds.get(self.name, 0.0) + time.perf_counter() - self.began
        if error is None:
            return
        where = f"step {self.t}, {self.name}"
        if isinstance(error, InputError):
            raise error.with_message(f"{where}: {error.message}") from error
        slip = usual_slip(error) if isinstance(error, TypeError | ValueError | AttributeError) else None
        place = place_in_user_file(error) if slip else None
        if slip and place:
            fact, *hints = slip
            raise InputError(f"{where}: {fact} ({place}): {type(error).__name__}: {error}", *hints) from error
        if isinstance(error, Exception):
            error.add_note(f"in {where}")


def _checked(found: Any, component: Component, n: int | None) -> Population:
    if not isinstance(found, Population):
        raise InputError(
            f"{type(component).__name__} returned {type(found).__name__}, expected a Population",
            "does every branch of the method return it?",
        )
    if n is not None and len(found) != n:
        raise InputError(f"asked for {n} particles it returned {len(found)}")
    return found


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


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Make glibc keep freed memory, by freeing one large block once per process.

    After the call, glibc keeps freed arrays of up to 32 MB. Returning the memory would take a fifth of the time of a
    filter of 10,000 particles. Other C libraries are not affected.
    """
    np.empty((1 << 25) - 8192, np.uint8)
