"""Many runs of one filter at once, as arrays (run, particle, ...).

>>> runs = batch(bootstrap(model, n=100), observations, seeds=range(200))
>>> runs.log_evidence.shape, runs.ess.shape                       # (200, T) each
>>> runs.state(7).population.particles                            # of the run with the eighth seed
>>> batch(bootstrap(model, n=100), data_sets, seeds=range(200), paired=True)    # run r gets data_sets[r]
>>> batch(filter, observations, mean=lambda p: p.weights @ p.particles).values["mean"]                # (R, T)

Run r equals ``filter.run(observations, seeds[r])`` bit for bit: it draws from the same streams.

A component is called once per step with the particles of all runs, as one population of R n particles, if its
`batched` is True (stated by its author) or None (tried; models of `StateSpaceModel.of`, programs). It sees no axis of
runs: it treats each row by itself, and takes the shape of its draws from its arguments, as in
``x + rng.standard_normal(x.shape)``. `RunGenerators` draws the rows of each run from its stream. Observations and
inputs that differ between runs are repeated for each row.

The batch checks this. At steps 0, 1, 2, 5, 12, 29, ..., at the last one, and when the number of runs changes, some
runs are compared with a call for that run alone; at the first call of a component, up to 64 runs with a call for them
in another order. If they differ, a component that states ``batched=True`` raises InputError. Otherwise, and if they
differ by rounding only, the component is called once for each run, and `Batch.single` says why.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np

from mstfilter.errors import InputError, LostRunError
from mstfilter.smc.filter import ParticleFilter, keep_freed_memory
from mstfilter.smc.inputs import split_input
from mstfilter.smc.interfaces import State, WeightResampler
from mstfilter.smc.population import Population, check_observations, identity
from mstfilter.smc.streams import Key, RunGenerators, SlotStreams, rows_of

Function = Callable[[Population], Any]

#: Runs that are compared with a call for the runs in another order.
_MOST_COMPARED = 64
#: Steps at which runs are compared: the Pell numbers 0, 1, 2, 5, 12, 29, 70, ... Unlike powers of two, they also find
#: a fault of every third step.
_COMPARED_STEPS = frozenset(round((1 + math.sqrt(2)) ** k / math.sqrt(8)) for k in range(40))
_SLOTS = ("initial", "transition", "update")
_RAW = (TypeError, ValueError, LookupError, AttributeError, ArithmeticError)


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
    #: slot -> why its component was called once for each run; "all" if the runs were made one by one
    single: dict[str, str] = field(default_factory=dict)

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

    Warns if a component that states ``batched=True`` is called once for each run; `Batch.single` has the reason.

    Parameters
    ----------
    observations : iterable
        T observations, the same for all runs; None if missing, `WithInput` with an input.
    paired : bool
        If True, `observations` are R sequences of T observations, one for each seed. Components that are called with
        all runs get the observations of a step by row, (R n, ...).
    **functions
        Name -> function of the population after a step, called for each run and step. It gets particles and weights
        only; its result has the same shape at every step.

    Raises
    ------
    InputError
        If a component that states ``batched=True`` mixes runs, or a run raises an error.
    """
    seeds = [int(seed) for seed in seeds]
    ys = [
        list(check_observations(y, f"run {run}, " if paired else ""))
        for run, y in enumerate(observations if paired else [observations])
    ]
    if not seeds:
        raise InputError("there are no seeds")
    if paired and len(ys) != len(seeds):
        raise InputError(f"there are {len(ys)} sequences of observations for {len(seeds)} seeds")
    if len({len(y) for y in ys}) != 1:
        raise InputError(
            f"sequences of observations have lengths {sorted({len(y) for y in ys})}, expected one length"
        )
    return run_batch(RunFilters(lambda run: filter, lambda runs: filter), ys, seeds, functions)


@dataclass(frozen=True)
class RunFilters:
    """The filters of the runs of a batch, which may differ in the numbers that their components hold."""

    one: Callable[[int], ParticleFilter]  #: the filter of a run
    rows: Callable[[np.ndarray], ParticleFilter]  #: one filter of the rows of some runs, in their order


