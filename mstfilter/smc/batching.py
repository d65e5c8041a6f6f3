"""Many runs of one filter at once, as arrays (run, particle, ...).

>>> runs = batch(bootstrap(model, n=100), observations, seeds=range(200))
>>> runs.log_evidence.shape, runs.ess.shape                       # (200, T) each
>>> runs.state(7).population.particles                            # of the run with the eighth seed
>>> batch(bootstrap(model, n=100), data_sets, seeds=range(200), paired=True)    # run r gets data_sets[r]
>>> batch(filter, observations, mean=lambda p: p.weights @ p.particles).values["mean"]                # (R, T)

Run r equals ``filter.run(observations, seeds[r])`` bit for bit: it draws from the same streams. Components that are
`batched` are called once per step, with arrays (R, n, ...) of R runs; others are called once per run and step.
`batched_slots` lists the former. A filter with other components than `initial`, `transition`, `update`, `resampler`
and `trigger` runs one seed after another.

A batched component treats the particles of a run alike wherever the axis of the runs is, and takes the shape of its
draws from its arguments: ``x + rng.standard_normal(x.shape)``. `StateSpaceModel` has the field `batched` for models
whose functions do so. `RunGenerators` stands for the generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mstfilter.errors import InputError, LostRunError
from mstfilter.smc.filter import ParticleFilter
from mstfilter.smc.interfaces import State, WeightResampler
from mstfilter.smc.population import Population, check_observations, identity
from mstfilter.smc.streams import Key, RunGenerators, SlotStreams

Function = Callable[[Population], Any]


@dataclass(frozen=True, eq=False)
class Batch:
    """The results of R runs of T steps."""

    #: (R, T) log evidence after each step; NaN if the filter does not report it, -inf from the step at which a run
    #: is lost.
    log_evidence: np.ndarray
    ess: np.ndarray  #: (R, T) effective sample size after each update; NaN after a run is lost
    resampled: np.ndarray  #: (R, T) bool, whether the step resampled
    states: tuple[State | None, ...]  #: the last states; None for a run that is lost
    lost: dict[int, str] = field(default_factory=dict)  #: run -> reason
    #: name -> (R, T, ...) float64, results of the functions given to `batch`; NaN after a run is lost
    values: dict[str, np.ndarray] = field(default_factory=dict)

    def state(self, run: int) -> State:
        """The last state of a run; InputError if the run is lost."""
        state = self.states[run]
        if state is None:
            raise InputError(f"run {run} is lost: {self.lost[run]}")
        return state

    def record(self, run: int, t: int, population: Any, functions: Mapping[str, Function]) -> None:
        """Keep what the functions return."""
        for name, function in functions.items():
            found = np.asarray(function(population))
            if name not in self.values:
                self.values[name] = np.full((*self.ess.shape, *found.shape), np.nan)
            self.values[name][run, t] = found


def batch(
    filter: ParticleFilter,
    observations: Iterable[Any],
    seeds: Sequence[int] = range(100),
    paired: bool = False,
    **functions: Function,
) -> Batch:
    """Run a filter with many seeds.

    Parameters
    ----------
    observations : iterable
        T observations, the same for all runs; None if missing.
    paired : bool
        If True, `observations` are R sequences of T observations, one for each seed. Batched components get the
        observations of a step as an array (R, 1, ...).
    **functions
        Name -> function of the population after a step, called for each run and step. It gets particles and weights
        only; its result has the same shape at every step.
    """
    seeds = [int(seed) for seed in seeds]
    ys = [list(check_observations(y)) for y in (observations if paired else [observations])]
    if not seeds:
        raise InputError("there are no seeds")
    if paired and len(ys) != len(seeds):
        raise InputError(f"there are {len(ys)} sequences of observations for {len(seeds)} seeds")
    if len({len(y) for y in ys}) != 1:
        raise InputError(
            f"sequences of observations have lengths {sorted({len(y) for y in ys})}, expected one length"
        )
    if batched_slots(filter) is not None:
        try:
            return _Sweep(filter, ys, seeds, functions).run()
        except _SizeChanged:
            pass
    return _one_by_one(filter, ys, seeds, functions)


def batched_slots(filter: ParticleFilter) -> tuple[str, ...] | None:
    """Slots whose components process all runs at once; None if the runs of the filter are made one by one.

    The latter are filters with other components than the four below, with a resampler that compares particles, or
    with one that may return fewer particles. Filters whose components change the number of particles are found when
    they do so, and their runs are made one by one too.
    """
    others = (filter.proposal, filter.lookahead, filter.rejuvenation, filter.size)
    resampler = filter.resampler
    if filter.initial is None or any(component is not None for component in others):
        return None
    if not isinstance(resampler, WeightResampler) or not resampler.exact_size:
        return None
    components = {slot: getattr(filter, slot) for slot in ("initial", "transition", "update", "resampler")}
    return tuple(slot for slot, component in components.items() if component is not None and component.batched)


def _one_by_one(filter: ParticleFilter, ys: list[list[Any]], seeds: list[int], functions: Any) -> Batch:
    result = _empty(len(seeds), len(ys[0]))
    states: list[State | None] = []
    for r, seed in enumerate(seeds):
        state: State | None = filter.start(seed)
        try:
            for state, info in filter.iterate(ys[r % len(ys)], seed):
                found = state.log_evidence
                result.log_evidence[r, info.t] = np.nan if found is None else found
                result.ess[r, info.t], result.resampled[r, info.t] = info.ess, info.resampled
                result.record(r, info.t, state.population, functions)
        except LostRunError as error:
            state, result.lost[r] = None, error.message
        states.append(state)
    return _finished(result, states, filter)


def _empty(n_runs: int, n_steps: int) -> Batch:
    nan = np.full((n_runs, n_steps), np.nan)
    return Batch(nan, nan.copy(), np.zeros((n_runs, n_steps), bool), ())


def _finished(result: Batch, states: list[State | None], filter: ParticleFilter) -> Batch:
    for r in result.lost if filter.properly_weighted else ():
        result.log_evidence[r, np.isnan(result.log_evidence[r])] = -np.inf
    return replace(result, states=tuple(states))


class _SizeChanged(Exception):
    """A component returned another number of particles than it got."""


class _AllLost(Exception):
    """No run is left."""


class _Runs(Population):
    """The populations of R runs: log weights (R, n), particles (R, n, ...)."""

    @classmethod
    def of(cls, particles: Any, log_weights: np.ndarray, **known: Any) -> _Runs:
        new = object.__new__(cls)  # not checked: the shapes of a population do not apply
        new.__dict__.update(particles=particles, log_weights=log_weights, parents={}, notes={}, **known)
        return new

    def labelled(self, parents: Any, notes: Any = None) -> Population:
        return self.of(self.particles, self.log_weights)

    def reweighted(self, log_factors: np.ndarray) -> Population:
        return self.of(self.particles, self.log_weights + log_factors)


class _Sweep:
    """The steps of R runs; rows are runs that are not lost."""

    def __init__(self, filter: ParticleFilter, ys: list[list[Any]], seeds: list[int], functions: Any) -> None:
        self.filter, self.ys, self.seeds, self.functions = filter, ys, seeds, functions
        self.result = _empty(len(seeds), len(ys[0]))
        self.runs = np.arange(len(seeds))  # the run of each row
        self.streams: dict[str, SlotStreams] = {}
        #: Effective sample sizes and log mean weights of the rows after the last update.
        self.summary = (np.zeros(0), np.zeros(0))

    def run(self) -> Batch:
        states: list[State | None] = [None] * len(self.seeds)
        particles = log_weights = ancestors = None
        try:
            for t in range(len(self.ys[0])):
                particles, log_weights, ancestors = self.step(t, particles, log_weights)
                for row, run in enumerate(self.runs.tolist() if self.functions else ()):
                    self.result.record(run, t, Population(_row(particles, row), log_weights[row]), self.functions)
        except _AllLost:
            pass
        proper = self.filter.properly_weighted
        for row, r in enumerate(self.runs):
            population = None
            if log_weights is not None:
                parents = {} if ancestors is None else {"previous": ancestors[row]}
                population = Population(_row(particles, row), log_weights[row], parents)
            states[r] = State(len(self.ys[0]), population, Key(self.seeds[r]), proper)
        return _finished(self.result, states, self.filter)

    def step(self, t: int, particles: Any, log_weights: Any) -> tuple[Any, np.ndarray, np.ndarray | None]:
        """Particles, log weights and parents after step t; the parents at the last step only."""
        filter, ancestors = self.filter, None
        if log_weights is None:
            particles, log_weights, ancestors = self.first(t)
        else:
            if t == len(self.ys[0]) - 1:
                ancestors = np.tile(identity(filter.n), (len(self.runs), 1))
            if filter.resample == "before":
                particles, log_weights, ancestors = self.select(t, particles, log_weights, ancestors)
            if filter.transition is not None:
                particles, log_weights, ancestors = self.component(t, "transition", particles, log_weights, ancestors)
        if filter.update is not None:
            particles, log_weights, ancestors = self.component(t, "update", particles, log_weights, ancestors)
        self.summary = summaries(log_weights)
        self.result.ess[self.runs, t], log_mean = self.summary
        if filter.properly_weighted:
            self.result.log_evidence[self.runs, t] = log_mean
        if filter.resample == "after":
            particles, log_weights, ancestors = self.select(t, particles, log_weights, ancestors)
        return particles, log_weights, ancestors

    def first(self, t: int) -> tuple[Any, np.ndarray, np.ndarray | None]:
        initial, n = self.filter.initial, self.filter.n
        assert initial is not None
        if initial.batched:
            shape = (len(self.runs), n)
            population = initial.sample(self.generators(t, "initial"), self.observation(t), shape)  # type: ignore
            return population.particles, np.zeros(shape), None
        return self.each(t, "initial", lambda rng, row, y: initial.sample(rng, y, n), None)

    def component(
        self, t: int, slot: str, particles: Any, log_weights: np.ndarray, ancestors: np.ndarray | None
    ) -> tuple[Any, np.ndarray, np.ndarray | None]:
        """Particles, log weights and ancestors after the transition or the update."""
        component, moves = getattr(self.filter, slot), slot == "transition"
        missing = [y[t] is None for y in self.ys] if len(self.ys) == 1 else [self.ys[r][t] is None for r in self.runs]
        if not moves and all(missing):
            return particles, log_weights, ancestors
        if component.batched and (len(self.ys) == 1 or not any(missing)):
            rng = self.generators(t, slot) if component.draws else None
            population, y = _Runs.of(particles, log_weights), self.observation(t)
            found = component.predict(rng, population, y) if moves else component.update(rng, population, None, y)
            return *self.without_lost(t, slot, found.particles, found.log_weights), ancestors
        parents = {"previous": identity(self.filter.n)}

        def call(rng: np.random.Generator, row: int, y: Any) -> Population:
            population = Population(_row(particles, row), log_weights[row], parents)
            if moves:
                return component.predict(rng, population, y)
            return population if y is None else component.update(rng, population, None, y)

        return self.each(t, slot, call, ancestors)

    def each(
        self, t: int, slot: str, call: Callable[..., Population], ancestors: np.ndarray | None
    ) -> tuple[Any, np.ndarray, np.ndarray | None]:
        """Results of a component that is called for each run; runs that it loses are removed."""
        found: list[Population | None] = []
        for row, r in enumerate(self.runs):
            try:
                population = call(self.generator(t, slot, row), row, self.ys[r % len(self.ys)][t])
            except InputError as error:
                message = f"step {t}, {slot}: {error.message}"
                if not isinstance(error, LostRunError):
                    raise InputError(f"run {r}, {message}", *error.hints) from error
                self.result.lost[int(r)] = message
                found.append(None)
                continue
            if len(population) != self.filter.n:
                raise _SizeChanged
            found.append(population.realised())
        alive = np.array([p is not None for p in found])
        self.keep(alive)
        kept = [p for p in found if p is not None]
        ancestors = None if ancestors is None else ancestors[alive]
        return _stacked([p.particles for p in kept]), np.stack([p.log_weights for p in kept]), ancestors

    def keep(self, alive: np.ndarray) -> None:
        """Remove runs that are lost."""
        self.runs = self.runs[alive]
        if not len(self.runs):
            raise _AllLost

    def without_lost(self, t: int, slot: str, particles: Any, log_weights: np.ndarray) -> tuple[Any, np.ndarray]:
        """Only the runs that have a particle of positive weight."""
        top = log_weights.max(axis=1)
        if np.isfinite(top).all():
            return particles, log_weights
        for row, r in enumerate(self.runs):
            try:
                Population(_row(particles, row), log_weights[row])  # raises the errors of a single run
            except LostRunError as error:
                self.result.lost[int(r)] = f"step {t}, {slot}: {error.message}"
        alive = np.isfinite(top)
        self.keep(alive)
        return _row(particles, alive), log_weights[alive]

    def select(
        self, t: int, particles: Any, log_weights: np.ndarray, ancestors: np.ndarray | None
    ) -> tuple[Any, np.ndarray, np.ndarray | None]:
        """Resample the runs whose trigger asks for it; (R, n) `ancestors` are changed in place."""
        ess, log_mean = self.summary
        rows = np.flatnonzero(self.wanted(t, particles, log_weights, ess))
        self.result.resampled[self.runs[rows], t] = True
        if not len(rows):
            return particles, log_weights, ancestors
        resampler, n = self.filter.resampler, self.filter.n
        assert isinstance(resampler, WeightResampler)
        if resampler.batched:
            streams: Any = self.generators(t, "resampler", rows)
            index, out = resampler.select(streams, log_weights[rows], n)
        else:
            drawn = [resampler.select(self.generator(t, "resampler", k), log_weights[k], n) for k in rows.tolist()]
            index = np.stack([a for a, _ in drawn])
            out = None if drawn[0][1] is None else np.stack([w for _, w in drawn if w is not None])
        log_weights = log_weights.copy()
        log_weights[rows] = log_mean[rows, None] if out is None else out
        if ancestors is not None:
            ancestors[rows] = np.take_along_axis(ancestors[rows], index, axis=1)
        return _selected(particles, rows, index), log_weights, ancestors

    def wanted(self, t: int, particles: Any, log_weights: np.ndarray, ess: np.ndarray) -> np.ndarray:
        """(R,) bool: the runs to resample."""
        trigger, rows = self.filter.trigger, range(len(ess))
        if trigger.batched:
            runs = _Runs.of(particles, log_weights, _both=self.summary)
            return np.broadcast_to(trigger.wants(runs, t), len(ess))
        return np.array([trigger.wants(Population(_row(particles, k), log_weights[k]), t) for k in rows])

    def observation(self, t: int) -> Any:
        """The observation of a step for batched components: (R, 1, ...) if each run has its own."""
        if len(self.ys) == 1:
            return self.ys[0][t]
        return np.stack([self.ys[r][t] for r in self.runs])[:, None]

    def generators(self, t: int, slot: str, rows: np.ndarray | None = None) -> RunGenerators:
        """The streams of the runs (of some rows) at a step."""
        if slot not in self.streams:
            self.streams[slot] = SlotStreams(self.seeds, slot, len(self.ys[0]))
        return RunGenerators(self.streams[slot].states(t, self.runs if rows is None else self.runs[rows]))

    def generator(self, t: int, slot: str, row: int) -> np.random.Generator:
        """The stream of the run of a row at a step."""
        return Key(self.seeds[self.runs[row]]).child("step", t).child(slot).generator()


def summaries(log_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Effective sample sizes (R,) and log mean weights (R,) of log weights (R, n); the numbers of `Population`."""
    top = log_weights.max(axis=1)
    weights = log_weights - top[:, None]
    np.exp(weights, out=weights)
    totals = weights.sum(axis=1)
    ess = totals * totals / np.vecdot(weights, weights)
    # `math.log`, as for a single population: numpy's may differ in the last bit.
    logs = np.fromiter(map(math.log, (totals / log_weights.shape[1]).tolist()), np.float64, len(totals))
    return ess, top + logs


