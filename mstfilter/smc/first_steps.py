"""Examines the functions of a model at the first steps of a run.

A filter calls a function of a model once for all particles. So a slip can turn the model into another one without any
error: ``x.mean()`` or ``x[0]`` where ``x`` was meant, one noise for all particles, a sum over the wrong axis, numpy's
global generator. The evidence is then wrong, and nothing looks odd:

>>> from mstfilter.smc import Normal, StateSpaceModel, bootstrap
>>> model = StateSpaceModel.of(Normal(0., 1.), lambda x: Normal(.9 * x.mean(), .5), lambda x: Normal(x, 1.))
>>> bootstrap(model, 100).run([.3, -.2, .8])
Traceback (most recent call last):
mstfilter.base.errors.InputError: step 1, transition: the transition: a particle moves differently among others ...

Hence each component that is made of model functions implements `Component.examine`, and the filter calls it at the
first three observations of a run (`iterate`) until it has seen particles that differ. An examination takes at most 64
of the particles. Two of them are processed alone and must get the densities that they have among the others
(`compare_alone`). Functions that draw are called twice with the same stream and with other company
(`check_draws`). A guided move must be able to go wherever the model goes (`check_reach`). The results of a run
do not depend on these calls, which take about as long as one to four steps. ``mstfilter check ./model.py:model``
examines every step, with more particles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError, describe_error as reason
from mstfilter.smc.population import Particles, count_particles, take
from mstfilter.smc.streams import child

#: Particles that stand for all in an examination, and draws that show whether a proposal reaches the posterior.
MOST, DRAWS = 64, 200
#: Share of the posterior mass that a proposal may miss. A truncated proposal often misses a little.
_MISSED = 1e-3
#: Differences that count as rounding. Networks in single precision give other last digits for another number of rows.
LOG_DENSITY, VALUE = 1e-3, 1e-5
#: Two samples differ in law if the Kolmogorov-Smirnov test gives less. So high because a run may not be refused.
_P_LAW = 1e-12

ALONE = (
    "each particle is processed as if it were alone: reduce over the entries of a particle with axis=1, not over "
    "particles, and give each particle its own noise",
    "arrays (n, 1) and (n,) combine to (n, n): use x[:, 0], or z[:, None]",
    "a move that uses the population on purpose (Liu and West 2001) is a Transition of its own, not a model",
)
REPEATED = (
    "draw from the generator that the function gets, not from numpy.random, random or another one",
    "keep no values between calls, and change neither particles nor observation in place",
)

_UNEXAMINED: ContextVar[bool] = ContextVar("runs are not examined", default=False)


@contextmanager
def unexamined(skip: bool = True) -> Iterator[None]:
    """In the block, runs are not examined: those of a filter whose model an earlier run has examined."""
    token = _UNEXAMINED.set(skip)
    try:
        yield
    finally:
        _UNEXAMINED.reset(token)


_RECORDED: ContextVar[list[Any] | None] = ContextVar("runs of programs that record their calls", default=None)


@contextmanager
def recorded() -> Iterator[list[Any]]:
    """Yields a list with a `ProgramRun` for each run of a program in the block. Each run stores its `calls`."""
    runs: list[Any] = []
    token = _RECORDED.set(runs)
    try:
        yield runs
    finally:
        _RECORDED.reset(token)


def made_runs() -> list[Any] | None:
    """The runs of programs in the present block `recorded`; None outside of such a block."""
    return _RECORDED.get()


class Examined(dict[tuple[str, bool], int]):
    """Which slots of a run have been examined, with and without an observation."""

    @classmethod
    def of_run(cls) -> Examined | None:
        """For a new run; None in a block `unexamined`."""
        return None if _UNEXAMINED.get() else cls()

    def wants(self, slot: str, missing: bool) -> bool:
        """Whether a slot is to be examined: until its particles differed, and at most three times."""
        return self.get((slot, missing), 0) < 3

    def note(self, slot: str, missing: bool, conclusive: bool) -> None:
        self[slot, missing] = 3 if conclusive else self.get((slot, missing), 0) + 1


@dataclass(frozen=True)
class Few:
    """Some particles that stand for all, and two of them that are processed alone."""

    particles: Particles  #: m particles
    rows: np.ndarray  #: (m,) their indices in the population
    pair: np.ndarray  #: positions among the m: two, or fewer if m < 3
    differ: bool  #: whether the particles have different values

    @classmethod
    def of(cls, particles: Particles, most: int = MOST) -> Few:
        """Choose particles at equal distances, and two of them with middle values.

        So the two have another mean, maximum, first entry and order than all.
        """
        n = count_particles(particles)
        rows = spread_rows(n, min(n, most))
        particles = particles if n <= most else take(particles, rows)
        m = len(rows)
        column = first_column(particles, m)
        order = column.argsort(kind="stable")
        inner = [k for k in order[m // 3 : m - m // 3].tolist() if 0 < k < m - 1] if m > 3 else [*range(1, m)]
        pair = np.array(sorted({*inner[:1], *inner[-1:]}, reverse=True), int)
        return cls(particles, rows, pair, bool(column[order[0]] != column[order[-1]]))

    def __len__(self) -> int:
        return len(self.rows)


def spread_rows(n: int, k: int) -> np.ndarray:
    """(k,) indices of n particles at equal distances, from the first to the last."""
    return np.arange(k) * (n - 1) // max(k - 1, 1)


def first_column(particles: Particles, n: int) -> np.ndarray:
    """(n,) the first numbers of particles, to sort them by value; their indices if they are objects."""
    for a in particles.values() if isinstance(particles, Mapping) else (particles,):
        if isinstance(a, np.ndarray) and a.dtype.kind in "fiub" and a.size:
            return a if a.ndim == 1 else a.reshape(n, -1)[:, 0]
    return np.arange(n)


# --- densities ------------------------------------------------------------------------------------------------------
def compare_alone(what: str, function: Callable[..., Any], few: Few, *others: Any) -> None:
    """Raise InputError unless ``function(particles, *others)`` (m,) is the same for particles alone and among others.

    `others` are further arguments with one row for each of the `few` particles.
    """
    columns = (few.particles, *others)
    if not len(few.pair):
        return
    whole = _densities(what, function, columns, len(few), "")
    alone = _densities(what, function, [take(c, few.pair) for c in columns], len(few.pair), " alone")
    same = nearly_equal(whole[few.pair], alone, LOG_DENSITY, 1.0)
    if same.all():
        return
    if not nearly_equal(_densities(what, function, columns, len(few), ""), whole, LOG_DENSITY, 1.0).all():
        raise InputError(f"{what} differs when it is computed again for the same particles", *REPEATED)
    k = int(np.argmin(same))
    raise InputError(
        f"{what} of particle {few.rows[few.pair[k]]} is {whole[few.pair[k]]:.6g} among {len(few)} particles and "
        f"{alone[k]:.6g} alone",
        *ALONE,
    )


def _densities(what: str, function: Callable[..., Any], columns: Any, m: int, alone: str) -> np.ndarray:
    """(m,) what a function of model returns for m particles."""
    try:
        found = np.asarray(function(*columns), dtype=np.float64)
    except Exception as error:
        hints = error.hints if isinstance(error, InputError) else ()
        raise InputError(f"{what} fails for {m} of the particles{alone}: {reason(error)}", *hints, *ALONE) from error
    if found.shape != (m,):
        raise InputError(f"{what} of {m} particles has shape {found.shape}, expected ({m},)", *ALONE)
    return found


def nearly_equal(a: Any, b: Any, tolerance: float, scale: Any = 0.0) -> np.ndarray:
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


def spread(values: np.ndarray) -> Any:
    """Range of the finite values of all particles, used as the unit of rounding errors."""
    if values.dtype.kind != "f":
        return 0.0
    finite = values[np.isfinite(values)]
    return np.ptp(finite) if finite.size else 0.0


def first_difference(ours: Any, again: Any, rows: Any = slice(None)) -> str | None:
    """The first array, or entry of a mapping, whose `rows` differ; None if there is none, or if they are objects."""
    if isinstance(ours, Mapping) and isinstance(again, Mapping):
        if ours.keys() != again.keys():
            return f"the names {sorted(ours.keys() ^ again.keys())}"
        found = ((name, first_difference(ours[name], again[name], rows)) for name in ours)
        return next((f"the values of {name!r}" for name, different in found if different), None)
    if not (isinstance(ours, np.ndarray) and isinstance(again, np.ndarray)) or ours.dtype == object:
        return None
    if ours.shape != again.shape:
        return f"the shapes {ours.shape} and {again.shape}"
    a, b = ours[rows], again[rows]
    return None if (a == b).all() or nearly_equal(a, b, VALUE, spread(ours)).all() else "the particles"


# --- draws ----------------------------------------------------------------------------------------------------------
Draw = Callable[[np.random.Generator, Any], Any]  #: m new particles from m particles


def check_draws(what: str, draw: Draw, few: Few, rng: np.random.Generator) -> Particles | None:
    """Raise InputError if draws depend on other particles, share their noise, or come from another generator.

    Every second particle is replaced by a copy of one. With the same stream, the others should move as before.
    If it does not, the draws may still be right, because the numbers that a sampler consumes can depend on values:
    then the laws of larger samples decide.

    Returns the draws of the `few` particles; None if these are objects or one particle, which are not examined.
    """
    if len(few) < 2 or not is_numeric(few.particles):
        return None
    rows = np.arange(MOST) % len(few)
    company = few.particles if len(few) == MOST else take(few.particles, rows)
    mixed = take(few.particles, np.where(_KEPT, rows, int(first_column(few.particles, len(few)).argmin())))
    before = _drawn(what, draw, child(rng, "examine"), company)  # a stream that also spawns the same children
    after = _drawn(what, draw, child(rng, "examine"), mixed)
    if first_difference(before, after, _KEPT):
        different = first_difference(before, _drawn(what, draw, child(rng, "examine"), company))
        if different:
            raise InputError(f"{what}: {different} differ when it is repeated with the same generator", *REPEATED)
        _check_law(what, draw, few, rng)
    check_own_noise(what, after, lambda: _drawn(what, draw, rng, mixed), ~_KEPT)
    return take(before, np.arange(len(few)))


#: Positions that keep their particles: every second one, neither the first nor the last.
_KEPT = np.arange(MOST) % 2 == 1
_KEPT[-1] = False


def _drawn(what: str, draw: Draw, rng: np.random.Generator, particles: Particles) -> Particles:
    """As many new particles."""
    n = count_particles(particles)
    try:
        found = draw(rng, particles)
    except Exception as error:
        hints = error.hints if isinstance(error, InputError) else ()
        raise InputError(f"{what} fails for {n} particles: {reason(error)}", *hints, *ALONE) from error
    if count_particles(found) != n:
        raise InputError(f"{what}: {n} particles became {count_particles(found)}, expected as many", *ALONE)
    return found


def check_own_noise(what: str, drawn: Any, draw_again: Callable[[], Any], copies: Any = slice(None)) -> None:
    """Raise InputError if all of at least 16 copies of a particle get one draw, and another one from another stream.

    If copies move independently to two values with probabilities p and q, the false-alarm rate is (p q)^16 < 1e-9.
    """
    columns = [*_columns(drawn, copies)] if is_numeric(drawn) else []
    shared = [j for j, column in enumerate(columns) if len(column) >= 16 and (column == column[0]).all()]
    if not shared:
        return
    again = [*_columns(draw_again(), copies)]
    for j in shared:
        if (again[j] == again[j][0]).all() and again[j][0] != columns[j][0]:
            raise InputError(f"{what}: all particles get the same random number", *ALONE)


def _check_law(what: str, draw: Draw, few: Few, rng: np.random.Generator) -> None:
    """Raise InputError if copies of a particle move differently among copies, small and large particles."""
    from scipy.stats import ks_2samp

    column, m = first_column(few.particles, len(few)), 4000
    least, most = int(column.argmin()), int(column.argmax())
    copies = np.arange(m) % 8 == 1
    for one in {int(few.pair[0]), most}:
        found = []
        for other in (one, least, most):
            company = take(few.particles, np.where(copies, one, other))
            found.append([*_columns(_drawn(what, draw, rng, company), copies)])
        for among in found[1:]:
            for a, b in zip(found[0], among, strict=True):
                if ks_2samp(a, b, method="asymp").pvalue < _P_LAW:
                    raise InputError(
                        f"{what}: a particle moves differently among others (mean {np.mean(a):.4g} and "
                        f"{np.mean(b):.4g}, sd {np.std(a):.4g} and {np.std(b):.4g})",
                        *ALONE,
                    )


def is_numeric(particles: Any) -> bool:
    """Whether particles are an array of numbers, or a mapping of such."""
    arrays = particles.values() if isinstance(particles, Mapping) else (particles,)
    return all(isinstance(a, np.ndarray) and a.dtype != object for a in arrays)


def _columns(particles: Any, rows: Any) -> Iterator[np.ndarray]:
    """The columns of some rows of particles that are an array or a mapping of arrays."""
    for a in particles.values() if isinstance(particles, Mapping) else (particles,):
        a = np.asarray(a)
        if a.dtype.kind in "fiub":
            yield from a[rows].reshape(len(a[rows]), -1).T[:100]


# --- proposals ------------------------------------------------------------------------------------------------------
def check_reach(what: str, by_model: np.ndarray, log_q: np.ndarray, by_proposal: np.ndarray) -> None:
    """Raise InputError if a proposal never draws what holds more than a thousandth of the posterior mass.

    Parameters
    ----------
    by_model : (k,)
        Log weights, up to a factor, of draws from the model: the likelihood.
    log_q : (k,)
        Log density of the proposal at these draws.
    by_proposal : (k,)
        Log weights f p(y | x) / q of draws from the proposal, with the same factor.
    """
    top = max(by_model.max(), by_proposal.max())
    if not np.isfinite(top):
        return
    missed = float(np.exp(by_model[log_q == -np.inf] - top).sum()) / len(by_model)
    reached = float(np.exp(by_proposal - top).mean())
    if missed > _MISSED * (missed + reached):
        raise InputError(
            f"{what} never draws values that hold {missed / (missed + reached):.1%} of the posterior probability",
            "its support must contain every value that both the model and the observation allow",
        )