def run_batch(
    filters: RunFilters,
    ys: list[list[Any]],
    seeds: list[int],
    functions: Mapping[str, Function] | None = None,
    check: bool = True,
    rounding: bool = False,
    warn: bool = True,
) -> Batch:
    """As `batch`, for filters that differ between runs; `ys` has one sequence for all runs or one for each.

    Without `check`, runs are not compared with single runs; with `rounding`, differences by rounding are accepted;
    without `warn`, only `Batch.single` says which components were called once for each run.
    """
    keep_freed_memory()
    filter = filters.one(0)
    single = _not_batched(filter, seeds)
    while "all" not in single:
        try:
            result = _Sweep(filters, ys, seeds, functions or {}, single, check, rounding).run()
            break
        except _CalledSingly as found:
            single[found.slot] = found.reason
    else:
        result = _one_by_one(filters, ys, seeds, functions or {})
    single.update(result.single)
    stated = [slot for slot in _SLOTS if getattr(getattr(filter, slot), "batched", None) is True]
    asked = [slot for slot in ("all", *stated) if stated and slot in single]
    if asked and warn:
        what = "filter" if asked[0] == "all" else asked[0]
        warnings.warn(f"the {what} is called once for each run: {single[asked[0]]}", stacklevel=3)
    return replace(result, single=single)


def batched_slots(filter: ParticleFilter) -> tuple[str, ...] | None:
    """Slots whose components process all runs at once; None if the runs of the filter are made one by one.

    The latter are filters with other components than the four below, with a resampler that compares particles, or
    with one that may return fewer particles. Filters whose components change the number of particles are found when
    they do so, and their runs are made one by one too.
    """
    single = _not_batched(filter, [0])
    if "all" in single:
        return None
    slots = [slot for slot in _SLOTS if getattr(filter, slot) is not None and slot not in single]
    return (*slots, *(["resampler"] if filter.resampler.batched else []))


def _not_batched(filter: ParticleFilter, seeds: list[int]) -> dict[str, str]:
    """Slots that are called once for each run, with the reason."""
    for slot in ("proposal", "lookahead", "rejuvenation", "size"):
        if getattr(filter, slot) is not None:
            return {"all": f"the filter has a {slot}"}
    if filter.initial is None or not isinstance(filter.resampler, WeightResampler) or not filter.resampler.exact_size:
        return {"all": "the resampler needs more than weights, or may return fewer particles"}
    if max(seeds) >= 1 << 128:
        return {"all": "a seed is 2^128 or larger"}
    components = {slot: getattr(filter, slot) for slot in _SLOTS}
    return {slot: "it is not batched" for slot, c in components.items() if c is not None and c.batched is False}


def _one_by_one(
    filters: RunFilters, ys: list[list[Any]], seeds: list[int], functions: Mapping[str, Function]
) -> Batch:
    result = _empty(len(seeds), len(ys[0]))
    states: list[State | None] = []
    for r, seed in enumerate(seeds):
        filter = filters.one(r)
        state: State | None = filter.start(seed)
        try:
            for state, info in filter.iterate(ys[r % len(ys)], seed):
                found = state.log_evidence
                result.log_evidence[r, info.t] = np.nan if found is None else found
                result.ess[r, info.t], result.resampled[r, info.t] = info.ess, info.resampled
                result.record(r, info.t, state.population, functions)
        except LostRunError as error:
            state, result.lost[r] = None, error.message
        except InputError as error:
            raise InputError(f"run {r}, {error.message}", *error.hints) from error
        states.append(state)
    return _finished(result, states, filters.one(0))


def _empty(n_runs: int, n_steps: int) -> Batch:
    nan = np.full((n_runs, n_steps), np.nan)
    return Batch(nan, nan.copy(), np.zeros((n_runs, n_steps), bool), ())


def _finished(result: Batch, states: list[State | None], filter: ParticleFilter) -> Batch:
    for r in result.lost if filter.properly_weighted else ():
        result.log_evidence[r, np.isnan(result.log_evidence[r])] = -np.inf
    return replace(result, states=tuple(states))


class _CalledSingly(Exception):
    """The batch starts again, with a component that is called once for each run; "all" for single runs."""

    def __init__(self, slot: str, reason: str) -> None:
        super().__init__(slot, reason)
        self.slot, self.reason = slot, reason


class _AllLost(Exception):
    """No run is left."""


class _Unlike(Exception):
    """The observations or inputs of some runs do not fit into one array."""