def _row(particles: Any, row: Any) -> Any:
    if isinstance(particles, dict):
        return {name: a[row] for name, a in particles.items()}
    if isinstance(particles, np.ndarray):
        return particles[row]
    if isinstance(row, np.ndarray):
        return [p for p, keep in zip(particles, row, strict=True) if keep]
    return particles[row]


def _stacked(particles: list[Any]) -> Any:
    """Particles of all runs; objects are kept in one tuple per run."""
    if isinstance(particles[0], dict):
        return {name: np.stack([p[name] for p in particles]) for name in particles[0]}
    if isinstance(particles[0], np.ndarray):
        return np.stack(particles)
    return particles


def _selected(particles: Any, rows: np.ndarray, index: np.ndarray) -> Any:
    """Particles after resampling some rows by (len(rows), n) ancestors."""
    if isinstance(particles, dict):
        return {name: _selected(a, rows, index) for name, a in particles.items()}
    if isinstance(particles, np.ndarray):
        if len(rows) == len(particles):
            return particles[rows[:, None], index]
        out = particles.copy()
        out[rows] = particles[rows[:, None], index]
        return out
    sets = list(particles)
    for row, ancestors in zip(rows, index, strict=True):
        sets[row] = tuple(particles[row][i] for i in ancestors)
    return sets
