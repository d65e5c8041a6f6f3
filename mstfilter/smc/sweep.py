"""Many runs of one filter in one sweep: their particles are one population, and each component is called once a step.

The functions of a model process each particle as if it were alone (`Component.alone`), so they need not know which
run a particle belongs to. Only weights, triggers and resampling are by run. 200 runs of 100 particles cost one call
with 20,000 particles instead of 200 calls with 100: a thirtieth of the time.

>>> from mstfilter.smc import Key, Normal, StateSpaceModel, bootstrap, log_evidence
>>> from mstfilter.smc.sweep import sweep_runs
>>> model = StateSpaceModel.of(Normal(0.0, 1.0), lambda x: Normal(0.9 * x, 0.5), lambda x: Normal(x, 1.0))
>>> runs = sweep_runs(bootstrap(model, 100), [0.3, -0.2], [1, 2, 3, 4, 5], Key(0), {"log_evidence": log_evidence})
>>> [run.rows["log_evidence"].shape for run in runs]
[(2,), (2,), (2,), (2,), (2,)]

A sweep has random streams of its own. Its runs are independent and have the law of single runs, but not their bits.
`mstfilter.smc.run_many` uses sweeps where it can, and `pmmh`, `ensemble` and `smc2` for filters with different
parameters, which `sweep_difference` compares with single ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.base.errors import LostRunError, naming
from mstfilter.smc.components import Always, EssBelow, Never
from mstfilter.smc.filter import ParticleFilter, keep_freed_memory
from mstfilter.smc.first_steps import first_difference, is_numeric
from mstfilter.smc.history import Collector, by_key, check_one_shape, ess, log_evidence, resampled, stacked
from mstfilter.smc.inputs import split_input
from mstfilter.smc.interfaces import Info, State
from mstfilter.smc.population import Population, identity, take
from mstfilter.smc.resampling import Multinomial, Stratified, Systematic
from mstfilter.smc.streams import Key


@dataclass(frozen=True)
class Collected:
    """The collected values of one run."""

    rows: dict[str, np.ndarray]  #: name -> (t, ...), up to the last step or the step at which the run is lost
    lost: str = ""  #: why the run is lost (all weights are zero); "" if it is not


DIFFERENT_WEIGHTS = (
    "the likelihood with one parameter vector for each particle is not that of single filters",
    "with batched=True, filter_of gets arrays of one parameter per particle: use them like particles",
)


def can_sweep(filter: ParticleFilter) -> bool:
    """Whether runs of a filter can be swept: its components process each particle alone, and n is constant."""
    if any(getattr(filter, slot) is not None for slot in ("proposal", "rejuvenation")):
        return False
    components = (filter.initial, filter.transition, filter.update, filter.lookahead)
    return filter.resampler.exact_size and all(c is None or c.alone for c in components)


def sweep_difference(alone: Sequence[ParticleFilter], both: ParticleFilter, observations: Sequence[Any]) -> str:
    """Compare a filter with two parameter vectors, one for each half of its particles, with the filter of each.

    In the first two steps, each component is called with the same particles and random numbers. Returns "weights" if
    weights of particles differ from those of the filter with their parameters, which is an error. Otherwise "draws",
    if draws differ or are objects: they may have the same law if the numbers that they consume depend on parameters.
    Otherwise "". Raises what a component raises.
    """
    n, found, same_draws = alone[0].n, None, True
    halves = slice(0, n), slice(n, 2 * n)

    def weights_differ(together: Any, one_by_one: Sequence[Any]) -> bool:
        wanted = np.concatenate([a[half] for a, half in zip(one_by_one, halves, strict=True)])
        return not np.allclose(together, wanted, rtol=1e-6, atol=1e-6)

    for t, observation in enumerate(observations[:2]):
        y, u = split_input(observation)
        every = [filter.at_step(t, u) for filter in (both, *alone)]
        if found is None:
            drawn = [f.initial.sample(Key(t).generator(), y, 2 * n) for f in every]  # type: ignore[union-attr]
        else:
            if both.lookahead is not None and y is not None:
                priorities = [f.lookahead.log_priority(found, y) for f in every]  # type: ignore[union-attr]
                if weights_differ(priorities[0], priorities[1:]):
                    return "weights"
            moves = [f.transition for f in every]
            drawn = [found if m is None else m.predict(Key(t).generator(), found, y) for m in moves]
        for one, half in zip(drawn[1:], halves, strict=True):
            same = first_difference(drawn[0].particles, one.particles, half) is None
            same_draws = same_draws and same and is_numeric(one.particles)
        if same_draws and weights_differ(drawn[0].log_weights, [one.log_weights for one in drawn[1:]]):
            return "weights"
        found = drawn[0]
        if y is not None and both.update is not None:
            rng = Key(t).generator()
            updated = [f.update.update(rng, found, None, y) for f in every]  # type: ignore[union-attr]
            if weights_differ(updated[0].log_weights, [one.log_weights for one in updated[1:]]):
                return "weights"
            found = updated[0]
    return "" if same_draws else "draws"


def sweep_runs(
    filter: ParticleFilter,
    observations: list[Any],
    seeds: list[int],
    key: Key,
    collectors: Mapping[str, Collector],
    filter_of: Callable[[np.ndarray], ParticleFilter] | None = None,
) -> list[Collected]:
    """Results of independent runs, which have the names `seeds` and draw from the streams of `key`.

    If the runs have different parameters, ``filter_of(runs)`` returns the filter for the particles of the given runs,
    n rows for each in this order; `filter` is then that of any run.
    """
    keep_freed_memory()
    return _Sweep(filter, filter_of or (lambda runs: filter), seeds, key, collectors).run(observations)


class _Sweep:
    """R runs with n particles each, in arrays of R n rows. Runs in which all weights are zero are removed."""

    def __init__(
        self,
        filter: ParticleFilter,
        filter_of: Callable[[np.ndarray], ParticleFilter],
        seeds: list[int],
        key: Key,
        collectors: Mapping[str, Collector],
    ) -> None:
        self.filter, self.filter_of, self.key, self.collectors = filter, filter_of, key, collectors
        self.seeds, n_runs = seeds, len(seeds)
        self.runs = np.arange(n_runs)  # those that are not lost
        self.population: Population | None = None
        self.ess = self.log_mean = np.zeros(n_runs)
        self.weights = np.ones((n_runs, filter.n))  # with maximum 1 in each run
        self.traced = not set(collectors.values()) <= {log_evidence, ess, resampled}
        #: For each step, the runs and the values of each collector.
        self.found: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
        self.n_runs = n_runs
        self.lost: dict[int, str] = {}

    def run(self, observations: list[Any]) -> list[Collected]:
        """Make all steps, and return the results of each run."""
        for t, observation in enumerate(observations):
            if len(self.runs):
                self.step(t, *split_input(observation))
        tables = {name: self.table(name) for name in (self.found[0][1] if self.found else self.collectors)}
        ends = np.zeros(self.n_runs, int)
        for runs, _ in self.found:
            ends[runs] += 1
        return [
            Collected({name: table[: ends[r], r] for name, table in tables.items()}, self.lost.get(r, ""))
            for r in range(self.n_runs)
        ]

    def table(self, name: str) -> np.ndarray:
        """Values (T, R, ...) of a collector. Those of a run are undefined after all its weights are zero."""
        check_one_shape(name, [found[name].shape[1:] for _, found in self.found])
        values = [found[name] for _, found in self.found]
        shape = values[0].shape[1:] if values else ()
        kind = np.result_type(*values) if values else np.dtype(float)
        table = np.zeros((len(values), self.n_runs, *shape), kind)
        for t, (runs, _) in enumerate(self.found):
            table[t, runs] = values[t]
        return table

    def step(self, t: int, y: Any, u: Any) -> None:
        """Step t of all runs, as `ParticleFilter.step`."""
        at, before = self.filter_of(self.runs).at_step(t, u), self.filter.resample == "before"
        moved = np.zeros(len(self.runs), bool)
        ancestors = np.arange(len(self.runs) * self.filter.n)
        if self.population is None:
            assert at.initial is not None
            population = at.initial.sample(self.rng("initial", t), y, len(ancestors))
        else:
            population = self.population
            if before:
                population, moved, ancestors = self.select(t, population, at.lookahead, y)
            if at.transition is not None:
                population = at.transition.predict(self.rng("transition", t), population, y)
        if y is not None and at.update is not None:
            try:
                population = at.update.update(self.rng("update", t), population, None, y)
            except LostRunError as error:  # all weights of all runs are zero
                self.lost |= {int(run): f"step {t}, update: {error.message}" for run in self.runs}
                self.runs = self.runs[:0]
                return
        population, moved, ancestors = self.without_lost(t, population, moved, ancestors)
        lw = population.log_weights.reshape(len(self.runs), -1)
        self.ess, self.log_mean, self.weights = summaries(lw)
        if not before:
            population, moved, ancestors = self.select(t, population, None, None)
            lw = population.log_weights.reshape(len(self.runs), -1)
            _, self.log_mean, self.weights = summaries(lw)  # as `State` has it
        self.population = Population.unchecked(population.particles, population.log_weights)
        self.record(t, moved, ancestors)

    def rng(self, slot: str, t: int) -> np.random.Generator:
        """The stream of a component in this step, for all runs."""
        return self.key.child(slot, t).generator()

    def without_lost(
        self, t: int, population: Population, moved: np.ndarray, ancestors: np.ndarray
    ) -> tuple[Population, np.ndarray, np.ndarray]:
        """The runs in which some weight is positive."""
        alive = population.log_weights.reshape(len(self.runs), -1).max(axis=1) > -np.inf
        if alive.all():
            return population, moved, ancestors
        n = self.filter.n
        for run in self.runs[~alive]:
            self.lost[int(run)] = (
                f"step {t}, update: all {n} log weights are -inf: no particle explains the observation"
            )
        self.runs = self.runs[alive]
        rows = np.repeat(alive, n)
        kept = Population(take(population.particles, np.flatnonzero(rows)), population.log_weights[rows])
        return kept, moved[alive], ancestors[rows]

    # --- resampling -------------------------------------------------------------------------------------------------
    def select(
        self, t: int, population: Population, lookahead: Any, y: Any
    ) -> tuple[Population, np.ndarray, np.ndarray]:
        """Resample the runs that the trigger chooses: the particles, (R,) which runs, and (R n,) ancestors."""
        runs, n = len(self.runs), self.filter.n
        lw, ess_, log_mean = population.log_weights.reshape(runs, n), self.ess, self.log_mean
        weights, priority = self.weights, None
        if lookahead is not None and y is not None:
            priority = np.asarray(lookahead.log_priority(population, y), np.float64).reshape(runs, n)
            lw = lw + priority
            ess_, log_mean, weights = summaries(lw)
        chosen = self.wanted(t, population, lw, ess_)
        index = np.tile(identity(n), (runs, 1))
        new = population.log_weights.reshape(runs, n).copy()
        rows = np.flatnonzero(chosen)
        if not len(rows):
            return population, chosen, np.arange(runs * n)
        index[rows], selected = self.ancestors(t, population, lw[rows], weights[rows], rows)
        new[rows] = log_mean[rows, None] if selected is None else selected
        if priority is not None:
            new[rows] -= np.take_along_axis(priority[rows], index[rows], axis=1)
        flat = (index + n * np.arange(runs)[:, None]).ravel()
        return Population.unchecked(take(population.particles, flat), new.ravel()), chosen, flat

    def wanted(self, t: int, population: Population, lw: np.ndarray, ess_: np.ndarray) -> np.ndarray:
        """(R,) whether each run resamples."""
        trigger, runs, n = self.filter.trigger, len(self.runs), self.filter.n
        if type(trigger) is EssBelow:
            return ess_ < trigger.share * n
        if type(trigger) in (Always, Never):
            return np.full(runs, type(trigger) is Always)
        return np.array([trigger.wants(self.of_run(population, lw, r), t) for r in range(runs)], bool)

    def of_run(self, population: Population, lw: np.ndarray, row: int) -> Population:
        """The particles of one run."""
        n = self.filter.n
        return Population(take(population.particles, np.arange(row * n, row * n + n)), lw[row])

    def ancestors(
        self, t: int, population: Population, lw: np.ndarray, weights: np.ndarray, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Ancestors (k, n) of k runs, and their log weights if these are not the mean weight of the run.

        `lw` and `weights` (k, n) are those of the runs.
        """
        resampler, rng, n = self.filter.resampler, self.rng("resampler", t), self.filter.n
        if type(resampler) is Systematic:
            return inverse_cdf_of_runs(weights, rng.random((len(rows), 1))), None
        if type(resampler) is Stratified:
            return inverse_cdf_of_runs(weights, rng.random(weights.shape)), None
        if type(resampler) is Multinomial:
            return independent_draws_of_runs(rng, weights), None
        index, found = [], []
        for k, row in enumerate(rows.tolist()):
            stream = self.key.child("resampler", t, int(self.runs[row])).generator()
            one = Population(take(population.particles, np.arange(row * n, row * n + n)), lw[k])
            selected = resampler.resample(stream, one, n)
            index.append(selected.parents["ancestor"])
            found.append(selected.log_weights)
        return np.stack(index), np.stack(found)

    # --- results ----------------------------------------------------------------------------------------------------
    def record(self, t: int, moved: np.ndarray, ancestors: np.ndarray) -> None:
        """Store the results of the collectors for each run."""
        proper = self.filter.properly_weighted
        log_mean = self.log_mean if proper else np.full(len(self.runs), np.nan)
        found = {log_evidence: log_mean, ess: self.ess, resampled: moved}
        steps = [self.seen(t, row, moved, ancestors) for row in range(len(self.runs))] if self.traced else []
        values: dict[str, np.ndarray] = {}
        for name, collector in self.collectors.items():
            if collector in found:
                values[name] = found[collector]
                continue
            rows = by_key(name, [self.collected(collector, row, step) for row, step in enumerate(steps)])
            values |= {key: stacked(key, row) for key, row in rows.items()}
        self.found.append((self.runs, values))

    def seen(self, t: int, row: int, moved: np.ndarray, ancestors: np.ndarray) -> tuple[State, Info]:
        """State and `Info` of one run after step t."""
        assert self.population is not None
        n, rows = self.filter.n, slice(row * self.filter.n, (row + 1) * self.filter.n)
        own = ancestors[rows] - row * n
        parents = {"previous": own} if t else {}
        if self.filter.resample == "after" and moved[row]:
            parents["ancestor"] = own
        particles = take(self.population.particles, np.arange(rows.start, rows.stop))
        population = Population(particles, self.population.log_weights[rows], parents)
        key = Key(self.seeds[self.runs[row]]).child("sweep")
        info = Info(t, n, n, float(self.ess[row]), bool(moved[row]))
        return State(t + 1, population, key, self.filter.properly_weighted), info

    def collected(self, collector: Collector, row: int, step: tuple[State, Info]) -> Any:
        """The value of a collector for one run."""
        with naming(f"seed {self.seeds[self.runs[row]]}"):
            return collector(*step)


