"""Processes many runs of one filter together, as arrays (run, particle, ...).

`mstfilter.smc.run_many` uses this module if all components can process the particles of several runs in one call.

Each component is called once per step with the n particles of all R runs, as one population of R n particles, if its
attribute `batched` is True or None. A component must treat each row independently, and draw arrays in the shape of
its arguments, as in ``x + rng.standard_normal(x.shape)``. `RunGenerators` draws the rows of a run from the random
stream of the run.

Some runs of the batch are compared with single runs at steps 0, 1, 2, 5, 12, 29, ..., at the last step, and when the
number of runs changes. If results differ by more than rounding and the component states ``batched=True``, InputError
is raised. For any other difference, `NotTogether` is raised with the reason, and the runs must be made one by one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np

from mstfilter.errors import InputError, LostRunError
from mstfilter.smc.filter import ParticleFilter, keep_freed_memory
from mstfilter.smc.history import Collector, check_one_shape, ess, log_evidence, resampled, stacked
from mstfilter.smc.inputs import same_component, split_input
from mstfilter.smc.interfaces import Info, State, WeightResampler
from mstfilter.smc.population import Population, identity
from mstfilter.smc.streams import Key, RunGenerators, RunKeys, each_array, of_runs, rows_of, summaries

#: Steps at which runs are compared: the Pell numbers 0, 1, 2, 5, 12, 29, 70, ... Unlike powers of two, they also find
#: a fault of every third step.
_COMPARED_STEPS = frozenset(round((1 + math.sqrt(2)) ** k / math.sqrt(8)) for k in range(40))
_SLOTS = ("initial", "transition", "update")


class NotTogether(Exception):
    """Raised if the runs must be made one by one."""

    def __init__(self, slot: str, reason: str) -> None:
        super().__init__(slot, reason)
        self.slot, self.reason = slot, reason


@dataclass(frozen=True)
class RunFilters:
    """The filters of some runs. The components of two runs may have different parameters."""

    one: Callable[[int], ParticleFilter]  #: the filter of a run
    rows: Callable[[np.ndarray], ParticleFilter]  #: one filter for the particles of the given runs, in this order


@dataclass(frozen=True)
class Collected:
    """The collected values of one run."""

    rows: dict[str, np.ndarray]  #: name -> (t, ...), up to the last step or the step at which the run is lost
    lost: str = ""  #: why the run is lost (all weights are zero); "" if it is not


def check_together(filter: ParticleFilter) -> None:
    """Raise `NotTogether` if a component of the filter cannot process several runs together."""
    for slot in ("proposal", "lookahead", "rejuvenation", "size"):
        if getattr(filter, slot) is not None:
            raise NotTogether(slot, f"the filter has a {slot}")
    if filter.initial is None or not isinstance(filter.resampler, WeightResampler) or not filter.resampler.exact_size:
        raise NotTogether("resampler", "it needs more than weights, or may return fewer particles")
    for slot in _SLOTS:
        component = getattr(filter, slot)
        if component is not None and component.batched is False:
            raise NotTogether(slot, "it is not batched")


def run_together(
    filters: RunFilters,
    ys: list[Any],
    seeds: list[int],
    collectors: Mapping[str, Collector],
    check: bool = True,
    rounding: bool = False,
) -> list[Collected]:
    """Results of the runs with the given seeds and the observations `ys`.

    If `check` is True, some runs are compared with single runs. With `rounding`, they may differ by rounding.

    Raises `NotTogether` if the runs must be made one by one. Raises InputError if a component that states
    ``batched=True`` lets runs affect each other.
    """
    keep_freed_memory()
    check_together(filters.one(0))
    return _Sweep(filters, ys, seeds, collectors, check, rounding).run()


class _RunInfo(Info):
    """The `Info` of one step of a batched run, which collectors read."""

    def __getattr__(self, name: str) -> Any:
        if name in ("notes", "seconds"):
            raise NotTogether("collector", f"it reads the {name} of the components")
        raise AttributeError(name)


class _Sweep:
    """The steps of R runs, with particles (R, n, ...) and log weights (R, n). Runs of zero weight are removed."""

    def __init__(
        self,
        filters: RunFilters,
        ys: list[Any],
        seeds: list[int],
        collectors: Mapping[str, Collector],
        check: bool,
        rounding: bool,
    ) -> None:
        self.filters, self.filter, self.seeds, self.collectors = filters, filters.one(0), seeds, collectors
        self.check, self.rounding = check, rounding
        self.given = [split_input(y) for y in ys]
        self.n_steps = len(ys)
        self.streams = RunKeys([Key(seed) for seed in seeds])
        self.runs = np.arange(len(seeds))  # the run of each row
        self.particles: Any = None
        self.log_weights = self.ess = self.log_mean = np.zeros(0)  # the last two after the last update
        self.top: tuple[Any, Any] = (None, None)  # log weights, and the largest of each run
        self.resampled = np.zeros(len(seeds), bool)
        self.ancestors: np.ndarray | None = None  # (R, n) of the resampling of the step, if a collector sees them
        self.traced = not set(collectors.values()) <= {log_evidence, ess, resampled}
        self.checked: dict[str, tuple[int, int]] = {}  # slot -> number of rows at its last check, number of checks
        self.lost: dict[int, tuple[int, str]] = {}  # run -> step, reason
        self.found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in collectors}

    def run(self) -> list[Collected]:
        """Make all steps of the runs."""
        for t in range(self.n_steps):
            self.step(t)
            if not len(self.runs):
                break
            self.record(t)
        tables = {name: self.table(name) for name in self.collectors}
        runs = []
        for r in range(len(self.seeds)):
            end, reason = self.lost.get(r, (self.n_steps, ""))
            runs.append(Collected({name: table[:end, r] for name, table in tables.items()}, reason))
        return runs

    def step(self, t: int) -> None:
        """Step t of all runs, as in `ParticleFilter.step` without the components that need single runs."""
        filter, runs = self.filter, len(self.runs)
        self.resampled = np.zeros(runs, bool)
        self.ancestors = np.tile(identity(filter.n), (runs, 1)) if self.traced else None
        if t == 0:
            self.call(t, "initial")
        else:
            if filter.resample == "before":
                self.select(t)
            if filter.transition is not None:
                self.call(t, "transition")
        if filter.update is not None and self.given[t][0] is not None and len(self.runs):
            self.call(t, "update")
        if len(self.runs):
            top = self.top[1] if self.top[0] is self.log_weights else None
            self.ess, self.log_mean = summaries(self.log_weights, top)
        if filter.resample == "after" and len(self.runs):
            self.select(t)

    # --- calls of components --------------------------------------------------------------------------------------
    def call(self, t: int, slot: str) -> None:
        """Call a component for all runs, and remove the runs in which all weights become 0."""
        rows = np.arange(len(self.runs))
        try:
            particles, log_weights = self.together(t, slot)
        except NotTogether:
            raise
        except LostRunError:  # all weights of all runs are 0
            self.lose(t, slot, rows)
            self.runs = self.runs[:0]
            return
        except Exception as error:
            self.refuse_error(t, slot, error)
        if log_weights is not self.log_weights:
            top = log_weights.max(axis=1)
            if top.min() == -np.inf:
                rows = np.flatnonzero(top > -np.inf)
                self.lose(t, slot, np.flatnonzero(top == -np.inf))
                particles, log_weights, top = of_runs(particles, rows), log_weights[rows], top[rows]
            self.top = log_weights, top
        if len(rows):
            self.compare(t, slot, rows, particles, log_weights)
        self.particles, self.log_weights = particles, log_weights
        if len(rows) < len(self.runs):
            self.runs, self.resampled = self.runs[rows], self.resampled[rows]
            self.ancestors = None if self.ancestors is None else self.ancestors[rows]

    def together(self, t: int, slot: str) -> tuple[Any, np.ndarray]:
        """Particles and log weights that a component returns in one call for all runs."""
        (y, u), n = self.given[t], self.filter.n
        component = getattr(self.filters.rows(self.runs).at_step(t, u), slot)
        rng = RunGenerators(self.streams.generators(slot, t, self.runs), n) if component.draws else None
        population = None
        if slot != "initial":
            population = Population.unchecked(self.flat(self.particles), self.log_weights.ravel())
        found = _called(slot, component, rng, population, y, len(self.runs) * n)
        if len(found) != len(self.runs) * n:
            raise InputError(f"{len(self.runs) * n} particles became {len(found)}")
        same = population is not None and found.log_weights is population.log_weights
        particles = each_array(lambda a: np.asarray(a).reshape(-1, n, *a.shape[1:]), found.particles)
        return particles, self.log_weights if same else found.log_weights.reshape(-1, n)

    def flat(self, particles: Any) -> Any:
        """Particles (R n, ...) of all runs."""
        return each_array(lambda a: a.reshape(-1, *a.shape[2:]).view(rows_of(self.filter.n)), particles)

    def alone(self, t: int, slot: str, row: int) -> Population:
        """The result of a component for one run. Raises LostRunError, or `NotTogether` for any other error."""
        y, u = self.given[t]
        component = getattr(self.filters.one(int(self.runs[row])).at_step(t, u), slot)
        rng = self.key(t, slot, row).generator() if component.draws else None
        population = None
        if slot != "initial":
            particles, log_weights = of_runs(self.particles, row), self.log_weights[row]
            population = Population(particles, log_weights, {"previous": identity(self.filter.n)})
        try:
            return _called(slot, component, rng, population, y, self.filter.n).realised()
        except LostRunError:
            raise
        except Exception as error:
            raise NotTogether(slot, f"step {t}: a run raises {type(error).__name__}") from error

    def lose(self, t: int, slot: str, rows: np.ndarray) -> None:
        """Record the reason why all weights of the given runs are zero after the call of a component."""
        for row in rows.tolist():
            try:
                self.alone(t, slot, row)
            except LostRunError as error:
                self.lost[int(self.runs[row])] = t, f"step {t}, {slot}: {error.message}"
            else:
                self.refuse(t, slot, f"all weights of run {self.runs[row]} are 0 in the batch, but not alone")

    # --- checks ---------------------------------------------------------------------------------------------------
    def compare(self, t: int, slot: str, rows: np.ndarray, particles: Any, log_weights: np.ndarray) -> None:
        """At some steps, compare one or two of the runs with single runs."""
        for k in self.compared(t, slot, len(rows)):
            run = int(self.runs[rows[k]])
            self.same_scheme(self.filters.one(run))
            try:
                alone = self.alone(t, slot, int(rows[k]))
            except LostRunError:
                self.refuse(t, slot, f"all weights of run {run} are 0 alone, but not in the batch")
            self.agree(t, slot, run, "particles", of_runs(particles, k), alone.particles)
            self.agree(t, slot, run, "log weights", log_weights[k], alone.log_weights)

    def compared(self, t: int, slot: str, n_rows: int) -> set[int]:
        """The rows, of `n_rows`, that are compared with single runs at this step."""
        last, count = self.checked.get(slot, (0, 0))
        if not self.check or (t not in _COMPARED_STEPS and t != self.n_steps - 1 and last == n_rows):
            return set()
        self.checked[slot] = n_rows, count + 1
        return {count % n_rows} if last == n_rows else {0, n_rows - 1}

    def same_scheme(self, other: ParticleFilter) -> None:
        """Raise `NotTogether` if the filter of a run has another number of particles, resampler or trigger."""
        for name in ("n", "resample", "resampler", "trigger"):
            if not same_component(getattr(other, name), getattr(self.filter, name)):
                raise NotTogether("all", f"the filters of the runs differ in {name}")

    def agree(self, t: int, slot: str, run: int, what: str, ours: Any, alone: Any) -> None:
        """Raise an error if the batch and the single run give different results for a run."""
        found = difference(ours, alone)
        if found is None or (found[0] and self.rounding):
            return
        if found[0]:
            raise NotTogether(slot, f"step {t}: its {what} differ by rounding from those of single runs")
        self.refuse(t, slot, f"the {what} of run {run} are {found[1]} in the batch, {found[2]} alone")

    def refuse_error(self, t: int, slot: str, error: Exception) -> NoReturn:
        """Raise `NotTogether` if a single run also raises an error; otherwise call `refuse`."""
        for row in range(len(self.runs)):
            with suppress(LostRunError):
                self.alone(t, slot, row)
        self.refuse(t, slot, f"a call for all runs raises {type(error).__name__}: {error}; single runs do not")

    def refuse(self, t: int, slot: str, reason: str) -> NoReturn:
        """Raise InputError if the component states ``batched=True``, otherwise `NotTogether`."""
        if getattr(self.filter, slot).batched is True:
            raise InputError(
                f"step {t}, {slot}: {reason}",
                "with batched=True a component treats each of its rows by itself: no sums over particles, no values "
                "of one run, draws of the shape of the particles",
                "set batched to False, or mend the functions",
            )
        raise NotTogether(slot, f"step {t}: {reason}")

    # --- resampling -----------------------------------------------------------------------------------------------
    def select(self, t: int) -> None:
        """Resample the runs that the trigger chooses."""
        self.resampled = np.array(np.broadcast_to(self.wanted(t), len(self.runs)))
        rows = np.flatnonzero(self.resampled)
        if not len(rows):
            return
        index, out = self.selected(t, rows)
        self.log_weights = _with_rows(self.log_weights, rows, self.log_mean[rows, None] if out is None else out)
        if out is not None:
            self.log_mean = self.log_mean.copy()  # `record` keeps the array of the step before
            self.log_mean[rows] = summaries(out)[1]
        if self.ancestors is not None:
            self.ancestors[rows] = index
        self.particles = each_array(lambda a: _with_rows(a, rows, a[rows[:, None], index]), self.particles)

    def wanted(self, t: int) -> Any:
        """(R,) bool, or one bool for all runs: whether the trigger resamples the run."""
        trigger = self.filter.trigger
        if trigger.batched:
            runs: Any = SimpleNamespace(
                particles=self.particles, log_weights=self.log_weights, ess=self.ess, log_mean_weight=self.log_mean
            )
            found = np.broadcast_to(np.asarray(trigger.wants(runs, t), bool), len(self.runs))
            for row in self.compared(t, "trigger", len(self.runs)):
                self.agree(t, "trigger", int(self.runs[row]), "answer", found[row], np.bool_(self.wants(t, row)))
            return found
        return [self.wants(t, row) for row in range(len(self.runs))]

    def wants(self, t: int, row: int) -> bool:
        """Whether the trigger resamples one run."""
        return bool(self.filter.trigger.wants(Population(of_runs(self.particles, row), self.log_weights[row]), t))

    def selected(self, t: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Ancestors (len(rows), n) and log weights of the runs `rows`, as `WeightResampler.select` returns them."""
        resampler, n = self.filter.resampler, self.filter.n
        assert isinstance(resampler, WeightResampler)
        if not resampler.batched:
            drawn = [self.selected_alone(t, row) for row in rows.tolist()]
            out = [log_weights for _, log_weights in drawn if log_weights is not None]
            return np.stack([index for index, _ in drawn]), np.stack(out) if out else None
        streams: Any = RunGenerators(self.streams.generators("resampler", t, self.runs[rows]))
        index, found = resampler.select(streams, self.log_weights[rows], n)
        if np.shape(index) != (len(rows), n):
            raise NotTogether("resampler", f"step {t}: ancestors have shape {np.shape(index)}, not {(len(rows), n)}")
        for k in self.compared(t, "resampler", len(rows)):
            row = int(rows[k])
            run, (alone, weights) = int(self.runs[row]), self.selected_alone(t, row)
            self.agree(t, "resampler", run, "ancestors", index[k], alone)
            equal = np.full(n, self.log_mean[row])
            ours, single = (equal if one is None else one for one in (None if found is None else found[k], weights))
            self.agree(t, "resampler", run, "log weights", ours, single)
        return index, found

    def selected_alone(self, t: int, row: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Ancestors (n,) and log weights of one run."""
        resampler, n = self.filter.resampler, self.filter.n
        assert isinstance(resampler, WeightResampler)
        index, log_weights = resampler.select(self.key(t, "resampler", row).generator(), self.log_weights[row], n)
        if len(index) != n:
            raise NotTogether("resampler", f"step {t}: it returns {len(index)} particles of {n}")
        return index, log_weights

    # --- results --------------------------------------------------------------------------------------
    def key(self, t: int, slot: str, row: int) -> Key:
        """The key of the random stream of a component in one run."""
        return self.streams.keys[self.runs[row]].child(slot, t)

    def record(self, t: int) -> None:
        """Store the results of the collectors for each run."""
        log_mean = self.log_mean if self.filter.properly_weighted else np.full(len(self.runs), np.nan)
        quick: dict[Collector, np.ndarray] = {log_evidence: log_mean, ess: self.ess, resampled: self.resampled}
        steps = [self.seen(t, row) for row in range(len(self.runs))] if self.traced else []
        for name, collector in self.collectors.items():
            values = quick.get(collector)
            if values is None:
                try:
                    values = stacked(name, [np.asarray(collector(*step)) for step in steps])
                except InputError as error:  # a single run names the seed
                    raise NotTogether("collector", error.message) from error
            self.found[name].append((self.runs, values))

    def seen(self, t: int, row: int) -> tuple[State, Info]:
        """State and `Info` of a run after step t."""
        assert self.ancestors is not None
        filter, ancestors = self.filter, self.ancestors[row]
        parents = {"previous": ancestors} if t else {}
        if filter.resample == "after" and self.resampled[row]:
            parents["ancestor"] = ancestors
        population = Population(of_runs(self.particles, row), self.log_weights[row], parents)
        info = object.__new__(_RunInfo)
        info.__dict__.update(
            t=t, n=filter.n, n_candidates=filter.n, ess=float(self.ess[row]), resampled=bool(self.resampled[row])
        )
        return State(t + 1, population, self.streams.keys[self.runs[row]], filter.properly_weighted), info

    def table(self, name: str) -> np.ndarray:
        """Results (T, R, ...) of a collector. The entries of a run are undefined after all its weights are zero."""
        steps = self.found[name]
        check_one_shape(name, [values.shape[1:] for _, values in steps])
        shape = steps[0][1].shape[1:] if steps else ()
        kind = np.result_type(*(values for _, values in steps)) if steps else np.dtype(float)
        table = np.zeros((len(steps), len(self.seeds), *shape), kind)
        for t, (runs, values) in enumerate(steps):
            table[t, runs] = values
        return table


def _with_rows(a: np.ndarray, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A copy of an array with other values in some rows."""
    if values.shape == a.shape:
        return values
    out = a.copy()
    out[rows] = values
    return out


def _called(slot: str, component: Any, rng: Any, population: Population | None, y: Any, n: int) -> Population:
    """The population that a component returns."""
    if slot == "initial":
        return component.sample(rng, y, n)
    if slot == "transition":
        return component.predict(rng, population, y)
    return component.update(rng, population, None, y)


def difference(ours: Any, other: Any) -> tuple[bool, Any, Any] | None:
    """Whether the first difference of two arrays (or mappings) is rounding, and the two values; None if identical."""
    if ours is other:
        return None
    if isinstance(ours, Mapping) and isinstance(other, Mapping):
        if ours.keys() != other.keys():
            return False, sorted(ours), sorted(other)
        found = [d for d in (difference(ours[name], other[name]) for name in ours) if d is not None]
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
