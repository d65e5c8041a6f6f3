"""Checks that a program treats its particles independently, and that it draws by `sample` only.

A program processes all particles in one pass, so it may mix them by mistake (``x.mean()``, ``previous["x"][0]``),
draw from another generator, or keep values between steps. Such a program runs, and its weights are wrong. `Guard`
repeats some steps: of each kind the first, the second, the fourth, and then every power of four.

1. The step with the same random numbers: all values and log weights must be the same.
2. Single particles, as copies with the values that they had: their distributions and returned values must be those
   of the step.
3. With a guide, a step drawn by the model: the guide must be able to draw these values, and the two estimates of the
   evidence must agree.

The results of a filter do not depend on these checks.
"""

from __future__ import annotations

import pickle
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from mstfilter.errors import InputError, InputWarning
from mstfilter.smc.interfaces import Distribution
from mstfilter.smc.population import Population, log_mean_exp, normalise, take
from mstfilter.smc.programs.handlers import CopyHandler, SampleHandler, ScoreHandler, SiteHandler
from mstfilter.smc.programs.sites import Call, PerParticle, ProgramRun, recorded
from mstfilter.smc.streams import child

#: Numbers of the steps of one kind that are checked.
_CHECKED = frozenset({1, 2, *(4**k for k in range(1, 16))})
_COPIES = 3  # of a particle; one might be broadcast
#: Differences that count as rounding: networks that compute in single precision give other digits for other sizes.
_LOG_DENSITY, _VALUE = 1e-3, 1e-5
_LONE = (
    "each particle is processed as if it were alone: reduce over entries with axis=1, not over the particles",
    'previous["x"] has one row for each particle, in a branch of switch as an argument; draw by sample(...) only',
)
_REPEAT = (
    "draw by sample(...) only, not by numpy.random, random or another generator",
    "return values that the next step needs; do not keep them in global variables, closures or the observation",
)

Run = Callable[[Callable[..., Any], SiteHandler, Any, Any, int], ProgramRun]


