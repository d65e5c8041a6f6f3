"""Filters from a program: bootstrap, guided, auxiliary and resample-move."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fields import NonNegativeFloat, PositiveFloat, PositiveInt
from mstfilter.smc.distributions import Normal, hypothetical
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inputs import AtStep
from mstfilter.smc.interfaces import Component, Lookahead, Proposal, Rejuvenation, Transition
from mstfilter.smc.population import Particles, Population
from mstfilter.smc.programs.guard import Schedule
from mstfilter.smc.programs.handlers import (
    CentreHandler,
    GuideHandler,
    ReplayHandler,
    SampleHandler,
    ScoreHandler,
    Site,
    SiteHandler,
)
from mstfilter.smc.programs.sites import PerParticle, ProgramRun, Trace, active_run
from mstfilter.smc.state_space import choose_rows, moved
from mstfilter.smc.streams import RunGenerators, child

Model = Callable[..., Any]
_Scored = tuple[ProgramRun, list[Site]]
_HERE = str(Path(__file__).parent)


@dataclass(frozen=True)
class Program:
    """A model given as a function, and its filters with `n` particles.

    ``model(previous, observation)`` calls `sample` and `observe`, and returns None or a mapping of further values to
    keep. If the model or guide also has a parameter ``t``, it gets the index of the step. A parameter ``u`` gets the
    input of `WithInput`. The methods accept other fields of `ParticleFilter` by name, such as ``resampler``.
    """

    model: Model

    def __post_init__(self) -> None:
        if not callable(self.model):
            raise InputError(
                f"model is {self.model!r}, expected a function of the previous state and the observation"
            )

    def bootstrap(self, n: int, **components: Any) -> ParticleFilter:
        """Bootstrap filter, which draws from the model and weights by the observations."""
        return self._filter(None, n, components)

    def guided(self, guide: Model, n: int, **components: Any) -> ParticleFilter:
        """Guided filter, which draws from the guide.

        The guide is a program that draws every site of the model, by name, given the observation. If the observation
        is missing, particles are drawn from the model.
        """
        return self._filter(guide, n, components)

    def auxiliary(self, n: int, guide: Model | None = None, power: float = 1.0, **components: Any) -> ParticleFilter:
        """Auxiliary filter with an automatic lookahead, exact for every model; see `ProgramLookahead`."""
        return replace(self._filter(guide, n, components), lookahead=ProgramLookahead(self.model, power))

    def resample_move(
        self, n: int, steps: int = 1, scale: float = 0.5, guide: Model | None = None, **components: Any
    ) -> ParticleFilter:
        """Resample-move filter; see `ProgramMove`."""
        return replace(self._filter(guide, n, components), rejuvenation=ProgramMove(self.model, scale, steps))

    def _filter(self, guide: Model | None, n: int, components: dict[str, Any]) -> ParticleFilter:
        initial, transition = ProgramInitial(self.model, guide), ProgramTransition(self.model, guide)
        return ParticleFilter(initial=initial, transition=transition, n=n, **components)


class _OfProgram(AtStep):
    """A component with a model, and optionally a guide, that may depend on the step."""

    @property
    def step_functions(self) -> Mapping[str, int | None]:  # type: ignore[override]
        functions = {name: value for name, value in vars(self).items() if name in ("model", "guide")}
        return {name: None if isinstance(value, PerParticle) else 2 for name, value in functions.items()}


@dataclass(frozen=True)
class _ProgramStep(_OfProgram, Component):
    """A step of a program. Draws values, from the guide if there is one, and weights them."""

    model: Model
    guide: Model | None = None

    @property
    def batched(self) -> bool | None:
        return False if isinstance(self.model, PerParticle) else None

    @cached_property
    def schedule(self) -> Schedule:
        """The steps that are checked."""
        return Schedule.of(self.model, self.guide)

    def _advance(self, rng: np.random.Generator, past: Population | None, observation: Any, n: int) -> Population:
        """The population after a step."""
        model, guide = self.model, None if observation is None else self.guide
        previous = None if past is None else past.particles
        # A batch compares some of its runs with single runs, which are guarded.
        in_batch = isinstance(rng, RunGenerators)
        guard = None if in_batch else self.schedule.guard(rng, past, observation, model, guide)

        def step() -> tuple[Particles, np.ndarray]:
            return _step(rng, model, guide, previous, observation, n)

        try:
            particles, gain = step() if guard is None else guard.checked(_run_once, step)
        except Exception:
            if guard is not None:
                self.schedule.clear()  # the next run is checked again
            raise
        try:
            return Population(particles, gain) if past is None else past.moved(particles).reweighted(gain)
        except InputError:
            if np.isnan(gain).any() and not isinstance(model, PerParticle):  # name the site
                run_program(model, ScoreHandler(particles, strict=True), previous, observation, n)
            raise


@dataclass(frozen=True)
class ProgramInitial(_ProgramStep, Proposal):
    """First step of a program. Draws values, from the guide if there is one, and weights them."""

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        return self._advance(rng, None, observation, n)


@dataclass(frozen=True)
class ProgramTransition(_ProgramStep, Transition):
    """A step of a program. Draws values, from the guide if there is one, and weights them."""

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        return self._advance(rng, population, observation, len(population))


def _step(
    rng: np.random.Generator, model: Model, guide: Model | None, previous: Particles | None, observation: Any, n: int
) -> tuple[Particles, np.ndarray]:
    """Particles, drawn from the guide if there is one, and the changes of the log weights."""
    if guide is None:
        return run_program(model, SampleHandler(rng), previous, observation, n)
    if isinstance(guide, PerParticle) != isinstance(model, PerParticle):
        raise InputError("model and guide must both be per_particle, or neither")
    proposed = GuideHandler(rng, n)
    run_program(guide, proposed, previous, observation, n)
    return run_program(model, ReplayHandler(proposed), previous, observation, n)


@dataclass(frozen=True)
class ProgramLookahead(_OfProgram, Lookahead):
    """Priority from a run with the mean (or the mode of a discrete site) instead of each draw.

    The priority is raised to `power`. Use a value below 1 if the priority is too concentrated.
    """

    model: Model
    power: NonNegativeFloat = 1.0

    def log_priority(self, population: Population, observation: Any) -> np.ndarray:
        """(n,) log probability of the observation, bounded from below."""
        with hypothetical():
            _, priority = run_program(self.model, CentreHandler(), population.particles, observation, len(population))
        # An observation that is impossible at the mean may be possible for a draw: at most 50 below the best.
        top = priority.max()
        if not np.isfinite(top):
            return np.zeros(len(priority))
        return self.power * np.maximum(np.nan_to_num(priority, nan=-np.inf), top - 50.0)


@dataclass(frozen=True)
class ProgramMove(_OfProgram, Rejuvenation):
    """Metropolis-Hastings on all sites of a step at once.

    Continuous sites take a Gaussian step of `scale` standard deviations of the site's distribution. Discrete sites
    are drawn from their distribution. Both distributions depend on earlier sites, so the reverse density takes a
    second run at the proposed values. The branches of `switch` do not change. ``notes["accepted"]`` is the acceptance
    rate.

    Parameters
    ----------
    scale : float
        Standard deviation of a step relative to that of the site.
    steps : int
        Number of steps per move.
    """

    model: Model
    scale: PositiveFloat = 0.5
    steps: PositiveInt = 1

    def move(
        self, rng: np.random.Generator, population: Population, previous: Population | None, observation: Any
    ) -> Population:
        past, n = None if previous is None else previous.particles, len(population)
        particles: Particles
        if not isinstance(self.model, PerParticle):
            particles, accepted = self._moved(rng, self.model, population.particles, past, observation, n, False)
        else:
            traces, rates = [], []
            for i, particle in enumerate(population.particles):
                stream, before = child(rng, "particle", i), None if past is None else past[i]
                new, rate = self._moved(stream, self.model.function, particle, before, observation, 1, True)
                traces.append(Trace(new))
                rates.append(rate)
            particles, accepted = tuple(traces), float(np.mean(rates))
        return Population(particles, population.log_weights, population.parents, {"accepted": accepted})

    def _moved(
        self, rng: np.random.Generator, function: Model, x: Any, previous: Any, observation: Any, n: int, single: bool
    ) -> tuple[Mapping[str, Any], float]:
        """Values after the steps, and the acceptance rate; `single` is for one particle without particle axis."""

        def score(values: Mapping[str, Any], no_axis: bool = False) -> _Scored:
            handler = ScoreHandler(values, no_axis)
            with hypothetical():
                return _run_once(function, handler, previous, observation, n, single), handler.sites

        def propose(rng: np.random.Generator, state: _Scored) -> tuple[_Scored, np.ndarray]:
            now, sites = state
            values = self._propose(rng, now.values, sites)
            try:
                new, new_sites = score(values)
            except InputError as error:
                if not single or not isinstance(error.__cause__, InputError | None):
                    raise
                return state, np.full(n, -np.inf)  # other sites are reached, which have no values
            if [s.name for s in new_sites] != [s.name for s in sites]:
                return state, np.full(n, -np.inf)
            forward = self._log_density(now.values, values, sites, n)
            backward = self._log_density(values, now.values, new_sites, n)
            with np.errstate(invalid="ignore"):
                return (new, new_sites), new.gain - now.gain + backward - forward

        def choose(accepted: np.ndarray, new: _Scored, old: _Scored) -> _Scored:
            if accepted.all() or not accepted.any():
                return new if accepted.any() else old
            return score(choose_rows(accepted, new[0].values, old[0].values))

        (now, _), rate = moved(rng, score(x, single), propose, self.steps, choose)
        return _values_of(now), rate

    def _propose(
        self, rng: np.random.Generator, x: Mapping[str, np.ndarray], sites: list[Site]
    ) -> dict[str, np.ndarray]:
        """New values of all sites."""
        values = {name: np.array(a) for name, a in x.items()}
        for site in sites:
            old = x[site.name][site.index]
            if site.branch:
                continue
            if site.distribution.discrete:
                new = site.distribution.sample(rng, len(old))
            else:
                new = old + self.scale * site.distribution.sd * rng.standard_normal(old.shape)
            values[site.name][site.index] = new
        return values

    def _log_density(
        self, old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray], sites: list[Site], n: int
    ) -> np.ndarray:
        """(n,) log density of proposing `new` at `old`, for the given sites."""
        total = np.zeros(n)
        for site in sites:
            if site.branch:
                continue
            if site.distribution.discrete:
                step = site.distribution
            else:
                with hypothetical():
                    step = Normal(old[site.name][site.index], self.scale * site.distribution.sd)
            total[site.index] += step.log_prob(new[site.name][site.index])
        return total


def run_program(
    model: Model, handler: SiteHandler, previous: Particles | None, observation: Any, n: int
) -> tuple[Particles, np.ndarray]:
    """Run a program, or its guide, over n particles. The handler determines the values of the sites.

    Returns
    -------
    particles : mapping of arrays (n, ...), or tuple of n `Trace`
        Values of the sites, and the values that the program returned.
    gain : (n,) float64
        Change of the log weights.
    """
    if not isinstance(model, PerParticle):
        run = _run_once(model, handler, previous, observation, n, False)
        return _values_of(run), run.gain
    runs = [
        _run_once(model.function, handler.row(i), None if previous is None else previous[i], observation, 1, True)
        for i in range(n)
    ]
    return tuple(Trace(_values_of(r)) for r in runs), np.concatenate([r.gain for r in runs])


def _run_once(
    function: Model,
    handler: SiteHandler,
    previous: Any,
    observation: Any,
    n: int,
    single: bool = False,
) -> ProgramRun:
    """One pass of a function. With `single`, the pass is without the particle axis."""
    run = ProgramRun(handler, n, single)
    run.function = function
    if isinstance(previous, dict):
        previous = MappingProxyType(previous)
    try:
        _call(function, run, previous, observation)
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
        explained = _explained(error, run, previous)
        if explained is error:
            raise
        raise explained from error
    handler.finish(run.values)
    return run


def _call(function: Model, run: ProgramRun, previous: Any, observation: Any) -> None:
    token = active_run.set(run)
    try:
        returned = function(previous, observation)
    finally:
        active_run.reset(token)
    run.returned = _returned(returned, run)


#: Parts of messages of numpy and Python, what the program did, and what to write instead.
_RAW_ERRORS = {
    "truth value of an array": (
        "the program decides by an array that holds all particles (if, and, or, while)",
        "use switch(name, probs, branches), numpy.where, or mark the program with @per_particle",
    ),
    "scalar": (
        "the program uses an array that holds all particles as one number (float, int, range, math, list index)",
        "use numpy (numpy.exp, x.astype(int), an array as table), or mark the program with @per_particle",
    ),
    "unhashable": (
        "the program uses an array that holds all particles as a key",
        "use an array as table, table[x], or mark the program with @per_particle",
    ),
    "read-only": (
        "the program changes an array of particles in place",
        "write x = x + 1 for x += 1 and numpy.where for x[i] = ..., and return the result under another name",
    ),
    "NoneType": (
        "the program uses None",
        "previous is None at the first step, and a missing observation is None: test `is None`",
    ),
    "zero-size array": (
        "the program reduces an array without entries",
        "a branch of switch is also called when no particle reaches it",
    ),
    "broadcast": (
        "the program combines arrays that do not fit together",
        "the first axis is that of the particles: write x[:, None] to combine (n,) with (n, d)",
    ),
}


def _explained(error: Exception, run: ProgramRun, previous: Any) -> Exception:
    """The error of a program with its place and a hint. Only errors of Python, numpy or scipy are changed."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(_HERE)]
    place = run.what if run.inside else f"after {run.what}" if run.what else "before its first site"
    if frames:
        own = [frame for frame in frames if frame.filename == frames[0].filename][-1]
        place += f", line {own.lineno}" + f" `{own.line}`" * bool(own.line)
    if isinstance(error, InputError):
        if run.inside:
            return type(error)(f"{run.what}: {error.message}", *error.hints)
        return type(error)(f"{error.message} ({place})", *error.hints) if frames else error
    if type(error).__module__.split(".")[0] not in ("builtins", "numpy", "scipy"):
        return error
    if isinstance(error, KeyError) and isinstance(previous, Mapping) and error.args and error.args[0] not in previous:
        return InputError(
            f"previous has no {error.args[0]!r} ({place})",
            f"it has {sorted(previous)}, the sites and returned values of the step before",
            *(["previous.get(name) is for sites that not all particles reach"] if run.single else []),
        )
    fact, *hints = next((_RAW_ERRORS[part] for part in _RAW_ERRORS if part in str(error)), ("the program fails",))
    if run.single:
        fact, hints = "the program fails", []
    return InputError(f"{fact} ({place}): {type(error).__name__}: {error}".replace("\n", " "), *hints)


