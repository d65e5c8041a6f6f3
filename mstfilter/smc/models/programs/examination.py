"""Examines whether a program treats particles independently and draws random numbers only by `sample`.

A program sees arrays of all particles. By mistake it may mix them (``x.mean()``, ``previous["x"][0]``), draw from
another generator, or keep values between steps. Nothing looks odd then, but it is another model:

>>> from mstfilter.smc import Normal, Program, observe, sample
>>> def model(previous, y):
...     x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(previous["x"].mean(), 0.5))
...     observe("y", Normal(x, 1.0), y)
>>> Program(model).bootstrap(100).run([0.3, 0.1])
Traceback (most recent call last):
mstfilter.base.errors.InputError: step 1, transition: site 'x': particle ... alone ...

The filter records the calls that the program made in a step, and then runs it once more:

1. On a few of the particles alone, with the values that they have drawn. Distributions and returned values of a
   particle must not change. So an event axis that is used as the particle axis is found, too.
2. If a distribution is not from this package or if something is suspicious, again with the same random numbers.
   Values and log weights must agree up to rounding.
3. If there is a guide, it must be able to draw what the model draws (`mstfilter.smc.first_steps.check_reach`).

A filter examines the first steps of a run, and ``mstfilter check`` every step (`mstfilter.smc.first_steps`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.fields import copied
from mstfilter.smc.first_steps import (
    DRAWS,
    LOG_DENSITY,
    VALUE,
    check_own_noise,
    check_reach,
    first_column,
    first_difference,
    made_runs,
    nearly_equal,
    recorded,
    spread,
    spread_rows,
)
from mstfilter.smc.models.programs.handlers import GivenHandler, GuideHandler, ReplayHandler, SampleHandler
from mstfilter.smc.models.programs.sites import Call, ProgramRun
from mstfilter.smc.population import Population, take
from mstfilter.smc.streams import child, key_of

_ALONE = (
    "each particle is processed as if it were alone: reduce over entries with axis=1, not over the particles",
    'previous["x"] has one row for each particle, in a branch of switch as an argument; draw by sample(...) only',
    "arrays (n, 1) and (n,) combine to (n, n): use x[:, 0], or z[:, None]",
)
_REPEAT = (
    "draw by sample(...) only, not by numpy.random, random or another generator",
    "return values that the next step needs; do not keep them in global variables, closures or the observation",
)

#: Particles among which those with middle values are sought: enough to meet rare branches, and quickly sorted.
_SORTED = 500

Run = Callable[..., ProgramRun]  #: of a function, a handler, the previous particles, an observation and n


def examine_program(
    run: Run,
    rng: np.random.Generator,
    model: Any,
    guide: Any,
    past: Population | None,
    observation: Any,
    after: Population,
    thorough: bool = False,
) -> bool:
    """Examine one step of a program; InputError if a fault is found. Returns whether the particles differ.

    Called in the block `recorded` in which the step was made. A `thorough` examination runs several groups alone.
    """
    n = len(after)
    fresh = {id(f): copied(f) for f in (model, guide) if f is not None}  # objects may keep values between calls
    previous = None if past is None else past.particles

    def step(rng: np.random.Generator) -> list[ProgramRun]:
        return _runs(run, rng, model, guide, previous, observation, n)

    runs = made_runs() or step(key_of(rng).generator())
    kinds = {type(call.distribution).__module__.split(".")[0] for whole in runs for call in whole.calls or ()}
    if thorough or not kinds <= {"builtins", "mstfilter"}:  # a distribution of the user may draw as it likes
        _check_repeated(runs, lambda: step(key_of(rng).generator()))
    check_own_noise("a site", runs[0].values, lambda: step(child(rng, "examine"))[0].values)
    for whole in runs:
        for group in _groups(whole, thorough) if n > 1 else ():
            try:
                _check_alone(run, fresh, previous, observation, whole, group, thorough)
            except InputError:
                _check_repeated(runs, lambda: step(key_of(rng).generator()))
                raise
    if guide is not None:
        _check_guide(run, rng, model, guide, past, observation, max(DRAWS, n if thorough else 0))
    column = first_column(after.particles, n)
    return bool(column.min() != column.max())


def _runs(
    run: Run, rng: np.random.Generator, model: Any, guide: Any, previous: Any, observation: Any, n: int
) -> list[ProgramRun]:
    """The recorded runs of a step: of the model, or of the guide and the model. The last one has the weights."""
    with recorded() as runs:
        if guide is None:
            run(model, SampleHandler(rng), previous, observation, n)
        else:
            proposed = GuideHandler(rng, n)
            run(guide, proposed, previous, observation, n)
            run(model, ReplayHandler(proposed, rng), previous, observation, n)
    return runs


# --- the same random numbers ----------------------------------------------------------------------------------------
def _check_repeated(runs: list[ProgramRun], step: Callable[[], list[ProgramRun]]) -> None:
    try:
        again = step()
    except Exception as error:
        message = f"the step fails when it is repeated with the same random numbers: {error}"
        raise InputError(message, *_REPEAT) from error
    for one, other in zip(runs, again, strict=True):
        what = first_difference(*({**r.values, **r.returned, "log weights": r.gain} for r in (one, other)))
        if what is not None:
            raise InputError(f"{what} differ when the step is repeated with the same random numbers", *_REPEAT)


# --- a few particles alone ------------------------------------------------------------------------------------------
def _groups(run: ProgramRun, thorough: bool) -> list[np.ndarray]:
    """Groups of particles to run alone: with middle values, and if `thorough` with small and with large ones.

    A group has particles from the branches of each switch, and at least two, because one row could be broadcast.
    """
    numbers = next((v for v in run.values.values() if v.dtype.kind == "f" and v.size), None)
    column = np.arange(run.n) if numbers is None else numbers.reshape(run.n, -1)[:, 0]
    sorted_of = spread_rows(run.n, run.n if thorough else min(run.n, _SORTED))
    order = sorted_of[column[sorted_of].argsort()]
    size = max(len(order) // 3, 1)
    middle = [order[size : len(order) - size][::-1]] if len(order) > 5 else []
    ends = [order[:size], order[: -size - 1 : -1]] if thorough or not middle else []
    return [_group(run, part) for part in middle + ends]


def _group(run: ProgramRun, part: np.ndarray) -> np.ndarray:
    """Choose some, but not all, particles of `part`, and one of each branch that it reaches."""
    rows = list(part[[len(part) // 2, 0, len(part) // 4]])
    for call in run.calls or ():
        if call.rows is not None and len(rows) < 8:
            reached = part[np.isin(part, call.rows)]
            rows += [*reached[len(reached) // 2 :][:1]]
    return np.array(rows[: len(rows) - (len(rows) == run.n)])


def _check_alone(
    run: Run,
    fresh: dict[int, Any],
    previous: Any,
    observation: Any,
    whole: ProgramRun,
    rows: np.ndarray,
    thorough: bool,
) -> None:
    """Compare some particles of a run with the same particles in a run of only these particles."""
    function = copied(fresh.get(id(whole.function), whole.function))
    try:
        with recorded():
            few = run(
                function,
                GivenHandler(whole.values, rows, weigh=False),
                None if previous is None else take(previous, rows),
                observation,
                len(rows),
            )
    except Exception as error:
        hints = error.hints if isinstance(error, InputError) else ()
        message = f"the step fails for particles {sorted(set(rows.tolist()))} alone: {error}"
        raise InputError(message, *hints, *_ALONE) from error
    alone = {(c.what, c.k): c for c in few.calls or ()}
    for call in whole.calls or ():
        _compare(call, alone.pop((call.what, call.k), None), rows, thorough)
    for call in alone.values():
        if call.size:
            raise InputError(f"{call.what} is reached by particle {rows[0]} alone only", *_ALONE)
    for name, values in whole.returned.items():
        _compare_returned(name, values, few.returned.get(name, values[rows]), rows)


def _compare(call: Call, alone: Call | None, rows: np.ndarray, thorough: bool) -> None:
    """Raise InputError unless the particles `rows` have the same log densities among all particles and alone.

    If `thorough`, also at the value of another particle.
    """
    if call.rows is None and alone is not None and alone.rows is None:  # the usual case
        here, k, among = np.arange(len(rows)), rows, call.densities(call.value)
    else:
        position = call.positions(rows)
        here, there = np.flatnonzero(position >= 0), range(0) if alone is None else alone.reached
        among = call.densities(call.value)
        if alone is None or list(here) != list(there):
            left_out = np.setdiff1d(here, there)
            if np.setdiff1d(there, here).size or (call.distribution is None and among[position[left_out]].any()):
                raise InputError(
                    f"{call.what} is not reached by the same particles among the others and alone", *_ALONE
                )
            return
        if not len(here):
            return
        k = position[here]
    pairs = [(among, alone.densities(alone.value))]
    if call.distribution is not None and thorough:
        other = call.value[k[0] - 1]  # the value of another particle
        values = [np.full(c.value.shape, other, c.value.dtype) for c in (call, alone)]
        pairs.append((call.densities(values[0]), alone.densities(values[1])))
    for found, expected in pairs:
        different = ~nearly_equal(found[k], expected, LOG_DENSITY, 1.0)
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
    different = ~nearly_equal(values[rows], alone, VALUE, spread(values))
    if different.any():
        i = tuple(np.argwhere(different)[0])
        raise InputError(
            f"returned {name!r} of particle {rows[i[0]]} is {values[rows][i]} among {len(values)} particles, "
            f"{alone[i]} alone",
            *_ALONE,
        )


# --- the guide ------------------------------------------------------------------------------------------------------
def _check_guide(
    run: Run, rng: np.random.Generator, model: Any, guide: Any, past: Population | None, observation: Any, n: int
) -> None:
    """Raise InputError if the guide never draws, at some site, what the model and the observation make probable."""
    previous, old = None, np.zeros(n)
    if past is not None:
        rows = spread_rows(len(past), n)
        previous, old = take(past.particles, rows), past.log_weights[rows]
    by_guide = old + _runs(run, rng, model, guide, previous, observation, n)[-1].gain
    try:
        drawn = run(model, SampleHandler(rng), previous, observation, n)
    except InputError:
        return  # the model cannot weight its own draws
    with recorded() as runs, suppress(InputError):  # the guide draws sites that the model does not reach
        run(guide, GivenHandler(drawn.values, weigh=False), previous, observation, n)
    for call in runs[0].calls or ():
        log_q = np.zeros(n)
        log_q[call.reached] = call.densities(call.value)
        check_reach(f"{call.what}: the guide", old + drawn.gain, log_q, by_guide)