class Guard:
    """The checks of one step.

    Made before the step, which is ``step() -> (particles, gain)``; `check` is called after it.
    """

    def __init__(
        self, rng: np.random.Generator, past: Population | None, observation: Any, model: Any, guide: Any
    ) -> None:
        self.rng, self.past, self.observation, self.model, self.guide = rng, past, observation, model, guide
        self.previous = None if past is None else past.particles
        self.state, self.content = rng.bit_generator.state, self._content()

    @classmethod
    def due(
        cls, rng: np.random.Generator, past: Population | None, observation: Any, model: Any, guide: Any
    ) -> Guard | None:
        """A guard if a step of this kind is to be checked now."""
        kind = (past is None, np.shape(observation) if isinstance(observation, np.ndarray) else observation is None)
        key = (*kind, _identity(model), None if guide is None else _identity(guide))
        if len(_COUNTS) > 1000:
            _COUNTS.clear()
        _COUNTS[key] += 1
        return cls(rng, past, observation, model, guide) if _COUNTS[key] in _CHECKED else None

    def check(self, run: Run, step: Callable[[], Any], particles: Any, gain: np.ndarray) -> None:
        """Raise InputError if a check fails for the step with these particles and gain of the log weights."""
        runs = self._repeat(step, particles, gain)
        if isinstance(self.model, PerParticle):
            if self._content() != self.content:
                raise InputError(
                    "the program changes a value of `previous` in place, which copies of the particle share",
                    "copy it first (copy.deepcopy), change the copy and return that",
                )
            return
        for whole in runs:
            for call in whole.calls or ():
                if call.distribution is not None:
                    _check_density(call.what, call.distribution, self.rng)
            for row in _rows(whole) if whole.n > 1 else ():
                self._check_alone(run, whole, row)
        if self.guide is not None and len(gain) >= 100:
            self._check_guide(run, gain)

    def _content(self) -> bytes | None:
        """The objects in the particles of a `per_particle` program, as bytes, which are compared and never read."""
        if not isinstance(self.model, PerParticle):
            return None
        try:
            return pickle.dumps(self.previous)
        except Exception:  # an object that cannot be pickled is not checked
            return None

    # --- the same random numbers ------------------------------------------------------------------------------------
    def _repeat(self, step: Callable[[], Any], particles: Any, gain: np.ndarray) -> list[ProgramRun]:
        """Runs of the repeated step."""
        found = []
        for attempt in range(2):
            self.rng.bit_generator.state = self.state
            with recorded() as runs, np.errstate(invalid="call"), _noting_invalid() as invalid:
                try:
                    again, gain_again = step()
                except Exception as error:
                    message = f"the step fails when it is repeated with the same random numbers: {error}"
                    raise InputError(message, *_REPEAT) from error
            found.append(runs)
            if attempt == 0:
                other = _first_difference(particles, again)
                if other is None and _close(gain, gain_again, 1e-9).all():
                    if invalid:
                        _check_returned(runs[-1])
                    return runs
        what = other or _first_call_that_differs(*found) or "the log weights"
        raise InputError(f"{what} differ when the step is repeated with the same random numbers", *_REPEAT)

    # --- single particles -------------------------------------------------------------------------------------------
    def _check_alone(self, run: Run, whole: ProgramRun, row: int) -> None:
        """Compare a particle in a run with copies of it alone."""
        copies = 1 if any(shapes.ambiguous for shapes in whole.shapes.values()) else _COPIES
        with recorded() as runs:
            try:
                alone = self._copied(run, whole, row, copies)
                _check_shapes(whole, alone, "")
            except Exception as error:
                _check_shapes(whole, runs[0], str(error))
                try:  # a program may be written for n particles
                    alone = self._copied(run, whole, row, whole.n)
                except Exception as again:
                    raise InputError(f"the step fails for copies of particle {row} alone: {again}", *_LONE) from again
        lone = {(c.what, c.k): c for c in alone.calls or ()}
        for call in whole.calls or ():
            _compare(call, lone.pop((call.what, call.k), None), row)
        for call in lone.values():
            if call.size:
                raise InputError(f"{call.what} is reached by particle {row} alone, and not among the others", *_LONE)
        for name, values in whole.returned.items():
            other = np.asarray(alone.returned.get(name, values[row]))
            if not _close(values[row], other, _VALUE, _spread(values)).all():
                raise InputError(
                    f"returned {name!r} of particle {row} is {values[row]} among {whole.n} particles, "
                    f"{np.ravel(other)[0]} for copies of it alone"[:300],
                    *_LONE,
                )

    def _copied(self, run: Run, whole: ProgramRun, row: int, n: int) -> ProgramRun:
        previous = None if self.previous is None else take(self.previous, np.full(n, row))
        return run(whole.function, CopyHandler(whole.values, row), previous, self.observation, n)

    # --- the guide --------------------------------------------------------------------------------------------------
    def _check_guide(self, run: Run, gain: np.ndarray) -> None:
        """Compare the guide with draws of the model."""
        n, old = len(gain), 0.0 if self.past is None else self.past.log_weights
        drawn = run(self.model, SampleHandler(child(self.rng, "guard")), self.previous, self.observation, n)
        try:
            with recorded() as runs:
                log_q = run(self.guide, ScoreHandler(drawn.values), self.previous, self.observation, n).gain
        except InputError:
            return  # the guide draws sites that the model does not reach
        by_model, by_guide = old + drawn.gain, old + gain
        if not (np.isfinite(by_model.max()) and np.isfinite(by_guide.max())):
            return
        weights = normalise(by_model)
        missed = float(weights[log_q == -np.inf].sum())
        if missed > 1e-3:
            site = next(c.what for c in runs[0].calls or () if (c.densities([c.value], own=True) == -np.inf).any())
            raise InputError(
                f"{site}: the guide never draws values that hold {missed:.1%} of the probability given the observation",
                "its distribution must reach wherever that of the model times the likelihood does",
            )
        spread = sum(float((w**2).sum()) - 1 / n for w in (weights, normalise(by_guide)))
        gap = log_mean_exp(by_guide) - log_mean_exp(by_model)
        if spread < 0.02 and abs(gap) > 0.1 + 10 * np.sqrt(spread):
            warnings.warn(
                InputWarning(
                    f"the guide and the model give estimates of the evidence that differ by {gap:.2f} nats",
                    "a guide that is narrower than the posterior loses a part of it: use a wider one",
                    "or is log_prob of a distribution wrong?",
                ),
                stacklevel=2,
            )


_COUNTS: Counter[Any] = Counter()
_KEPT: dict[int, Any] = {}


