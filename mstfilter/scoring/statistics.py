"""Paired differences between compared methods (arms), and what may be claimed from them.

>>> difference = compare([0.9, 0.8, 0.8], [0.7, 0.7, 0.6])
>>> round(difference.mean, 3), difference.n, round(difference.p, 2)
(0.167, 3, 0.25)
>>> table = {"ours": [0.9, 0.8, 0.8], "theirs": [0.7, 0.7, 0.6], "floor": [0.1, 0.2, 0.1]}
>>> found = compare_arms(table, reference="ours")
>>> [(arm, round(d.p_holm, 2)) for arm, d in found.items()]
[('theirs', 0.5), ('floor', 0.5)]
>>> print(str(found).splitlines()[0][:85])                   # the conclusions in words; found.plot() draws them
theirs and ours: no difference can be claimed at n = 3, where p is never below 0.25 (

`compare_runs`, which is also ``runs.compare(...)``, compares the errors of filters over the seeds of `run_many`.

Values are paired by unit: a scene, a data set, or a seed that all arms share. Units must be independent, so values of
several filter seeds on one scene are averaged first.

A claim rests on the p value of a sign-flip test of the mean difference (`scipy.stats.permutation_test`), which Holm's
method adjusts for all comparisons of a table. The bootstrap interval beside each difference (BCa,
`scipy.stats.bootstrap`) describes the difference and decides nothing. The test assumes that, if the methods are
equally good, differences are symmetric about zero: a difference d is as likely as -d. Differences of squared errors
are often skewed instead, so look at them before you trust a small p value: `experiments/comparison` has the error
rates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from mstfilter.base.errors import InputError
from mstfilter.base.lazy import late

if TYPE_CHECKING:
    from mstfilter.smc import History

LEVEL = 0.95  # of intervals
SIGNIFICANT = 0.05  # a claim needs a smaller adjusted p value
CLAIM = 20  # fewest units for a claim
N_FLIPS = 9999  # random sign flips; up to 13 units have fewer flips, and all of them are enumerated
N_BOOTSTRAP = 4999
_SEED = 20210  # fixed, so that results can be repeated


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences.

    Parameters
    ----------
    mean : float
    low, high : float
        BCa bootstrap interval of the mean; NaN for fewer than two units.
    p : float
        Two-sided p value of the sign-flip test; NaN for fewer than two units. With n units it is at least 2 / 2**n,
        and at least .0002.
    n : int
        Number of units for which both methods have a value.
    p_holm : float
        `p` adjusted for all comparisons of the table. For a single comparison it is `p`.
    values : tuple of float
        The difference of each unit.
    """

    mean: float
    low: float
    high: float
    p: float
    n: int
    p_holm: float = float("nan")
    values: tuple[float, ...] = field(default=(), repr=False)

    @property
    def is_claim(self) -> bool:
        """Whether the adjusted p value is below .05 and there are at least 20 units."""
        return self.p_holm < SIGNIFICANT and self.n >= CLAIM


#: Unit -> value, or one value per unit in the order that all arms share.
Values = Mapping[Any, float] | Sequence[float] | np.ndarray


def compare(first: Values, second: Values) -> Difference:
    """The paired difference `first` minus `second`, over the units that have values in both.

    Studies call it for each family, arm and metric, and adjust the p values themselves
    (`mstfilter.runs.study.summary`).

    Parameters
    ----------
    first, second : mapping, or (n,) array_like
        A mapping from units to values, or arrays of values with the same order of units. Units without a finite
        value, such as the seeds of runs in which all weights became zero, are omitted. This favours a method that
        fails in difficult cases, so report how many are missing (`n` is what is left).

    Raises
    ------
    InputError
        If two arrays have different shapes, or are not one-dimensional.
    """
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        units = [unit for unit in first if unit in second]
        first, second = ([arm[unit] for unit in units] for arm in (first, second))
    elif isinstance(first, Mapping) or isinstance(second, Mapping):
        raise InputError("one arm is a mapping of units to values and the other is not, so they cannot be paired")
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise InputError(f"values have shapes {a.shape} and {b.shape}, expected one number per unit: (n,) twice")
    with np.errstate(invalid="ignore"):
        d = a - b
    d = d[np.isfinite(d)]
    mean, p = float(d.mean()) if len(d) else float("nan"), sign_flip(d)
    return Difference(mean, *interval(d), p, len(d), p, tuple(d.tolist()))


def interval(values: np.ndarray) -> tuple[float, float]:
    """BCa bootstrap interval (Efron 1987) of the mean; NaN for fewer than two values."""
    return _interval(tuple(np.asarray(values, dtype=np.float64).tolist()))


@lru_cache(maxsize=10_000)  # a report shows the numbers that the tables have
def _interval(values: tuple[float, ...]) -> tuple[float, float]:
    from scipy.stats import bootstrap

    if len(values) < 2:
        return float("nan"), float("nan")
    if max(values) - min(values) <= 1e-12 * max(map(abs, values)):  # where BCa is not defined
        return (float(np.mean(values)),) * 2
    options = {"confidence_level": LEVEL, "n_resamples": N_BOOTSTRAP, "batch": 2000, "method": "BCa"}
    found = bootstrap((values,), np.mean, **options, rng=np.random.default_rng(_SEED)).confidence_interval
    return float(found.low), float(found.high)


def sign_flip(values: np.ndarray) -> float:
    """Two-sided p value of the test that values are symmetric about zero, by flips of their signs.

    All flips are enumerated for up to 13 values; for more, they are random.
    """
    return _sign_flip(tuple(np.asarray(values, dtype=np.float64).tolist()))


