"""Bootstrap and guided filters of a probabilistic program.

A run of a program over all particles draws x_t and weighs it, so it is both the transition and the update of a
filter. In a bootstrap filter the particles are drawn from the model, and their weights are multiplied by the density
of the observed values. In a guided filter, the guide g draws first, and the program runs again with its draws: the
weights are multiplied by the density of observed values times f(x_t | x_{t-1}) / g(x_t | x_{t-1}, y_t), site by site.

>>> from mstfilter.smc import Normal, Program, observe, sample
>>> def model(previous, y):
...     x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
...     observe("y", Normal(x, 0.1), y)
>>> def guide(previous, y):
...     sample("x", Normal(y, 0.15))
>>> states, ys = Program(model).simulate(20, seed=1)
>>> worst = [min(info.ess for info in filter.run(ys)[1])
...          for filter in (Program(model).bootstrap(200), Program(model).guided(guide, 200))]
>>> worst[1] > 5 * worst[0]
True

What the guide leaves out, the model draws; there f / g is 1.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.first_steps import recorded
from mstfilter.smc.inputs import usual_slip
from mstfilter.smc.interfaces import Component, Proposal, Transition
from mstfilter.smc.models.programs.examination import examine_program
from mstfilter.smc.models.programs.handlers import (
    GivenHandler,
    GuideHandler,
    ReplayHandler,
    SampleHandler,
    SimulateHandler,
    SiteHandler,
)
from mstfilter.smc.models.programs.sites import ProgramRun, active_run
from mstfilter.smc.models.simulation import simulate_steps
from mstfilter.smc.population import Particles, Population

Model = Callable[..., Any]
_HERE = str(Path(__file__).parent)


@dataclass(frozen=True)
class Program:
    """A model given as a function. The methods make filters of the model with `n` particles.

    ``model(previous, observation)`` calls `sample` and `observe`, and returns None or a mapping of further values to
    keep. A parameter ``t`` of a model or guide gets the index of the step, and a parameter ``u`` gets the input of
    `WithInput`. The methods accept other fields of `ParticleFilter` by name, such as ``resampler``.
    """

    model: Model

    def bootstrap(self, n: int, **components: Any) -> ParticleFilter:
        """Bootstrap filter, which draws from the model and weights by the observations."""
        return self._filter(None, n, components)

    def guided(self, guide: Model, n: int, **components: Any) -> ParticleFilter:
        """Guided filter, which draws from the guide and weights by the density ratio of model and guide.

        The guide is a program that samples names of the model, given the observation. Names that it leaves out are
        drawn from the model. If the observation is missing, all are.
        """
        return self._filter(guide, n, components)

    def simulate(self, n_steps: int, seed: int = 0, inputs: Iterable[Any] | None = None) -> tuple[Particles, Any]:
        """Draw values of all sites and observations at T steps, as `StateSpaceModel.simulate` does.

        The program gets the observation None, and each `observe` of a value None draws one. So with one `observe`, a
        step gives its value. If there are several, a step gives a mapping from their names to values. A program that
        reads entries of the observation, such as ``y["range"]`` or ``y[0]``, gives a mapping or a tuple with these
        entries, if each of them is observed once and in the order in which they are read.
        """

        def step(rng: np.random.Generator, t: int, u: Any, x: Any) -> tuple[Any, Any]:
            model, previous = ProgramInitial(self.model).at_step(t, u).model, x
            asked: Any = None
            try:
                handler = SimulateHandler(rng)
                run = run_once(model, handler, previous, None, 2)
            except InputError:
                handler, asked = SimulateHandler(rng), _Entries()
                run = run_once(model, handler, previous, asked, 2)
            return {**run.values, **run.returned}, _observation(handler.observed, asked)

        return simulate_steps(step, n_steps, seed, inputs)

    def _filter(self, guide: Model | None, n: int, components: dict[str, Any]) -> ParticleFilter:
        initial, transition = ProgramInitial(self.model, guide), ProgramTransition(self.model, guide)
        return ParticleFilter(initial=initial, transition=transition, n=n, **components)


class _Entries(dict[Any, None]):
    """An observation whose entries are all missing. It holds the keys that were read, in their order."""

    def __missing__(self, key: Any) -> None:
        self[key] = None


def _observation(observed: Mapping[str, Any], asked: _Entries | None) -> Any:
    """The observation of a step of a simulated program, of values in the order in which they were drawn."""
    values = list(observed.values())
    if not values:
        raise InputError(
            "the program observes nothing if its observation is None, so it cannot be simulated",
            "call observe with the value None where the observation is missing",
        )
    if asked is None:
        return values[0] if len(values) == 1 else dict(observed)
    if len(asked) != len(values):
        raise InputError(
            f"the program reads the entries {list(asked)} of the observation and observes {list(observed)}, so it "
            "cannot be simulated",
            "observe each entry once, or accept the observation None",
        )
    return tuple(values) if list(asked) == list(range(len(values))) else dict(zip(asked, values, strict=True))


@dataclass(frozen=True)
class _ProgramStep(Component):
    """A step of a program: draws values from the guide or the model, and weights the particles."""

    model: Model
    guide: Model | None = None

    alone: ClassVar[bool] = True
    step_functions: ClassVar = {"model": 2, "guide": 2}

    def _advance(self, rng: np.random.Generator, past: Population | None, observation: Any, n: int) -> Population:
        """The population after a step."""
        model, guide = self.model, None if observation is None else self.guide
        previous = None if past is None else past.particles
        particles, gain = program_step(rng, model, guide, previous, observation, n)
        try:
            return Population(particles, gain) if past is None else past.moved(particles).reweighted(gain)
        except InputError:
            if np.isnan(gain).any():
                with recorded():  # a recorded run names the site
                    run_program(model, GivenHandler(particles), previous, observation, n)
            raise

    def examine(
        self, rng: np.random.Generator, before: Population | None, observation: Any, after: Population
    ) -> bool:
        guide = None if observation is None else self.guide
        return examine_program(run_once, rng, self.model, guide, before, observation, after)


@dataclass(frozen=True)
class ProgramInitial(_ProgramStep, Proposal):
    """First step of a program. Draws values from the guide or the model, and weights the particles."""

    def sample(self, rng: np.random.Generator, observation: Any, n: int) -> Population:
        return self._advance(rng, None, observation, n)


@dataclass(frozen=True)
class ProgramTransition(_ProgramStep, Transition):
    """Later step of a program. Draws values from the guide or the model, and weights the particles."""

    def predict(self, rng: np.random.Generator, population: Population, observation: Any) -> Population:
        return self._advance(rng, population, observation, len(population))


def program_step(
    rng: np.random.Generator, model: Model, guide: Model | None, previous: Particles | None, observation: Any, n: int
) -> tuple[Particles, np.ndarray]:
    """Particles, drawn from the guide (if given) or the model, and the changes of the log weights."""
    if guide is None:
        return run_program(model, SampleHandler(rng), previous, observation, n)
    proposed = GuideHandler(rng, n)
    run_once(guide, proposed, previous, observation, n)
    return run_program(model, ReplayHandler(proposed, rng), previous, observation, n)


def run_program(
    model: Model, handler: SiteHandler, previous: Particles | None, observation: Any, n: int
) -> tuple[Particles, np.ndarray]:
    """Run a program, or its guide, over n particles. The handler determines the value of each `sample` call.

    Returns
    -------
    particles : mapping of arrays (n, ...)
        Values of the `sample` calls by name, and the values that the program returned.
    gain : (n,) float64
        Change of the log weights.
    """
    run = run_once(model, handler, previous, observation, n)
    particles = {**run.values, **run.returned}
    if not particles:
        raise InputError("the program sampled nothing and returned nothing: a particle would be empty")
    return particles, run.gain


def run_once(
    function: Model, handler: SiteHandler, previous: Particles | None, observation: Any, n: int
) -> ProgramRun:
    """Run the function of a program once."""
    run = ProgramRun(handler, n)
    run.function = function
    if isinstance(previous, dict):
        previous = MappingProxyType(previous)
    token = active_run.set(run)
    try:
        run.returned = _returned(function(previous, observation), run)
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
        explained = _explained(error, run, previous)
        if explained is error:
            raise
        raise explained from error
    finally:
        active_run.reset(token)
    handler.finish(run.values)
    return run


def _explained(error: Exception, run: ProgramRun, previous: Any) -> Exception:
    """The error of a program with the line that raised it and a hint. Errors of other libraries are unchanged."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(_HERE)]
    place = run.what if run.inside else f"after {run.what}" if run.what else "before its first site"
    if frames:
        own = [frame for frame in frames if frame.filename == frames[0].filename][-1]
        place += f", line {own.lineno}" + f" `{own.line}`" * bool(own.line)
    if isinstance(error, InputError):
        if run.inside:
            return error.with_message(f"{run.what}: {error.message}")
        return error.with_message(f"{error.message} ({place})") if frames else error
    if type(error).__module__.split(".")[0] not in ("builtins", "numpy", "scipy"):
        return error
    if isinstance(error, KeyError) and isinstance(previous, Mapping) and error.args and error.args[0] not in previous:
        return InputError(
            f"previous has no {error.args[0]!r} ({place})",
            f"it has {sorted(previous)}, the sites and returned values of the step before",
        )
    fact, *hints = usual_slip(error) or ("the program fails",)
    return InputError(f"{fact} ({place}): {type(error).__name__}: {error}".replace("\n", " "), *hints)


def _returned(returned: Any, run: ProgramRun) -> dict[str, Any]:
    """Check that the values returned by a program have one row per particle."""
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
        value = np.asarray(value)
        if value.flags.writeable:
            value = np.array(value)  # the program may write to its array in the next step
        if value.ndim == 0 or len(value) != run.n:
            raise InputError(
                f"a program returned {name!r} of shape {value.shape}, expected one row per particle ({run.n})"
            )
        if name in run.values and not _equal(value, run.values[name]):
            raise InputError(
                f"a program returned {name!r} with other values than site {name!r}",
                "return them under another name: densities and moves need the values of the site",
            )
        out[str(name)] = value
    return out


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays are equal, where NaN equals NaN."""
    return a is b or np.array_equal(a, b, equal_nan=a.dtype.kind in "fc" and b.dtype.kind in "fc")