def _returned(returned: Any, run: ProgramRun) -> dict[str, Any]:
    """Check the values that a program returned: one row per particle, or any value of a single particle."""
    if returned is None:
        return {}
    if not isinstance(returned, Mapping):
        raise InputError(
            f"a program returned a {type(returned).__qualname__}, expected None or a mapping of values to keep"
        )
    out = {}
    for name, value in returned.items():
        if name in ("log_weight", "log_weights"):
            raise InputError(f"a program returned {name!r}, which does not weight the particles", "use observe")
        if not run.single:
            value = np.asarray(value)
            if value.flags.writeable:
                value = np.array(value)  # the program may write to its array in the next step
            if value.ndim == 0 or len(value) != run.n:
                raise InputError(
                    f"a program returned {name!r} of shape {value.shape}, expected one row per particle ({run.n})"
                )
            run.returns(name, value)
        if name in run.values and not _equal(value, run.values[name][0] if run.single else run.values[name]):
            raise InputError(
                f"a program returned {name!r} with other values than site {name!r}",
                "return them under another name: densities and moves need the values of the site",
            )
        out[str(name)] = value
    return out


def _equal(a: Any, b: Any) -> bool:
    """Whether two arrays are equal, where NaN equals NaN."""
    a, b = np.asarray(a), np.asarray(b)
    return a is b or (a.shape == b.shape and bool(np.all((a == b) | ((a != a) & (b != b)))))


def _values_of(run: ProgramRun) -> dict[str, Any]:
    """The particle (or all particles) after a run: the values of the sites, and the returned values."""
    values = {name: a[0] for name, a in run.values.items()} if run.single else run.values
    particles = {**values, **run.returned}
    if not particles:
        raise InputError("the program sampled nothing and returned nothing: a particle would be empty")
    return particles
