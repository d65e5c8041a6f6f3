"""Smoothing: the states given all observations, from the populations of a filter.

>>> record = keep(bootstrap(model, n=500), observations, seed=0)
>>> paths = backward_paths(np.random.default_rng(1), record, Dynamics(model), n=200)
>>> [population.weights @ population.particles for population in paths]        # E[x_t | y_0 .. y_T], t = 0 .. T

Three smoothers of a record return a tuple with one population per time:

- `genealogy` follows the ancestors of the last particles (Kitagawa 1996). It needs only the record; after many
  resamplings all paths share their beginning.
- `fixed_lag` follows the ancestors of the particles `lag` steps later (Kitagawa and Sato 2001): more distinct
  particles, and a bias if the state depends on observations more than `lag` steps later.
- `backward_paths` draws paths backwards by the density of the transition (Godsill, Doucet, West 2004, FFBSi), without
  path degeneracy. A step takes N densities per path, or a few with ``method="mcmc"`` or ``"rejection"``.

They are valid for any filter with proper weights: guided, auxiliary, with moves, resampled before or after.

`paris` yields smoothed means of sums over the path while observations arrive, in constant memory.

`conditional_path` draws one path by a Markov kernel that leaves the smoothing distribution invariant, for any number
of particles and also for programs (conditional SMC; Andrieu, Doucet, Holenstein 2010). `path_log_prob` is the joint
log density of a path and the observations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from mstfilter.errors import InputError, check_choice, check_component, check_integer, check_number
from mstfilter.smc.distributions import as_distribution
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.inputs import check_observations, split_input
from mstfilter.smc.interfaces import DensityTransition, State, Transition
from mstfilter.smc.population import Particles, Population, count_particles, take
from mstfilter.smc.programs.filters import ProgramInitial, ProgramTransition, run_program
from mstfilter.smc.programs.handlers import GuideHandler, ReplayHandler, SampleHandler, ScoreHandler, Site
from mstfilter.smc.programs.sites import PerParticle
from mstfilter.smc.resampling import Multinomial, independent_draws
from mstfilter.smc.state_space import Dynamics, GuidedInitial, GuidedTransition, Prior
from mstfilter.smc.streams import Key, child

BackwardMethod = Literal["exact", "mcmc", "rejection"]
#: Pairs of particles per call of `log_prob`.
_PAIRS = 1_000_000


@dataclass(frozen=True, eq=False)
class Record:
    """The populations of a run, with the observations."""

    #: After each observation; ``parents["previous"]`` are indices into the one before.
    populations: tuple[Population, ...]
    observations: tuple[Any, ...]  #: none if missing

    def __len__(self) -> int:
        return len(self.populations)

    def parents(self, t: int) -> np.ndarray:
        """(n,) indices into population t - 1 of the particles at time t."""
        return known_parents(self.populations[t], t)


def known_parents(population: Population, t: int) -> np.ndarray:
    """(n,) indices into the population before; InputError if a particle has no known parent."""
    index = population.parents.get("previous")
    if index is None or (index < 0).any():
        raise InputError(
            f"step {t}: {'no' if index is None else 'not every'} particle has a known parent",
            "a filter with a proposal of new particles has no paths",
        )
    return index


def keep(filter: ParticleFilter, observations: Iterable[Any], seed: int | State = 0) -> Record:
    """Run a filter and keep every population; memory grows with n times the number of steps."""
    ys = tuple(check_observations(observations))
    if not ys:
        raise InputError("there are no observations to smooth over")
    populations = []
    for state, _ in filter.iterate(ys, seed):
        assert state.population is not None
        populations.append(state.population)
    return Record(tuple(populations), ys)


def genealogy(record: Record) -> tuple[Population, ...]:
    """Paths of the last particles: row k of all populations is one path, weighted by the last particle."""
    return _traced(record, len(record) - 1, 0)


def fixed_lag(record: Record, lag: int) -> tuple[Population, ...]:
    """At each time t the ancestors of the particles at t + `lag` (or the end), with their weights.

    A lag of 0 steps returns the filter's populations.
    """
    check_integer("lag", lag, at_least=0)
    last = len(record) - 1
    return tuple(_traced(record, min(t + lag, last), t)[0] for t in range(len(record)))


def _traced(record: Record, end: int, begin: int) -> tuple[Population, ...]:
    """Ancestors from `begin` to `end` of the particles at `end`."""
    weights = record.populations[end].log_weights
    index = np.arange(len(weights))
    path = []
    for t in range(end, begin - 1, -1):
        path.append(Population(take(record.populations[t].realised().particles, index), weights))
        if t > begin:
            index = record.parents(t)[index]
    return tuple(reversed(path))


def backward_paths(
    rng: np.random.Generator,
    record: Record,
    transition: DensityTransition,
    n: int,
    method: BackwardMethod = "exact",
    *,
    steps: int = 1,
    log_bound: float | None = None,
) -> tuple[Population, ...]:
    """Draw `n` equally weighted paths from the smoothing distribution: row k of all populations is a path.

    The predecessor of a state x_{t+1} is particle i at time t with probability proportional to w_i f(x_{t+1} | x_i).

    Parameters
    ----------
    transition : DensityTransition
        That of the model, ``Dynamics(model)``. A guided transition cannot be used: its density is that of its
        proposal.
    method : "exact", "mcmc" or "rejection"
        "exact" (Godsill, Doucet, West 2004) evaluates the densities of all N particles for each path: n N per step.

        "rejection" (Douc, Garivier, Moulines, Olsson 2011) draws particles by weight and accepts them with
        probability f / max f. The law is that of "exact". A path that has accepted none of N particles is drawn as by
        "exact" (Dau and Chopin 2023), so a step takes at most about 2 n N densities; on average n times the mean of
        max f / p(x_{t+1} | y_0 .. y_t).

        "mcmc" (Bunch and Godsill 2013) starts at the parent of x_{t+1} in the record and makes independent Metropolis
        steps, which leave the law of "exact" invariant: (1 + `steps`) n densities. It needs a record with parents.
        The steps need not converge: a parent has the law of "exact" already, given x_{t+1}, after independent
        selections of a bootstrap filter, and up to order 1 / N after others, so there is no further bias
        (Dau and Chopin 2023). Steps reduce the variance: without accepted steps, paths are those of `genealogy`.
    steps : int
        Metropolis steps of "mcmc".
    log_bound : float
        For "rejection": an upper bound of ``transition.log_prob``. InputError if a density exceeds it.
    """
    check_component("transition", transition, DensityTransition)
    check_integer("n", n)
    kernel = _Backward(method, steps, log_bound)
    last = record.populations[-1].realised()
    index = _by_weight(rng, last, n)
    path = [Population(take(last.particles, index))]
    for t in range(len(record) - 2, -1, -1):
        population, (y, u) = record.populations[t].realised(), split_input(record.observations[t + 1])
        parents = record.parents(t + 1)[index] if method == "mcmc" else None
        move = _Move(population, path[-1].particles, transition.at_step(t + 1, u), y, t)
        index = kernel.draw(rng, move, parents, 1)[:, 0]
        path.append(Population(take(population.particles, index)))
    return tuple(reversed(path))


@dataclass(frozen=True)
class _Move:
    """All moves from a population at time t to n later particles."""

    population: Population
    later: Particles
    transition: DensityTransition
    y: Any
    t: int

    def log_density(self, index: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """(k,) log density of the moves from particles `index` to the later ones at `rows` (default: all)."""
        later = self.later if rows is None else take(self.later, rows)
        found = self.transition.log_prob(take(self.population.particles, index), later, self.y)
        density = np.asarray(found, dtype=np.float64)
        if density.shape != index.shape:
            raise InputError(f"log_prob returned shape {density.shape}, expected {index.shape}")
        if not (density < np.inf).all():
            raise _impossible(self.t)
        return density

    def exact(self, rng: np.random.Generator, rows: np.ndarray, n_draws: int) -> np.ndarray:
        """(k, n_draws) indices of predecessors of the later particles at `rows`."""
        m = len(self.population)
        index, block = np.empty((len(rows), n_draws), np.int64), max(1, _PAIRS // m)
        for begin in range(0, len(rows), block):
            some = rows[begin : begin + block]
            density = self.log_density(np.tile(np.arange(m), len(some)), np.repeat(some, m))
            log_weights = self.population.log_weights + density.reshape(-1, m)
            for k in range(n_draws):
                index[begin : begin + block, k] = _drawn(rng, log_weights, self.t)
        return index

    def metropolis(self, rng: np.random.Generator, parents: np.ndarray, steps: int, n_draws: int) -> np.ndarray:
        """(n, n_draws) states of chains that start at the parents, every `steps` steps."""
        index, density, draws = parents, self.log_density(parents), []
        if not (density > -np.inf).all():
            raise _impossible(self.t)
        for _ in range(n_draws):
            for _ in range(steps):
                new = _by_weight(rng, self.population, len(index))
                found = self.log_density(new)
                yes = found - density > -rng.standard_exponential(len(new))  # minus the log of a uniform
                index, density = np.where(yes, new, index), np.where(yes, found, density)
            draws.append(index)
        return np.stack(draws, axis=1)

    def rejected(self, rng: np.random.Generator, n: int, log_bound: float) -> np.ndarray:
        """(n,) indices of predecessors of the n later particles, by rejection."""
        index, left, trials = np.empty(n, np.int64), np.arange(n), 0
        while len(left) and trials < len(self.population):
            each = max(1, n // len(left))  # a round evaluates at most n densities
            new = _by_weight(rng, self.population, each * len(left)).reshape(len(left), each)
            density = self.log_density(new.ravel(), np.repeat(left, each))
            if density.max() > log_bound + 1e-9 * (1 + abs(log_bound)):
                raise InputError(
                    f"step {self.t}: the log density of a move is {density.max()}, more than log_bound = {log_bound}"
                )
            accepted = (density - log_bound > -rng.standard_exponential(len(density))).reshape(new.shape)
            first, some = accepted.argmax(axis=1), accepted.any(axis=1)
            index[left[some]] = new[some, first[some]]
            left, trials = left[~some], trials + each
        if len(left):
            index[left] = self.exact(rng, left, 1)[:, 0]
        return index


@dataclass(frozen=True)
class _Backward:
    """Draws predecessors of later particles; the fields are arguments of `backward_paths`."""

    method: BackwardMethod
    steps: int
    log_bound: float | None

    def __post_init__(self) -> None:
        check_choice("method", self.method, get_args(BackwardMethod))
        check_integer("steps", self.steps)
        if self.method == "rejection":
            check_number("log_bound", self.log_bound)

    def draw(self, rng: np.random.Generator, move: _Move, parents: np.ndarray | None, n_draws: int) -> np.ndarray:
        """(n, n_draws) indices; `parents` (n,) of the later particles are for "mcmc"."""
        if parents is not None:
            return move.metropolis(rng, parents, self.steps, n_draws)
        n = count_particles(move.later)
        if self.log_bound is not None and self.method == "rejection":
            return np.stack([move.rejected(rng, n, self.log_bound) for _ in range(n_draws)], axis=1)
        return move.exact(rng, np.arange(n), n_draws)


def paris(
    filter: ParticleFilter,
    observations: Iterable[Any],
    functional: Callable[[int, Particles | None, Particles], np.ndarray],
    transition: DensityTransition,
    seed: int = 0,
    n_draws: int = 2,
    method: BackwardMethod = "exact",
    *,
    steps: int = 1,
    log_bound: float | None = None,
) -> Iterator[np.ndarray]:
    """Smoothed means of an additive functional, online (PaRIS; Olsson and Westerborn 2017, algorithm 2).

    After each observation it yields E[h_0(x_0) + h_1(x_0, x_1) + .. + h_t(x_{t-1}, x_t) | y_0 .. y_t]. Only the last
    population is kept, with one statistic per particle: the mean over `n_draws` predecessors drawn backwards. A step
    takes n^2 densities, with "mcmc" (1 + `steps` `n_draws`) n.

    Parameters
    ----------
    filter : ParticleFilter
        With proper weights.
    functional : callable
        ``(t, previous, particles) -> (n,) or (n, k)`` is h_t of paired rows; `previous` is None at t = 0.
    transition : DensityTransition
        The transition of the model, ``Dynamics(model)``.
    n_draws : int
        At least 2: with one the variance grows as that of the genealogy.
    method, steps, log_bound
        As in `backward_paths`.

    Yields
    ------
    float64 scalar or (k,)
    """
    check_component("transition", transition, DensityTransition)
    check_integer("n_draws", n_draws)
    if not filter.properly_weighted:
        raise InputError("a component of the filter is not properly weighted: its smoothed means have another limit")
    kernel = _Backward(method, steps, log_bound)
    past: Population | None = None
    statistic = np.zeros(0)
    state = filter.start(seed)
    for t, observation in enumerate(observations):
        state, _ = filter.step(state, observation)
        y, u = split_input(observation)
        assert state.population is not None
        now = state.population.realised()
        if past is None:
            statistic = np.asarray(functional(t, None, now.particles), np.float64)
        else:
            rng = Key(seed).child("paris", t).generator()
            parents = known_parents(now, t) if method == "mcmc" else None
            move = _Move(past, now.particles, transition.at_step(t, u), y, t - 1)
            index = kernel.draw(rng, move, parents, n_draws).ravel()
            later = take(now.particles, np.repeat(np.arange(len(now)), n_draws))
            statistic = statistic[index] + functional(t, take(past.particles, index), later)
            statistic = statistic.reshape(len(now), n_draws, *statistic.shape[1:]).mean(axis=1)
        past = now
        yield np.tensordot(now.weights, statistic, axes=1)


def _by_weight(rng: np.random.Generator, population: Population, n: int) -> np.ndarray:
    """(n,) indices drawn independently by weight, in random order: those of `independent_draws` are nearly sorted."""
    index = independent_draws(rng, population.weights, n)
    rng.shuffle(index)
    return index


def _drawn(rng: np.random.Generator, log_weights: np.ndarray, t: int | None = None) -> np.ndarray:
    """Draw one index per row of (n, m) log weights."""
    top = log_weights.max(axis=1, keepdims=True)
    if not np.isfinite(top).all():
        raise _impossible(t)
    cumulative = np.cumsum(np.exp(log_weights - top), axis=1)
    points = rng.random((len(cumulative), 1)) * cumulative[:, -1:]
    # The index is the number of entries at or below the point; "at" skips weights of zero.
    index = (cumulative <= points).sum(axis=1)
    return np.minimum(index, (cumulative < cumulative[:, -1:]).sum(axis=1))


def _impossible(t: int | None) -> InputError:
    where = "" if t is None else f"from step {t} to {t + 1}: "
    return InputError(
        f"{where}a particle has no possible predecessor, or a density is NaN or +inf",
        "backward paths need the density of the transition that moved the particles",
    )


def conditional_path(
    filter: ParticleFilter, observations: Sequence[Any], seed: int | Key = 0, path: Particles | None = None
) -> Particles:
    """A path of states drawn by conditional SMC, a kernel that leaves p(x_0 .. x_T | y_0 .. y_T) invariant.

    One particle follows `path`, the others are drawn as usual, and one of the final particles is traced back.
    Ancestors are multinomial at every step: `resampler` and `trigger` of the filter are not used. The particle that
    follows the path draws its ancestors, too, if the density of the transition is known; a program must then keep
    nothing but its sites.

    Parameters
    ----------
    filter : ParticleFilter
        Bootstrap or guided filter of a model or a program, with at least two particles.
    path : T particles, optional
        The present path: row t is the particle at time t. Without it the path is drawn by an ordinary filter.

    Returns
    -------
    array (T, ...), mapping of such, or tuple of T objects
    """
    _check_conditional(filter)
    ys = list(observations)
    if not ys or (path is not None and count_particles(path) != len(ys)):
        states = "" if path is None else f" for a path of {count_particles(path)} states"
        raise InputError(f"there are {len(ys)} observations{states}")
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
            past = now.update.update(update_rng, past, None, y)
        populations.append(past)
    rows = [int(_drawn(rng, populations[-1].log_weights[None])[0])]
    for index in reversed(parents):
        rows.append(int(index[rows[-1]]))
    chosen = zip(populations, reversed(rows), strict=True)
    return _joined([take(p.realised().particles, np.array([row])) for p, row in chosen])


def _check_conditional(filter: ParticleFilter) -> None:
    for slot in ("proposal", "lookahead", "rejuvenation", "size"):
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
        return int(_drawn(rng, past.log_weights[None])[0])
    density = _log_density(transition, past.particles, take(given, np.zeros(len(past), np.int64)), y)
    if density is None:
        return 0
    # Lindsten, Jordan, Schön (2014), equation 16.
    return int(_drawn(rng, (past.log_weights + density)[None])[0])


def _log_density(transition: Transition | None, old: Particles, new: Particles, y: Any) -> np.ndarray | None:
    """(n,) log f(new | old), for programs with log p(y | new, old); None if it is not known."""
    if isinstance(transition, ProgramTransition):
        if isinstance(transition.model, PerParticle):
            return None
        handler = ScoreHandler(dict(new))
        particles, density = run_program(transition.model, handler, old, y, count_particles(old))
        # A value that the program returns is a function of the previous particle, and has no density.
        return density if {site.name for site in handler.sites} == set(particles) else None
    if isinstance(transition, Dynamics | GuidedTransition):
        found = transition.model.log_transition
        return None if found is None else np.asarray(found(old, new), np.float64)
    if isinstance(transition, DensityTransition):
        return np.asarray(transition.log_prob(old, new, y), np.float64)
    return None


def _moved(
    filter: ParticleFilter, streams: Key, past: Population | None, given: Particles | None, y: Any
) -> Population:
    """The particles of a step before the update; particle 0 is the given one, with its weight."""
    component: Any
    slot, component = ("initial", filter.initial) if past is None else ("transition", filter.transition)
    rng = streams.child(slot).generator()
    if given is not None and isinstance(component, ProgramInitial | ProgramTransition):
        return Population(*_program_step(rng, component, past, given, y, filter.n))
    if past is None:
        moved = component.sample(rng, y, filter.n)
    else:
        moved = past if component is None else component.predict(rng, past, y)
    if len(moved) != filter.n:
        raise InputError(f"{slot} made {len(moved)} particles of {filter.n}: conditional SMC needs one for each")
    if given is None:
        return moved
    log_weights = np.array(moved.log_weights)
    if isinstance(component, GuidedTransition) and past is not None:
        old = take(past.particles, np.array([0]))
        log_weights[0] = (
            component.model.density("log_transition")(old, given)[0] - component.log_prob(old, given, y)[0]
        )
    elif isinstance(component, GuidedInitial):
        if y is not None:
            q = as_distribution(component.proposal(y))
            log_weights[0] = component.model.density("log_initial")(given)[0] - q.log_prob(given)[0]
    elif log_weights.any():
        raise InputError(
            f"{slot} is a {type(component).__name__} that weights its particles, so the weight of a given "
            "particle is not known",
            "use Prior, Dynamics, GuidedInitial, GuidedTransition or a Program",
        )
    return Population(_with_first(moved.particles, given), log_weights)


def _with_first(particles: Particles, first: Particles) -> Particles:
    """The particles with another one at index 0."""
    if isinstance(particles, Mapping):
        return {name: _with_first(a, first[name]) for name, a in particles.items()}
    if not isinstance(particles, np.ndarray):
        return (first[0], *tuple(particles)[1:])
    particles = np.array(particles)
    particles[0] = first[0]
    return particles


def _joined(rows: list[Particles]) -> Particles:
    """Particles of all times, from one particle each; values that a program does not have at a time are NaN or 0."""
    if isinstance(rows[0], np.ndarray):
        return np.concatenate(rows)
    if not isinstance(rows[0], Mapping):
        return tuple(row[0] for row in rows)
    examples = {name: a for row in rows for name, a in row.items()}
    blank = {name: np.full_like(a, np.nan if a.dtype.kind == "f" else 0) for name, a in examples.items()}
    return {name: np.concatenate([row.get(name, blank[name]) for row in rows]) for name in examples}


class _GivenSamples(SampleHandler):
    """Draws every site, except that particle 0 has given values."""

    def __init__(self, rng: np.random.Generator, given: Particles) -> None:
        super().__init__(rng)
        self.given = given

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        value, gain = super().value(site)
        return _given_value(site, value, self.given), gain

    def row(self, index: int) -> SampleHandler:
        inner = super().row(index)
        return inner if index else _GivenSamples(inner.rng, self.given)


class _GivenGuide(GuideHandler):
    """As `_GivenSamples`, for a guide."""

    def __init__(self, rng: np.random.Generator, n: int, given: Particles) -> None:
        super().__init__(rng, n)
        self.given = given

    def value(self, site: Site) -> tuple[np.ndarray, np.ndarray | None]:
        value, gain = super().value(site)
        value = _given_value(site, value, self.given)
        self.log_q[site.name][site.index] = site.distribution.log_prob(value)
        return value, gain

    def row(self, index: int) -> GuideHandler:
        if index == 0:
            self.rows.append(_GivenGuide(child(self.rng, "particle", index), 1, self.given))
            return self.rows[-1]
        return super().row(index)


def _given_value(site: Site, value: np.ndarray, given: Particles) -> np.ndarray:
    """The values of a site, with the given one in the row of particle 0, if that reaches the site."""
    if site.rows is not None and (not len(site.rows) or site.rows[0] != 0):
        return value
    value = np.array(value)
    value[0] = given[site.name][0] if isinstance(given, Mapping) else given[0][site.name]
    return value


def _program_step(
    rng: np.random.Generator, component: Any, past: Population | None, given: Particles, y: Any, n: int
) -> tuple[Particles, np.ndarray]:
    """Particles and log weights of a step of a program; particle 0 has given values."""
    previous = None if past is None else past.particles
    if component.guide is None or y is None:
        return run_program(component.model, _GivenSamples(rng, given), previous, y, n)
    guide = _GivenGuide(rng, n, given)
    run_program(component.guide, guide, previous, y, n)
    return run_program(component.model, ReplayHandler(guide), previous, y, n)


def path_log_prob(filter: ParticleFilter, observations: Sequence[Any], path: Particles) -> float:
    """log p(x_0 .. x_T, y_0 .. y_T) of a path of `conditional_path`, by the model or the program of a filter.

    The filter is made from a `StateSpaceModel` with its log densities or from a `Program`.
    """
    total, previous = 0.0, None
    for t, observation in enumerate(observations):
        y, u = split_input(observation)
        row = take(path, np.array([t]))
        total += _step_log_prob(filter.at_step(t, u), previous, row, y)
        previous = row
    return total


def _step_log_prob(filter: ParticleFilter, previous: Particles | None, row: Particles, y: Any) -> float:
    """log p(x_t, y_t | x_{t-1}) of one particle, by the components of the filter at the step."""
    component = filter.initial if previous is None else filter.transition
    if isinstance(component, ProgramInitial | ProgramTransition):
        if isinstance(component.model, PerParticle):
            raise InputError("the density of a path of a per_particle program is not available")
        values = row if isinstance(row, Mapping) else row[0]
        _, gain = run_program(component.model, ScoreHandler(values), previous, y, 1)
        return float(gain[0])
    if not isinstance(component, Prior | GuidedInitial | Dynamics | GuidedTransition):
        raise InputError("the filter is not made from a StateSpaceModel or a Program: its densities are not known")
    model = component.model
    density = model.density("log_initial" if previous is None else "log_transition")
    found = density(row) if previous is None else density(previous, row)
    return float(found[0]) + (0.0 if y is None else float(model.log_likelihood(row, y)[0]))