@lru_cache(maxsize=10_000)
def _sign_flip(values: tuple[float, ...]) -> float:
    from scipy.stats import permutation_test

    if len(values) < 2:
        return float("nan")
    options = {"permutation_type": "samples", "vectorized": True, "n_resamples": N_FLIPS, "batch": 2000}
    return float(permutation_test((values,), np.mean, **options, rng=np.random.default_rng(_SEED)).pvalue)


def holm(p: Sequence[float]) -> np.ndarray:
    """p values, adjusted by Holm's method (1979). A NaN, which marks a missing comparison, is not changed."""
    out = np.array(p, dtype=float)
    order = [k for k in np.argsort(out) if np.isfinite(out[k])]
    factors = np.arange(len(order), 0, -1)
    out[order] = np.minimum(1, np.maximum.accumulate(factors * out[order]))
    return out


class Differences(dict[str, Difference]):
    """Differences of several methods from a reference, by name. ``print`` shows the conclusions in words."""

    def __init__(self, found: Mapping[str, Difference], reference: str, unit: str = "unit", label: str = "") -> None:
        super().__init__(found)
        self.reference, self.unit, self.label = reference, unit, label

    def __str__(self) -> str:
        return "\n".join(conclusion(d, arm, self.reference, self.label, self.unit) for arm, d in self.items())

    plot = late("mstfilter.app.report.charts:draw_differences", "Differences with their intervals.")


plot_differences = late("mstfilter.app.report.charts:draw_differences", "Differences with their intervals.")


def compare_arms(table: Mapping[str, Values], reference: str, unit: str = "unit") -> Differences:
    """Differences of every arm from the reference, with p values adjusted for all comparisons of this one table.

    `compare_runs` calls it. Studies do not, because they adjust over families and metrics too: they use `compare`.

    Parameters
    ----------
    table : mapping
        Name of an arm -> values, as for `compare`.
    reference : str
        The arm with which the others are compared.
    unit : str
        The word for a paired unit, for the conclusions.

    Returns
    -------
    Differences
        Mapping from names of arms, without the reference, to `Difference`.
    """
    if reference not in table:
        raise InputError(f"there is no arm {reference!r}", f"there are: {', '.join(table) or 'no arms'}")
    found = {arm: compare(values, table[reference]) for arm, values in table.items() if arm != reference}
    p = holm([d.p for d in found.values()])
    adjusted = {arm: replace(d, p_holm=float(q)) for (arm, d), q in zip(found.items(), p, strict=True)}
    return Differences(adjusted, reference, unit)


def compare_runs(runs: History, reference: str, **truth: Any) -> Differences:
    """Differences between the squared errors of filters, paired by seed.

    >>> runs = run_many({"few": ..., "many": ...}, ys, seeds=range(100), mean=mean)     # doctest: +SKIP
    >>> print(runs.compare("few", mean=exact.means))                                     # doctest: +SKIP

    Parameters
    ----------
    runs : History
        Of `run_many` with several filters.
    reference : str
        The filter with which the others are compared.
    **truth : (T, ...) array_like
        The exact values of one collected quantity, by its name. The error of a run is the mean of its squared
        deviations over time and entries; one that is lost has no error, and is left out of its pairs.

    Seeds are independent given the observations, so a conclusion holds for these observations only.
    """
    if runs.dims != ("arm", "seed", "time") or len(truth) != 1:
        raise InputError(
            f"compare got a history with the axes {', '.join(runs.dims)} and {len(truth)} exact quantities",
            'it takes the runs of several filters and one quantity: runs.compare("systematic", mean=exact)',
        )
    ((name, given),) = truth.items()
    values, exact = runs[name], np.asarray(given, np.float64)
    if exact.shape == (*values.shape[2:], 1):  # of `kalman_filter`, where the state has one entry
        exact = exact[..., 0]
    if values.shape[2:] != exact.shape:
        raise InputError(f"exact values of {name!r} have shape {exact.shape}, expected {values.shape[2:]}")
    errors = np.square(values - exact).mean(axis=tuple(range(2, values.ndim)))
    found = compare_arms(dict(zip(runs.coords["arm"], errors, strict=True)), reference, "seed")
    found.label = f"the squared error of {name}"
    return found


def slope(times: np.ndarray, values: np.ndarray) -> float:
    """Least-squares slope of values over times; NaN for fewer than two times."""
    return float(np.polyfit(times, values, 1)[0]) if len(times) > 1 else float("nan")


def conclusion(difference: Difference, first: str, second: str, where: str = "", unit: str = "scene") -> str:
    """The conclusion from a difference, as a sentence. `unit` is the word for a paired unit."""
    d, at = difference, f" on {where}" if where else ""
    if d.n == 0:
        return f"{first} and {second}{at}: no {unit} has both."
    if d.n == 1:
        return f"{first} and {second}{at}: no difference can be claimed at n = 1."
    found = f"{d.mean:+#.3g}, 95 % interval {d.low:+#.3g} to {d.high:+#.3g}, p {d.p_holm:.2g} after Holm, n = {d.n}"
    if not d.p_holm < SIGNIFICANT:
        least = 2.0 ** (1 - d.n)  # two of 2^n sign flips have a mean that is as large
        few = f", where p is never below {least:.2g}" if least > SIGNIFICANT else ""
        return f"{first} and {second}{at}: no difference can be claimed at n = {d.n}{few} ({found})."
    if not d.is_claim:
        return f"{first} minus {second}{at}: {found}. A first look: claims need {CLAIM} {unit}s."
    return f"{first} is {'above' if d.mean > 0 else 'below'} {second}{at} ({found})."
