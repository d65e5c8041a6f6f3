"""Paths of states given all observations, drawn one at a time by conditional SMC.

A filter of n particles draws a path x_0 .. x_T that has nearly the law p(x_0 .. x_T | y_0 .. y_T), with a bias of
order 1 / n. Conditional SMC removes the bias: one of the particles must follow a given path, and the drawn path
replaces it. This is a Markov chain of paths whose law is exact for any n >= 2 (Andrieu, Doucet, Holenstein 2010):

>>> import numpy as np
>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap, conditional_path, path_log_prob
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> states, observations = model.simulate(20, seed=1)
>>> filter = bootstrap(model, n=10)
>>> paths = [conditional_path(filter, observations, seed=0)]               # from an ordinary filter
>>> for seed in range(1, 50):
...     paths.append(conditional_path(filter, observations, seed, paths[-1]))          # given the one before
>>> np.array(paths).shape
(50, 20)

Since all particles stem from few ancestors, the early states of the path would hardly change. Ancestor sampling
prevents this: the given path gets a new ancestor at each time, particle i with probability proportional to
w_i f(x_t | x_i) (Lindsten, Jordan, Schön 2014). It needs the density f of the transition:

>>> len({path[0] for path in paths}) > 10
True

`path_log_prob` is the joint log density of a path and the observations. Programs are supported too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, LostRunError, check_integer
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inputs import check_observations, same_component, split_input
from mstfilter.smc.interfaces import DensityTransition, Transition
from mstfilter.smc.models.programs.filters import ProgramInitial, ProgramTransition, run_once, run_program
from mstfilter.smc.models.programs.handlers import GivenHandler
from mstfilter.smc.models.state_space import Dynamics, Prior
from mstfilter.smc.population import Particles, Population, count_particles, take
from mstfilter.smc.resampling import Multinomial, draw_log
from mstfilter.smc.streams import Key

_FIRST = np.zeros(1, np.int64)  # the row of the particle that follows the given path


def conditional_path(
    filter: ParticleFilter, observations: Sequence[Any], seed: int | Key = 0, path: Particles | None = None
) -> Particles:
    """A path of states drawn by conditional SMC, a kernel that leaves p(x_0 .. x_T | y_0 .. y_T) invariant.

    This holds for any number of particles (Andrieu, Doucet, Holenstein 2010). One particle follows `path`, and the
    filter draws the other particles. The result is the path of one final particle, drawn by weight. Ancestors are
    drawn multinomially at every step; `resampler` and `trigger` of the filter are not used. If the density of the
    transition is known, the ancestors of the particle that follows the path are also drawn (ancestor sampling). A
    program that returns values is used without ancestor sampling.

    Parameters
    ----------
    filter : ParticleFilter
        Bootstrap or guided filter of a model or a program, with at least two particles. The update must not change
        the particles.
    path : T particles, optional
        The present path. Row t is the particle at time t. If `path` is None, an ordinary filter draws the path.

    Returns
    -------
    array (T, ...), mapping of arrays (T, ...), or tuple of T objects
    """
    _check_conditional(filter)
    ys = _observations(observations, path)
    key = seed if isinstance(seed, Key) else Key(seed)
    rng = key.child("ancestors").generator()
    populations: list[Population] = []
    parents: list[np.ndarray] = []
    past: Population | None = None
    for t, observation in enumerate(ys):
        y, u = split_input(observation)
        now = filter.at_step(t, u)
        given = None if path is None else take(path, np.array([t]))
        if past is not None:
            others, _ = Multinomial().select(rng, past.log_weights, filter.n - 1)
            index = np.append(_ancestor(rng, now.transition, past, given, y), others)
            parents.append(index)
            past = Population(take(past.particles, index))
        past = _moved(now, key.child("step", t), past, given, y)
        if now.update is not None and y is not None:
            update_rng = key.child("step", t, "update").generator() if now.update.draws else rng
            moved, past = past, now.update.update(update_rng, past, None, y)
            if not same_component(past.particles, moved.particles):  # the given particle would be updated again
                raise InputError(
                    f"step {t}: the update changes the particles, and conditional SMC needs one that only weights",
                    "use a model of the whole state in place of a Rao-Blackwellised filter",
                )
        populations.append(past)
    rows = [int(draw_log(rng, populations[-1].log_weights[None])[0])]
    for index in reversed(parents):
        rows.append(int(index[rows[-1]]))
    chosen = zip(populations, reversed(rows), strict=True)
    return _joined([take(p.realised().particles, np.array([row])) for p, row in chosen])


def _observations(observations: Sequence[Any], path: Particles | None) -> list[Any]:
    """The observations. Raises InputError if there are none, or if a path has another length."""
    ys = list(check_observations(observations))
    if not ys or (path is not None and count_particles(path) != len(ys)):
        states = "" if path is None else f" for a path of {count_particles(path)} states"
        raise InputError(f"there are {len(ys)} observations{states}")
    return ys


def _check_conditional(filter: ParticleFilter) -> None:
    for slot in ("proposal", "lookahead", "rejuvenation"):
        if getattr(filter, slot) is not None:
            raise InputError(
                f"conditional SMC does not know a filter with `{slot}`", "use a bootstrap or guided filter"
            )
    if not filter.properly_weighted:
        raise InputError("a component of the filter is not properly weighted: its paths have another law")
    check_integer("n", filter.n, "one particle follows the present path", at_least=2)


def _ancestor(
    rng: np.random.Generator, transition: Transition | None, past: Population, given: Particles | None, y: Any
) -> int:
    """Index of the parent of particle 0, which follows the given path."""
    if given is None:
        return int(draw_log(rng, past.log_weights[None])[0])
    density = _log_density(transition, past.particles, take(given, np.zeros(len(past), np.int64)), y)
    if density is None:
        return 0
    # Lindsten, Jordan, Schön (2014), equation 16.
    return int(draw_log(rng, (past.log_weights + density)[None])[0])


def _log_density(transition: Transition | None, old: Particles, new: Particles, y: Any) -> np.ndarray | None:
    """(n,) log f(new | old), plus log p(y | new, old) for programs; None if the density is not known."""
    if isinstance(transition, ProgramTransition):
        handler = GivenHandler(dict(new))
        particles, density = run_program(transition.model, handler, old, y, count_particles(old))
        # A value that the program returns is a function of the previous particle, and has no density.
        return density if handler.names == set(particles) else None
    if isinstance(transition, Dynamics):
        found = transition.model.log_transition
        return None if found is None else np.asarray(found(old, new), np.float64)
    if isinstance(transition, DensityTransition):
        return np.asarray(transition.log_prob(old, new, y), np.float64)
    return None


def _moved(
    filter: ParticleFilter, streams: Key, past: Population | None, given: Particles | None, y: Any
) -> Population:
    """The particles of a step before the update. Particle 0 is the given particle with the weight of its move."""
    component: Any
    slot, component = ("initial", filter.initial) if past is None else ("transition", filter.transition)
    rng, moved = streams.child(slot).generator(), past
    try:
        if past is None:
            moved = component.sample(rng, y, filter.n)
        elif component is not None:
            moved = component.predict(rng, past, y)
        assert moved is not None
        particles, log_weights = moved.particles, moved.log_weights
    except LostRunError:  # all particles have weight 0, but perhaps not the given one
        if given is None:
            raise
        particles, log_weights = take(given, np.zeros(filter.n, np.int64)), np.full(filter.n, -np.inf)
    if len(log_weights) != filter.n:
        raise InputError(
            f"{slot} made {len(log_weights)} particles of {filter.n}: conditional SMC needs one for each"
        )
    if given is None:
        return Population(particles, log_weights)
    log_weights = np.array(log_weights)
    old = None if past is None else take(past.particles, _FIRST)
    if isinstance(component, ProgramInitial | ProgramTransition):
        given, log_weights[0] = _given_to_program(component, old, given, y)
    elif isinstance(component, Prior):
        log_weights[0] = component.log_weight(given, y)[0]
    elif isinstance(component, Dynamics):
        log_weights[0] = component.log_weight(old, given, y)[0]
    elif log_weights.any():
        raise InputError(
            f"{slot} is a {type(component).__name__} that weights its particles, so the weight of a given "
            "particle is not known",
            "use Prior, Dynamics or a Program",
        )
    return Population(_with_first(particles, given), log_weights)


def _given_to_program(component: Any, old: Particles | None, given: Particles, y: Any) -> tuple[Particles, float]:
    """The given particle (one row), with the values that the program returns, and the log weight of the particle."""
    if component.guide is None or y is None:
        particle, gain = run_program(component.model, GivenHandler(given, weigh=False), old, y, 1)
        return particle, gain[0]
    guide = GivenHandler(given)
    log_q = run_once(component.guide, guide, old, y, 1).gain
    particle, log_p = run_program(component.model, GivenHandler(given, weigh=guide.reached), old, y, 1)
    return particle, log_p[0] - log_q[0]


def _with_first(particles: Particles, first: Particles) -> Particles:
    """The particles, with particle 0 replaced by `first`."""
    if isinstance(particles, Mapping):
        return {name: _with_first(a, first[name]) for name, a in particles.items()}
    if not isinstance(particles, np.ndarray):
        return (first[0], *tuple(particles)[1:])
    particles = np.array(particles)
    particles[0] = first[0]
    return particles


def _joined(rows: list[Particles]) -> Particles:
    """Join one particle per time to a path. Variables that do not exist at a time are NaN, or 0 for integers."""
    if isinstance(rows[0], np.ndarray):
        return np.concatenate(rows)
    if not isinstance(rows[0], Mapping):
        return tuple(row[0] for row in rows)
    examples = {name: a for row in rows for name, a in row.items()}
    blank = {name: np.full_like(a, np.nan if a.dtype.kind == "f" else 0) for name, a in examples.items()}
    return {name: np.concatenate([row.get(name, blank[name]) for row in rows]) for name in examples}


def path_log_prob(filter: ParticleFilter, observations: Sequence[Any], path: Particles) -> float:
    """log p(x_0 .. x_T, y_0 .. y_T) of a path, computed by the model or the program of a filter.

    The filter must be made from a `Program`, or from a `StateSpaceModel` that has log densities. Raises InputError if
    the path does not have one state per observation.
    """
    total, previous = 0.0, None
    for t, observation in enumerate(_observations(observations, path)):
        y, u = split_input(observation)
        row = take(path, np.array([t]))
        total += _step_log_prob(filter.at_step(t, u), previous, row, y)
        previous = row
    return total


def _step_log_prob(filter: ParticleFilter, previous: Particles | None, row: Particles, y: Any) -> float:
    """log p(x_t, y_t | x_{t-1}) of one particle, computed by the components of the filter."""
    component = filter.initial if previous is None else filter.transition
    if isinstance(component, ProgramInitial | ProgramTransition):
        _, gain = run_program(component.model, GivenHandler(row), previous, y, 1)
        return float(gain[0])
    if not isinstance(component, Prior | Dynamics):
        raise InputError("the filter is not made from a StateSpaceModel or a Program: its densities are not known")
    model = component.model
    density = model.density("log_initial" if previous is None else "log_transition")
    found = density(row) if previous is None else density(previous, row)
    return float(found[0]) + (0.0 if y is None else float(model.log_likelihood(row, y)[0]))