def _identity(function: Any) -> Any:
    """A key for a function: its code, and the values of its closure and defaults but the numbers.

    The models of many parameter values, as in PMMH, have the same key.
    """
    while isinstance(function, partial | PerParticle):  # of a step
        function = function.func if isinstance(function, partial) else function.function
    code = getattr(function, "__code__", None)
    if code is None:
        return _key(function)
    values = [*(getattr(function, "__defaults__", None) or ())]
    for cell in getattr(function, "__closure__", None) or ():
        try:
            values.append(cell.cell_contents)
        except ValueError:  # an empty cell
            continue
    return (_key(code), *(_key(v) for v in values if not isinstance(v, float | np.ndarray)))


def _key(value: Any) -> Any:
    if isinstance(value, str | int | bool | None):
        return value
    if len(_KEPT) > 1000:
        _KEPT.clear()
        _COUNTS.clear()
    _KEPT[id(value)] = value  # so that no other object gets its id
    return id(value)


class _noting_invalid(list[str]):  # noqa: N801 (a context manager)
    """The kinds of invalid operations of numpy in a block."""

    def __enter__(self) -> _noting_invalid:
        self.before = np.seterrcall(lambda kind, _: self.append(kind))
        return self

    def __exit__(self, *error: object) -> None:
        np.seterrcall(self.before)


def _check_returned(run: ProgramRun) -> None:
    """Raise if a returned value is NaN, after an invalid operation; NaN that the program writes is a mark."""
    for name, value in run.returned.items():
        wrong = np.asarray(value).dtype.kind == "f" and np.isnan(value)
        if np.any(wrong):
            n = len(np.unique(np.nonzero(wrong)[0])) if np.ndim(wrong) else 1
            raise InputError(
                f"returned {name!r} is NaN for {n} of {run.n} particles, by an operation such as log(-1) or 0/0",
                "write numpy.nan by numpy.where(valid, value, numpy.nan) if it marks a value that is absent",
            )


