"""Checks that a program treats particles independently and draws random numbers only by `sample`.

By mistake a program may mix particles (``x.mean()``, ``previous["x"][0]``), draw from another generator, or keep
values between steps. Steps of each kind (first, later, without observation) are counted, and the steps 1,
2, and 8^k + k (9, 66, 515, ...) are checked. These numbers have all remainders modulo 3, so a fault in every third
step is detected. A check has three parts:

1. Steps 1 and 2 are repeated with the same random numbers. Values and log weights must agree up to rounding.
2. A few particles run alone with the same drawn values. Distributions and returned values of a particle must not
   change. Particles with small and with large values are chosen, to detect a maximum or ``any`` over particles. A run
   of few particles also detects an event axis used as the particle axis.
3. If there is a guide, particles are also drawn from the model. The guide must be able to draw the values of the
   model, and the two estimates of the evidence must agree.

The results of a filter do not depend on these checks.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from mstfilter.errors import InputError, InputWarning
from mstfilter.fields import copied
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.population import Population, log_mean_exp, normalise, take
from mstfilter.smc.programs.handlers import GivenHandler, SampleHandler
from mstfilter.smc.programs.sites import Call, ProgramRun, recorded
from mstfilter.smc.streams import child

#: Numbers of the steps of one kind that are checked.
_CHECKED = frozenset({1, 2, *(8**k + k for k in range(1, 12))})
#: Differences that count as rounding: single-precision networks give other digits for other numbers of rows.
_LOG_DENSITY, _VALUE = 1e-3, 1e-5
_ALONE = (
    "each particle is processed as if it were alone: reduce over entries with axis=1, not over the particles",
    'previous["x"] has one row for each particle, in a branch of switch as an argument; draw by sample(...) only',
    "arrays (n, 1) and (n,) combine to (n, n): use x[:, 0], or z[:, None]",
)
_REPEAT = (
    "draw by sample(...) only, not by numpy.random, random or another generator",
    "return values that the next step needs; do not keep them in global variables, closures or the observation",
)

Run = Callable[..., ProgramRun]  #: of a function, a handler, the previous particles, an observation and n


class Guard:
    """The checks of one step of a program."""

    def __init__(
        self, rng: np.random.Generator, past: Population | None, observation: Any, model: Any, guide: Any, count: int
    ) -> None:
        self.rng, self.past, self.observation, self.model, self.guide = rng, past, observation, model, guide
        self.previous, self.count = None if past is None else past.particles, count
        self.state = rng.bit_generator.state
        #: Copies of the model and the guide, made before the step: objects may keep values between calls.
        self.fresh = {id(f): copied(f) for f in (model, guide) if f is not None} if count <= 2 else {}

    def checked(self, run: Run, step: Callable[[], Any]) -> Any:
        """The particles and log weight changes that ``step()`` returns. Raises InputError if a check fails."""
        with recorded() as runs:
            particles, gain = step()
        if self.count <= 2:
            self._repeat(step, particles, gain)
        for whole in runs:
            for rows in _groups(whole) if whole.n > 1 else ():
                self._check_alone(run, whole, rows)
        if self.guide is not None and len(gain) >= 100:
            self._check_guide(run, gain)
        return particles, gain

    # --- the same random numbers ------------------------------------------------------------------------------------
    def _repeat(self, step: Callable[[], Any], particles: Any, gain: np.ndarray) -> None:
        self.rng.bit_generator.state = self.state
        try:
            again, gain_again = step()
        except Exception as error:
            message = f"the step fails when it is repeated with the same random numbers: {error}"
            raise InputError(message, *_REPEAT) from error
        what = _first_difference({**particles, "log weights": gain}, {**again, "log weights": gain_again})
        if what is not None:
            raise InputError(f"{what} differ when the step is repeated with the same random numbers", *_REPEAT)

    # --- a few particles alone --------------------------------------------------------------------------------------
    def _check_alone(self, run: Run, whole: ProgramRun, rows: np.ndarray) -> None:
        """Compare some particles of a run with the same particles in a run of only these particles."""
        few = self._run_alone(run, whole, rows)
        for call in few.calls or ():
            if call.distribution is not None:
                _check_density(call.what, call.distribution, self.rng)
        alone = {(c.what, c.k): c for c in few.calls or ()}
        for call in whole.calls or ():
            _compare(call, alone.pop((call.what, call.k), None), rows)
        for call in alone.values():
            if call.size:
                raise InputError(f"{call.what} is reached by particle {rows[0]} alone only", *_ALONE)
        for name, values in whole.returned.items():
            _compare_returned(name, values, few.returned.get(name, values[rows]), rows)

    def _run_alone(self, run: Run, whole: ProgramRun, rows: np.ndarray) -> ProgramRun:
        """Run only some particles, with the values of the whole run."""
        previous = None if self.previous is None else take(self.previous, rows)
        handler = GivenHandler(whole.values, rows, weigh=False)
        fresh = self.fresh.get(id(whole.function))
        function = whole.function if fresh is None else copied(fresh)
        try:
            with recorded():
                return run(function, handler, previous, self.observation, len(rows))
        except Exception as error:
            hints = error.hints if isinstance(error, InputError) else ()
            message = f"the step fails for particles {sorted(set(rows.tolist()))} alone: {error}"
            raise InputError(message, *hints, *_ALONE) from error

    # --- the guide --------------------------------------------------------------------------------------------------
    def _check_guide(self, run: Run, gain: np.ndarray) -> None:
        """Check that the guide can draw what the model draws, and compare the two estimates of the evidence."""
        n, old = len(gain), 0.0 if self.past is None else self.past.log_weights
        try:
            drawn = run(self.model, SampleHandler(child(self.rng, "guard")), self.previous, self.observation, n)
        except InputError:
            return  # the model cannot weight its own draws
        by_model, by_guide = old + drawn.gain, old + gain
        if not (np.isfinite(by_model.max()) and np.isfinite(by_guide.max())):
            return
        weights = normalise(by_model)
        with recorded() as runs, suppress(InputError):  # the guide draws sites that the model does not reach
            run(self.guide, GivenHandler(drawn.values, weigh=False), self.previous, self.observation, n)
        for call in runs[0].calls or ():
            never = call.densities(call.value) == -np.inf
            missed = float(weights[call.reached][never].sum())
            if missed > 1e-3:
                raise InputError(
                    f"{call.what}: the guide never draws values that hold {missed:.1%} of the posterior probability",
                    "its distribution must reach wherever that of the model times the likelihood does",
                )
        spread, spread_guide = (float((w**2).sum()) - 1 / n for w in (weights, normalise(by_guide)))
        gap = log_mean_exp(by_guide) - log_mean_exp(by_model)
        both = spread + spread_guide
        if (both < 0.02 and abs(gap) > 0.1 + 10 * np.sqrt(both)) or (
            spread < 0.02 and gap < -1 - 10 * np.sqrt(spread)
        ):
            warnings.warn(
                InputWarning(
                    f"the guide and the model give estimates of the evidence that differ by {gap:.2f} nats",
                    "a guide that is narrower than the posterior loses a part of it: use a wider one",
                    "or is log_prob of a distribution wrong?",
                ),
                stacklevel=2,
            )


class Schedule(Counter[Any]):
    """Counts the steps of each kind for a model and its guide. Programs with the same functions share the counts."""

    @classmethod
    def of(cls, model: Any, guide: Any) -> Schedule:
        if len(_SCHEDULES) > 200:
            _SCHEDULES.clear()
        kept = [*_parts(model), *_parts(guide)]
        key = tuple(value if isinstance(value, str | int | bool | None) else id(value) for value in kept)
        return _SCHEDULES.setdefault(key, (cls(), kept))[0]  # no other object gets the id of a kept one

    def guard(
        self, rng: np.random.Generator, past: Population | None, observation: Any, model: Any, guide: Any
    ) -> Guard | None:
        """A `Guard` if the next step must be checked, otherwise None."""
        shape = observation.shape if type(observation) is np.ndarray else None
        kind = (past is None, observation is None, guide is None, shape)
        self[kind] += 1
        return Guard(rng, past, observation, model, guide, self[kind]) if self[kind] in _CHECKED else None


_SCHEDULES: dict[tuple[Any, ...], tuple[Schedule, list[Any]]] = {}


def _parts(function: Any) -> list[Any]:
    """The code of a function, and the values of its closure and defaults except floats and arrays.

    Models that differ only in their parameter values, as in PMMH, have the same parts.
    """
    while isinstance(function, partial):
        function = function.func
    values = [*(getattr(function, "__defaults__", None) or ())]
    for cell in getattr(function, "__closure__", None) or ():
        with suppress(ValueError):  # an empty cell
            values.append(cell.cell_contents)
    return [getattr(function, "__code__", function), *(v for v in values if not isinstance(v, float | np.ndarray))]


def _groups(run: ProgramRun) -> list[np.ndarray]:
    """Two groups of particles to run alone: particles with small and with large values, from every branch."""
    numbers = next((v for v in run.values.values() if v.dtype.kind == "f" and v.size), None)
    column = np.arange(run.n) if numbers is None else numbers.reshape(run.n, -1)[:, 0]
    order, size = np.argsort(column), max(run.n // 3, 1)
    return [_group(run, part) for part in (order[:size], order[: -size - 1 : -1])]


def _group(run: ProgramRun, part: np.ndarray) -> np.ndarray:
    """Choose some, but not all, particles of `part`: at least two, because one row could be broadcast."""
    rows = list(part[[len(part) // 2, 0, len(part) // 4]])
    for call in run.calls or ():
        if call.rows is not None and len(rows) < 8:
            reached = part[np.isin(part, call.rows)]
            rows += [*reached[len(reached) // 2 :][:1]]
    return np.array(rows[: len(rows) - (len(rows) == run.n)])


def _close(a: Any, b: Any, tolerance: float, scale: Any = 0.0) -> np.ndarray:
    """Whether entries are equal up to a relative tolerance; NaN equals NaN."""
    a, b = np.asarray(a), np.asarray(b)
    equal = np.asarray(a == b)
    if equal.all():  # the usual case
        return equal
    equal |= (a != a) & (b != b)
    if a.dtype.kind not in "fc" or b.dtype.kind not in "fc":
        return equal
    with np.errstate(invalid="ignore", over="ignore"):
        return equal | (abs(a - b) <= tolerance * (scale + np.maximum(abs(a), abs(b))))


def _spread(values: np.ndarray) -> Any:
    """Range of the finite values of all particles, used as the unit of rounding errors."""
    if values.dtype.kind != "f":
        return 0.0
    finite = values[np.isfinite(values)]
    return np.ptp(finite) if finite.size else 0.0


def _first_difference(particles: Mapping[str, np.ndarray], again: Mapping[str, np.ndarray]) -> str | None:
    """The first name with different values in two populations."""
    if list(particles) != list(again):
        return f"the names {sorted(set(particles) ^ set(again))}"
    pairs = ((name, np.asarray(a), np.asarray(again[name])) for name, a in particles.items())
    different = (name for name, a, b in pairs if a.shape != b.shape or not _close(a, b, 1e-9).all())
    return next((f"values of {name!r}" for name in different), None)


def _compare(call: Call, alone: Call | None, rows: np.ndarray) -> None:
    """Raise InputError unless the particles `rows` have the same log densities among all particles and alone."""
    position = call.positions(rows)
    here, there = np.flatnonzero(position >= 0), range(0) if alone is None else alone.reached
    among = call.densities(call.value)
    if alone is None or list(here) != list(there):
        left_out = np.setdiff1d(here, there)
        if np.setdiff1d(there, here).size or (call.distribution is None and among[position[left_out]].any()):
            raise InputError(f"{call.what} is not reached by the same particles among the others and alone", *_ALONE)
        return
    if not len(here):
        return
    k = position[here]
    pairs = [(among, alone.densities(alone.value))]
    if call.distribution is not None:
        other = call.value[k[0] - 1]  # the value of another particle
        values = [np.full(c.value.shape, other, c.value.dtype) for c in (call, alone)]
        pairs.append((call.densities(values[0]), alone.densities(values[1])))
    for found, expected in pairs:
        different = ~_close(found[k], expected, _LOG_DENSITY, 1.0)
        if different.any():
            i = int(np.argmax(different))
            raise InputError(
                f"{call.what}: particle {rows[here[i]]} has log density {found[k][i]:.6g} among the others, "
                f"{expected[i]:.6g} alone",
                *_ALONE,
            )


def _compare_returned(name: str, values: np.ndarray, alone: np.ndarray, rows: np.ndarray) -> None:
    """Raise InputError unless the particles `rows` have the same returned values among all particles and alone."""
    if alone.shape[1:] != values.shape[1:]:
        raise InputError(f"returned {name!r} has rows of shape {values.shape[1:]}, alone {alone.shape[1:]}", *_ALONE)
    different = ~_close(values[rows], alone, _VALUE, _spread(values))
    if different.any():
        i = tuple(np.argwhere(different)[0])
        raise InputError(
            f"returned {name!r} of particle {rows[i[0]]} is {values[rows][i]} among {len(values)} particles, "
            f"{alone[i]} alone",
            *_ALONE,
        )


# --- distributions of the user --------------------------------------------------------------------------------------
_KNOWN: set[type] = set()


def _check_density(what: str, distribution: Distribution, rng: np.random.Generator) -> None:
    """Raise InputError if the draws of a user's scalar distribution do not have its density.

    Each class is checked once. For 1000 sorted draws, the integral of the density from the least draw may differ from
    the empirical distribution function by less than .12. If the bounds of the integral hold, the false-alarm rate is
    1e-12 (Dvoretzky, Kiefer, Wolfowitz). A part of the density that no draw reaches is not tested, nor is a pole.
    """
    kind = type(distribution)
    if kind.__module__.startswith("mstfilter.") or kind in _KNOWN or distribution.event_shape:
        return
    n = (distribution.parameter_shape or (1,))[0]
    if n == 0:
        return
    generator, row = child(rng, "guard", "density"), n // 2
    # Draws of one row; a distribution that all particles share draws them in one call.
    calls, size = (1000, n) if n > 1 else (1, 1000)
    draws = np.array([distribution.sample(generator, size) for _ in range(calls)])
    x = np.sort(draws[:, row] if n > 1 else draws[0])

    def density(values: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            found = [np.broadcast_to(distribution.log_prob(np.full(n, v, x.dtype)), n)[row] for v in values]
        return np.exp(found)

    if distribution.discrete:
        values, counts = np.unique(x, return_counts=True)
        p = density(values)
        distance, total = float(abs(counts / len(x) - p).max()), float(p.sum())
    else:
        draws_below, f = np.arange(len(x)) / len(x), density(x)
        x, draws_below, f = x[f < np.inf], draws_below[f < np.inf], f[f < np.inf]  # without poles
        for rounds in range(21):
            # The harmonic and the arithmetic mean of the ends bound a monotone convex density.
            width, ends = np.diff(x), np.maximum(f[:-1] + f[1:], 1e-300)
            low, high = 2 * width * f[:-1] * (f[1:] / ends), width * ends / 2
            unclear = np.maximum(high - low - 1e-3, high - 0.01)
            coarse = np.argsort(unclear)[-100:]
            coarse = coarse[unclear[coarse] > 0]
            if rounds == 20 or not len(coarse):
                break
            middle = x[coarse] + np.diff(x)[coarse] / 2
            x, f = np.insert(x, coarse + 1, middle), np.insert(f, coarse + 1, density(middle))
            draws_below = np.insert(draws_below, coarse + 1, draws_below[coarse + 1])
        below = np.append(0.0, np.cumsum(low)), np.append(0.0, np.cumsum(high))
        draws_below = draws_below - draws_below[:1]
        distance = float(np.maximum(below[0] - draws_below, draws_below - below[1]).max(initial=0.0))
        total = float(below[0][-1])
    if not distance < 0.12:
        raise InputError(
            f"{what}: draws of {kind.__qualname__} do not have its density: they differ by {distance:.2g}, "
            f"and the density has the total {total:.3g}",
            "sample and log_prob must be of one normalised distribution; log_prob is the log of the density, <= 0 "
            "for a discrete one",
        )
    _KNOWN.add(kind)