class _Sweep:
    """The steps of R runs; rows are runs that are not lost, with particles (R, n, ...) and log weights (R, n)."""

    def __init__(
        self,
        filters: RunFilters,
        ys: list[list[Any]],
        seeds: list[int],
        functions: Mapping[str, Function],
        single: Mapping[str, str],
        check: bool,
        rounding: bool,
    ) -> None:
        self.filters, self.filter, self.seeds, self.functions = filters, filters.one(0), seeds, functions
        self.ys = [[split_input(y) for y in run] for run in ys]
        self.single, self.rounding, self.check = single, rounding, check
        self.result = _empty(len(seeds), len(ys[0]))
        self.runs = np.arange(len(seeds))  # the run of each row
        self.streams: dict[str, SlotStreams] = {}
        self.checked: dict[str, tuple[int, int]] = {}  # slot -> number of rows at its last check, number of checks
        self.particles: Any = None
        self.log_weights: np.ndarray = np.zeros(0)
        self.top: tuple[Any, Any] = (None, None)  # log weights, and the largest of each run
        self.ancestors: np.ndarray | None = None  # (R, n) parents, of the last step
        #: Effective sample sizes and log mean weights of the rows after the last update.
        self.summary = (np.zeros(0), np.zeros(0))

    def run(self) -> Batch:
        n_steps, states = len(self.ys[0]), [None] * len(self.seeds)  # type: tuple[int, list[State | None]]
        try:
            for t in range(n_steps):
                self.step(t, t == n_steps - 1)
                for row, run in enumerate(self.runs.tolist() if self.functions else ()):
                    self.result.record(run, t, Population(*self.row(row)), self.functions)
        except _AllLost:
            pass
        proper = self.filter.properly_weighted
        for row, r in enumerate(self.runs):
            population = None
            if self.particles is not None:
                parents = {} if self.ancestors is None else {"previous": self.ancestors[row]}
                population = Population(*self.row(row), parents)
            states[r] = State(n_steps, population, Key(self.seeds[r]), proper)
        return _finished(self.result, states, self.filter)

    def row(self, row: int) -> tuple[Any, np.ndarray]:
        """Particles and log weights of one run."""
        return _row(self.particles, row), self.log_weights[row]

    def step(self, t: int, last: bool) -> None:
        """Step t of all runs."""
        filter = self.filter
        if self.particles is None:
            self.apply(t, "initial")
        else:
            if last:
                self.ancestors = np.tile(identity(filter.n), (len(self.runs), 1))
            if filter.resample == "before":
                self.select(t)
            if filter.transition is not None:
                self.apply(t, "transition")
        if filter.update is not None:
            self.apply(t, "update")
        self.summary = summaries(self.log_weights, self.top[1] if self.top[0] is self.log_weights else None)
        self.result.ess[self.runs, t], log_mean = self.summary
        if filter.properly_weighted:
            self.result.log_evidence[self.runs, t] = log_mean
        if filter.resample == "after":
            self.select(t)

    def apply(self, t: int, slot: str) -> None:
        """Call a component for all runs, those with and those without an observation; lost runs are removed."""
        rows = np.arange(len(self.runs))
        if len(self.ys) == 1:
            present, absent = (rows[:0], rows) if self.ys[0][t][0] is None else (rows, rows[:0])
        else:
            missing = np.array([self.given(t, row)[0] is None for row in rows.tolist()])
            present, absent = rows[~missing], rows[missing]
        if slot == "update" and not len(present):
            return
        call = self.each if slot in self.single else self.together
        parts = [
            call(t, slot, rows)
            for rows in (present, absent)
            if len(rows) and not (slot == "update" and rows is absent)
        ]
        if slot == "update" and len(absent):
            parts.append((absent, _row(self.particles, absent), self.log_weights[absent]))
        parts = [part for part in parts if len(part[0])]
        if not parts:
            self.runs = self.runs[:0]
            raise _AllLost
        rows, self.particles, self.log_weights = parts[0] if len(parts) == 1 else _merged(parts)
        if len(rows) < len(self.runs):
            self.runs = self.runs[rows]
            self.ancestors = None if self.ancestors is None else self.ancestors[rows]

    def each(self, t: int, slot: str, rows: np.ndarray) -> tuple[np.ndarray, Any, np.ndarray]:
        """Rows that are not lost, with their particles and log weights, of a component called for each run."""
        kept, found = [], []
        for row in rows.tolist():
            run = int(self.runs[row])
            try:
                population = self.alone(t, slot, row)
            except LostRunError as error:
                self.result.lost[run] = f"step {t}, {slot}: {error.message}"
                continue
            if len(population) != self.filter.n:
                raise _CalledSingly("all", f"the {slot} returns another number of particles")
            kept.append(row)
            found.append(population.realised())
        if not found:
            return rows[:0], None, self.log_weights[:0]
        return np.array(kept), _stacked([p.particles for p in found]), np.stack([p.log_weights for p in found])

    def alone(self, t: int, slot: str, row: int) -> Population:
        """What a component returns for one run; an error names the run."""
        y, u = self.given(t, row)
        component = getattr(self.filters.one(int(self.runs[row])).at_step(t, u), slot)
        rng = Key(self.seeds[self.runs[row]]).child("step", t).child(slot).generator() if component.draws else None
        population = None
        if slot != "initial":
            population = Population(*self.row(row), {"previous": identity(self.filter.n)})
        where = f"run {self.runs[row]}, step {t}, {slot}"
        try:
            return _called(slot, component, rng, population, y, self.filter.n)
        except LostRunError:
            raise
        except InputError as error:
            raise InputError(f"{where}: {error.message}", *error.hints) from error
        except _RAW as error:
            raise InputError(
                f"{where}: {type(error).__name__}: {error}",
                "the run alone, filter.run(observations, seed), raises the same error with its place",
            ) from error

    def together(self, t: int, slot: str, rows: np.ndarray) -> tuple[np.ndarray, Any, np.ndarray]:
        """As `each`, of a component that is called once."""
        try:
            particles, log_weights = self.of_rows(t, slot, rows)
        except _Unlike as reason:
            self.result.single[slot] = f"step {t}: {reason}"
            return self.each(t, slot, rows)
        except Exception as error:
            found = self.each(t, slot, rows)  # raises the error of a run, if there is one
            if isinstance(error, LostRunError):
                return found
            self.refuse(t, slot, f"a call for all runs raises {type(error).__name__}: {error}; single runs do not")
        due = t in _COMPARED_STEPS or t == len(self.ys[0]) - 1 or self.checked.get(slot, (0, 0))[0] != len(rows)
        if self.check and due:
            self.compare(t, slot, rows, particles, log_weights)
        if log_weights is self.log_weights:
            return rows, particles, log_weights
        top = log_weights.max(axis=1)
        if top.min() > -np.inf:
            self.top = log_weights, top
            return rows, particles, log_weights
        for row in rows[top == -np.inf].tolist():
            try:
                self.alone(t, slot, row)
            except LostRunError as error:
                self.result.lost[int(self.runs[row])] = f"step {t}, {slot}: {error.message}"
        alive = top > -np.inf
        return rows[alive], _row(particles, alive), log_weights[alive]

    def of_rows(self, t: int, slot: str, rows: np.ndarray) -> tuple[Any, np.ndarray]:
        """Particles and log weights of a component that is called once for the given rows, in their order."""
        runs, n = self.runs[rows], self.filter.n
        y, u = (self.by_row(rows, t, k) for k in (0, 1))
        component = getattr(self.filters.rows(runs).at_step(t, u), slot)
        rng = RunGenerators(self.states(t, slot, runs), n) if component.draws else None
        population, log_weights = None, self.log_weights
        if slot != "initial":
            everything = len(rows) == len(self.runs) and rows[0] == 0
            particles = self.particles if everything else _row(self.particles, rows)
            log_weights = self.log_weights if everything else self.log_weights[rows]
            population = Population.unchecked(_flat(particles, n), log_weights.ravel())
        found = _called(slot, component, rng, population, y, len(rows) * n)
        if len(found) != len(rows) * n:
            raise InputError(f"{len(rows) * n} particles became {len(found)}")
        same = population is not None and found.log_weights is population.log_weights
        return _by_run(found.particles, n), log_weights if same else found.log_weights.reshape(-1, n)

    def given(self, t: int, row: int) -> tuple[Any, Any]:
        """Observation and input of one run."""
        return self.ys[self.runs[row] % len(self.ys)][t]

    def by_row(self, rows: np.ndarray, t: int, which: int) -> Any:
        """Observation or input of all runs, or one for each row of particles."""
        if len(self.ys) == 1:
            return self.ys[0][t][which]
        found = [self.given(t, row)[which] for row in rows.tolist()]
        if all(value is None for value in found):
            return None
        what = f"the {('observations', 'inputs')[which]} of the runs are not numbers or arrays of one shape"
        try:
            stacked = np.stack([np.asarray(value) for value in found])
        except ValueError:
            raise _Unlike(what) from None
        if stacked.dtype.kind not in "biufc":
            raise _Unlike(what)
        return np.repeat(stacked, self.filter.n, axis=0).view(rows_of(self.filter.n))

    def compare(self, t: int, slot: str, rows: np.ndarray, particles: Any, log_weights: np.ndarray) -> None:
        """Compare runs with single runs: the first and the last, or one in turn; at first all with another order."""
        last, count = self.checked.get(slot, (0, 0))
        self.checked[slot] = len(rows), count + 1
        for k in {count % len(rows)} if last == len(rows) else {0, len(rows) - 1}:
            self.same_scheme(self.filters.one(int(self.runs[rows[k]])))
            try:
                population = self.alone(t, slot, int(rows[k]))
                single = population.realised().particles, population.log_weights
            except LostRunError:
                single = _row(particles, k), np.full(self.filter.n, -np.inf)
            self.agree(t, slot, rows[k], (_row(particles, k), log_weights[k]), single, "alone")
        if count == 0 and len(rows) > 1:
            order = np.roll(np.arange(0, len(rows), math.ceil(len(rows) / _MOST_COMPARED)), 1)
            try:
                found = self.of_rows(t, slot, rows[order])
            except Exception as error:
                self.refuse(t, slot, f"a call for the runs in another order raises {type(error).__name__}: {error}")
            ours = _row(particles, order), log_weights[order]
            if _difference(ours[0], found[0]) is not None or _difference(ours[1], found[1]) is not None:
                for k, row in enumerate(rows[order].tolist()):
                    one = (_row(ours[0], k), ours[1][k]), (_row(found[0], k), found[1][k])
                    self.agree(t, slot, row, *one, "with the runs in another order")

    def same_scheme(self, other: ParticleFilter) -> None:
        """Make single runs if the filter of a run has another number of particles, resampler or trigger."""
        for name in ("n", "resample", "resampler", "trigger"):
            if other is not self.filter and getattr(other, name) != getattr(self.filter, name):
                raise _CalledSingly("all", f"the filters of the runs differ in {name}")

    def agree(self, t: int, slot: str, row: int, ours: tuple[Any, Any], other: tuple[Any, Any], how: str) -> None:
        """Refuse the component if a run differs."""
        for what, a, b in (("particles", ours[0], other[0]), ("log weights", ours[1], other[1])):
            found = _difference(a, b)
            if found is None or (found[0] and self.rounding):
                continue
            if found[0]:
                raise _CalledSingly(slot, f"step {t}: its {what} differ by rounding from those of single runs")
            run = int(self.runs[row])
            self.refuse(t, slot, f"the {what} of run {run} are {found[1]} in the batch, {found[2]} {how}")

    def refuse(self, t: int, slot: str, reason: str) -> NoReturn:
        """Raise InputError if the component states that it is batched; else call it once for each run."""
        if getattr(self.filter, slot).batched is True:
            raise InputError(
                f"step {t}, {slot}: {reason}",
                "with batched=True a component treats each of its rows by itself: no sums over particles, no values "
                "of one run, draws of the shape of the particles",
                "set batched to False, or mend the functions",
            )
        raise _CalledSingly(slot, f"step {t}: {reason}")

    def select(self, t: int) -> None:
        """Resample the runs whose trigger asks for it."""
        ess, log_mean = self.summary
        rows = np.flatnonzero(self.wanted(t, ess))
        self.result.resampled[self.runs[rows], t] = True
        if not len(rows):
            return
        resampler, n = self.filter.resampler, self.filter.n
        assert isinstance(resampler, WeightResampler)
        if resampler.batched:
            streams: Any = RunGenerators(self.states(t, "resampler", self.runs[rows]))
            index, out = resampler.select(streams, self.log_weights[rows], n)
        else:
            keys = [Key(self.seeds[run]).child("step", t).child("resampler") for run in self.runs[rows]]
            weights = [self.log_weights[k] for k in rows.tolist()]
            drawn = [resampler.select(key.generator(), w, n) for key, w in zip(keys, weights, strict=True)]
            index = np.stack([a for a, _ in drawn])
            out = None if drawn[0][1] is None else np.stack([w for _, w in drawn if w is not None])
        self.log_weights = self.log_weights.copy()
        self.log_weights[rows] = log_mean[rows, None] if out is None else out
        if self.ancestors is not None:
            self.ancestors[rows] = np.take_along_axis(self.ancestors[rows], index, axis=1)
        self.particles = _selected(self.particles, rows, index)

    def wanted(self, t: int, ess: np.ndarray) -> np.ndarray:
        """(R,) bool: the runs to resample."""
        trigger, rows = self.filter.trigger, range(len(ess))
        if trigger.batched:
            runs: Any = SimpleNamespace(
                particles=self.particles, log_weights=self.log_weights, ess=ess, log_mean_weight=self.summary[1]
            )
            return np.broadcast_to(trigger.wants(runs, t), len(ess))
        return np.array([trigger.wants(Population(*self.row(k)), t) for k in rows])

    def states(self, t: int, slot: str, runs: np.ndarray) -> np.ndarray:
        """The states of the streams of some runs at a step."""
        if slot not in self.streams:
            self.streams[slot] = SlotStreams(self.seeds, slot, len(self.ys[0]))
        return self.streams[slot].states(t, runs)