def _rows(run: ProgramRun) -> list[int]:
    """Particles to check alone: two by position, the smallest and largest value, and one of each branch."""
    rows = {run.n // 2, run.n // 3}
    numbers = next((v for v in run.values.values() if v.dtype.kind == "f"), None)
    if numbers is not None and numbers.size:
        column = numbers.reshape(run.n, -1)[:, 0]
        rows |= {int(np.argmin(column)), int(np.argmax(column))}
    for call in run.calls or ():
        if call.size and all(call.position(row) is None for row in rows) and len(rows) < 8:
            rows.add(int(call.rows[call.size // 2]))  # type: ignore[index]
    return sorted(rows)


def _close(a: Any, b: Any, tolerance: float, scale: Any = 0.0) -> np.ndarray:
    """Whether entries are equal up to a relative tolerance; NaN equals NaN."""
    a, b = np.asarray(a), np.asarray(b)
    if a.dtype.kind not in "fc" or b.dtype.kind not in "fc":
        return np.asarray(a == b) | np.asarray((a != a) & (b != b))
    with np.errstate(invalid="ignore", over="ignore"):
        near = abs(a - b) <= tolerance * (scale + np.maximum(abs(a), abs(b)))
        return (a == b) | near | (np.isnan(a) & np.isnan(b))


def _spread(values: np.ndarray) -> Any:
    """Size of the differences between particles, the unit of rounding errors."""
    if values.dtype.kind != "f":
        return 0.0
    finite = values[np.isfinite(values)]
    return np.ptp(finite) if finite.size else 0.0


def _first_difference(particles: Any, again: Any) -> str | None:
    """The first name whose values differ between two populations."""
    if isinstance(particles, Mapping):
        if list(particles) != list(again):
            return f"the names {sorted(set(particles) ^ set(again))}"
        return next((f"values of {k!r}" for k, v in particles.items() if not _same(v, again[k])), None)
    found = (_first_difference(dict(a), dict(b)) for a, b in zip(particles, again, strict=True))
    return next((f"{d} of particle {i}" for i, d in enumerate(found) if d is not None), None)


def _same(a: Any, b: Any) -> bool:
    """Whether two values are equal; objects without a comparison are."""
    if isinstance(a, np.ndarray | np.generic | float):
        return np.shape(a) == np.shape(b) and bool(_close(a, b, 1e-9).all())
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return _first_difference(a, b) is None
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    return type(a).__eq__ is object.__eq__ or bool(np.all(a == b))


def _first_call_that_differs(one: list[ProgramRun], two: list[ProgramRun]) -> str | None:
    for a, b in zip(one, two, strict=False):
        for x, y in zip(a.calls or (), b.calls or (), strict=False):
            if x.what != y.what or not _close(x.densities([x.value]), y.densities([y.value]), 1e-9).all():
                return f"log densities of {x.what}"
    return None


def _check_shapes(whole: ProgramRun, alone: ProgramRun, raised: str) -> None:
    """Raise if the shape of an event depends on the number of particles.

    A vector with as many entries as there are particles looks like one number for each of them, and an array (n, n)
    made from (n, 1) and (n,) looks like n vectors. `raised` is the message of the error in the run `alone`, if any.
    """
    for k, found in whole.shapes.items():
        if not found.ambiguous:
            continue
        if raised and k == alone.n_calls + 1:
            raise InputError(
                f"{found.what}: an error with one particle, and none with {whole.n}: "
                + raised.removeprefix(f"{found.what}: ")
            )
        one = alone.shapes.get(k, found._replace(event=(), value=found.value and ()))
        if k <= alone.n_calls and not (found.event == one.event and (one.value is None or one.fits)):
            raise found.error(f"{found.what}: ")


def _compare(call: Call, alone: Call | None, row: int) -> None:
    """Raise unless a particle has the same distribution in a call of all and alone."""
    k = call.position(row)
    if k is None:
        if alone is not None and alone.size:
            raise InputError(f"{call.what} is reached by particle {row} alone, and not among the others", *_LONE)
        return
    probes = [call.value[i] for i in dict.fromkeys((k, 0, call.size - 1))] if call.distribution is not None else []
    among = call.densities(probes)[:, k]
    if alone is None or not alone.size:
        if call.distribution is None and among.any():
            raise InputError(f"{call.what} is reached by particle {row} among the others, and not alone", *_LONE)
        return
    if probes and alone.value.shape[1:] != call.value.shape[1:]:
        raise InputError(
            f"{call.what}: an event of particle {row} has shape {call.value.shape[1:]} among the others, "
            f"{alone.value.shape[1:]} alone",
            *_LONE,
        )
    lone = alone.densities(probes)
    different = ~_close(among[:, None], lone, _LOG_DENSITY, 1.0)
    if different.any():
        i, j = np.argwhere(different)[0]
        raise InputError(
            f"{call.what}: particle {row} has log density {among[i]:.6g} among the others, {lone[i, j]:.6g} alone",
            *_LONE,
        )


# --- distributions of the user --------------------------------------------------------------------------------------
_KNOWN: set[type] = set()


def _check_density(what: str, distribution: Distribution, rng: np.random.Generator) -> None:
    """Raise if draws of a user's distribution of numbers do not have its density; once for each class.

    The distribution function is the integral of the density between sorted draws. Its distance from the uniform
    distribution is below .12 for 1000 draws of the true law, with a false alarm of 1e-12 (Dvoretzky, Kiefer,
    Wolfowitz).
    """
    kind = type(distribution)
    if kind.__module__.startswith("mstfilter.") or kind in _KNOWN or distribution.event_shape:
        return
    _KNOWN.add(kind)
    n = (distribution.batch_shape or (1,))[0]
    if n == 0:
        _KNOWN.discard(kind)
        return
    generator, row = child(rng, "guard", "density"), n // 2
    per_call = n if n > 1 else 1000
    draws = [distribution.sample(generator, per_call) for _ in range(1000 if n > 1 else 1)]
    x = np.sort(np.array([d[row] for d in draws]) if n > 1 else draws[0])

    def density(values: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            if n == 1:
                return np.exp(np.broadcast_to(distribution.log_prob(values), values.shape))
            return np.array([np.exp(distribution.log_prob(np.full(n, v, values.dtype))[row]) for v in values])

    if distribution.discrete:
        values, counts = np.unique(x, return_counts=True)
        p = density(values)
        distance, total = float(abs(counts / len(x) - p).max()), float(p.sum())
    else:
        width = max(x[-1] - x[0], 1e-12)
        x = np.concatenate([x[0] - width * np.linspace(1, 0, 50)[:-1], x, x[-1] + width * np.linspace(0, 1, 50)[1:]])
        p = density(x)
        mass = np.append(0.0, np.cumsum(np.diff(x) * (p[1:] + p[:-1]) / 2))
        middle = (np.arange(1000) + 0.5) / 1000
        distance, total = float(abs(mass[49:-49] - middle).max()), float(mass[-1])
    if not distance < 0.12:
        raise InputError(
            f"{what}: draws of {kind.__qualname__} do not have its density: they differ by {distance:.2g}, "
            f"and the density has the total {total:.3g}",
            "sample and log_prob must be of one normalised distribution; log_prob is the log of the density, <= 0 "
            "for a discrete one",
        )