def summaries(log_weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of log weights (R, n): effective sample sizes (R,), log mean weights (R,), and weights (R, n) of maximum 1."""
    top = log_weights.max(axis=1)
    weights = np.exp(log_weights - top[:, None])
    totals = weights.sum(axis=1)
    return totals**2 / np.vecdot(weights, weights), top + np.log(totals / log_weights.shape[1]), weights


def inverse_cdf_of_runs(weights: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """(R, n) ascending indices by systematic or stratified draws, from weights (R, n).

    Index i of a run gets the points (k + shift_k) / n, k = 0 .. n - 1, between its cumulative weights. The shifts, in
    [0, 1), are (R, 1) for systematic draws and (R, n) for stratified ones.
    """
    runs, n = weights.shape
    ends = weights.cumsum(axis=1)
    last = ends == ends[:, -1:]
    ends *= n / ends[:, -1:]
    ends -= (
        shifts if shifts.shape[1] == 1 else np.take_along_axis(shifts, np.minimum(ends.astype(int), n - 1), axis=1)
    )
    ends = np.ceil(ends).astype(np.int64)  # the number of points below each cumulative weight
    ends[last] = n  # whatever the rounding
    ends = ends[:, :-1] + (n + 2) * np.arange(runs)[:, None]  # rounding may give n + 1
    counts = np.bincount(ends.ravel(), minlength=runs * (n + 2)).reshape(runs, n + 2)
    return counts[:, :n].cumsum(axis=1)


def independent_draws_of_runs(rng: np.random.Generator, weights: np.ndarray) -> np.ndarray:
    """(R, n) ascending indices, drawn independently by weights (R, n)."""
    runs, n = weights.shape
    points = rng.standard_exponential((runs, n + 1)).cumsum(axis=1)
    points = points[:, :-1] / points[:, -1:]
    cumulative = weights.cumsum(axis=1)
    cumulative /= cumulative[:, -1:]
    offsets = np.arange(runs)[:, None]
    index = np.searchsorted((cumulative + offsets).ravel(), (points + offsets).ravel(), side="right")
    index = index.reshape(runs, n) - n * offsets
    return np.clip(index, 0, (cumulative < 1).sum(axis=1, keepdims=True))


def advance_runs(
    filter: ParticleFilter,
    filter_of: Callable[[np.ndarray], ParticleFilter],
    population: Population | None,
    n_runs: int,
    t: int,
    observation: Any,
    key: Key,
) -> tuple[np.ndarray, Population | None, np.ndarray]:
    """One step of many runs, from the particles of all runs (None before the first step).

    Returns the runs that are not lost, their particles, and the log mean weight of each of them.
    """
    sweep = _Sweep(filter, filter_of, list(range(n_runs)), key, {})
    if population is not None:
        sweep.population = population
        sweep.ess, sweep.log_mean, sweep.weights = summaries(population.log_weights.reshape(n_runs, -1))
    try:
        sweep.step(t, *split_input(observation))
    except LostRunError:  # all weights of all runs are zero
        sweep.runs = sweep.runs[:0]
    return sweep.runs, sweep.population, sweep.log_mean