def _called(slot: str, component: Any, rng: Any, population: Population | None, y: Any, n: int) -> Population:
    """The population that a component returns."""
    if slot == "initial":
        return component.sample(rng, y, n)
    if slot == "transition":
        return component.predict(rng, population, y)
    return component.update(rng, population, None, y)


def _difference(ours: Any, other: Any) -> tuple[bool, Any, Any] | None:
    """The first difference of two arrays or mappings of arrays, and whether it is rounding; None if there is none."""
    if isinstance(ours, Mapping) and isinstance(other, Mapping):
        if ours.keys() != other.keys():
            return False, sorted(ours), sorted(other)
        found = [d for d in (_difference(ours[name], other[name]) for name in ours) if d is not None]
        return min(found, key=lambda d: d[0], default=None)
    a, b = np.asarray(ours), np.asarray(other)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False, f"{a.dtype} {a.shape}", f"{b.dtype} {b.shape}"
    unequal = (a != b) & ~((a != a) & (b != b))
    if not unequal.any():
        return None
    close = a.dtype.kind in "fc" and np.allclose(a, b, rtol=1e-9, atol=1e-12, equal_nan=True)
    where = tuple(np.argwhere(unequal)[0])
    return close, a[where], b[where]


def summaries(log_weights: np.ndarray, top: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Effective sample sizes (R,) and log mean weights (R,) of log weights (R, n); the numbers of `Population`.

    `top` are the largest log weights (R,), if they are known.
    """
    top = log_weights.max(axis=1) if top is None else top
    weights = log_weights - top[:, None]
    np.exp(weights, out=weights)
    totals = weights.sum(axis=1)
    ess = totals * totals / np.vecdot(weights, weights)
    # `math.log`, as for a single population: numpy's may differ in the last bit.
    logs = np.fromiter(map(math.log, (totals / log_weights.shape[1]).tolist()), np.float64, len(totals))
    return ess, top + logs


def _flat(particles: Any, n: int) -> Any:
    """Particles (R n, ...) of particles (R, n, ...)."""
    if isinstance(particles, dict):
        return {name: _flat(a, n) for name, a in particles.items()}
    if isinstance(particles, np.ndarray):
        return particles.reshape(-1, *particles.shape[2:]).view(rows_of(n))
    raise InputError("the particles are objects")


def _by_run(particles: Any, n: int) -> Any:
    """Particles (R, n, ...) of particles (R n, ...)."""
    if isinstance(particles, dict):
        return {name: _by_run(a, n) for name, a in particles.items()}
    if isinstance(particles, np.ndarray):
        return np.asarray(particles).reshape(-1, n, *particles.shape[1:])
    return [tuple(particles[k : k + n]) for k in range(0, len(particles), n)]


def _merged(parts: list[tuple[np.ndarray, Any, np.ndarray]]) -> tuple[np.ndarray, Any, np.ndarray]:
    """The rows of several parts in order, with their particles and log weights."""
    order = np.argsort(np.concatenate([rows for rows, _, _ in parts]))

    def joined(arrays: list[Any]) -> Any:
        if isinstance(arrays[0], dict):
            return {name: joined([a[name] for a in arrays]) for name in arrays[0]}
        if isinstance(arrays[0], np.ndarray):
            return np.concatenate(arrays)[order]
        sets = [s for part in arrays for s in part]
        return [sets[k] for k in order]

    rows, log_weights = (joined([part[k] for part in parts]) for k in (0, 2))
    return rows, joined([particles for _, particles, _ in parts]), log_weights


def _row(particles: Any, row: Any) -> Any:
    """Particles of one run, or of the runs of an index or a mask."""
    if isinstance(particles, dict):
        return {name: a[row] for name, a in particles.items()}
    if isinstance(particles, np.ndarray):
        return particles[row]
    if isinstance(row, np.ndarray) and row.ndim:
        return [particles[k] for k in (np.flatnonzero(row) if row.dtype == bool else row)]
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
