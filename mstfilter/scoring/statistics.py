"""Paired differences between compared methods (arms), and conclusions from the differences.

>>> difference = compare([0.9, 0.8, 0.8], [0.7, 0.7, 0.6])
>>> round(difference.mean, 3), difference.n
(0.167, 3)
>>> table = {"ours": [0.9, 0.8, 0.8], "theirs": [0.7, 0.7, 0.6], "floor": [0.1, 0.2, 0.1]}
>>> [(arm, round(d.p_holm, 2)) for arm, d in compare_arms(table, reference="ours").items()]
[('theirs', 0.5), ('floor', 0.5)]

Values are paired by unit: a scene, a data set, or a seed that all arms share. Units must be independent. So values of
several filter seeds on one scene are averaged first. A difference has a t interval, a studentised bootstrap interval,
and the p values of a sign-flip test and of the studentised bootstrap. The t interval and the sign-flip test assume
that the differences are symmetric about zero under the null hypothesis. Differences of squared errors are often
skewed. So a difference is claimed only if both intervals exclude 0 and `Difference.p_claim` is small. `p_claim` is
the larger p value times 1 + abs(skewness). The p values of one table are adjusted by Holm's method.
`experiments/comparison` has the error rates and the power of this test procedure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mstfilter.base.errors import InputError

LEVEL = 0.95
CLAIM = 20  # fewest units for a claim
EXACT = 13  # most units for which all sign flips are enumerated
N_RESAMPLES = 9999
N_ADJUSTED = 99_999  # of p values that are adjusted for many comparisons
MOST_DRAWS = 20_000_000  # limits memory and time for many units


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences.

    Parameters
    ----------
    mean : float
    low, high : float
        t interval; NaN for one unit.
    low_bootstrap, high_bootstrap : float
        Studentised bootstrap interval; NaN for fewer than five units.
    p : float
        Two-sided p value of the sign-flip test; NaN for one unit.
    n : int
        Number of units for which both methods have a value.
    p_holm : float
        `p_claim` adjusted for all comparisons of the table. `p_holm` equals `p_claim` for a single comparison.
    p_bootstrap : float
        Two-sided p value of the studentised bootstrap, see `studentised_bootstrap`; NaN for fewer than five units.
    skewness : float
        Sample skewness of the differences; 0 if all differences are equal.
    """

    mean: float
    low: float
    high: float
    low_bootstrap: float
    high_bootstrap: float
    p: float
    n: int
    p_holm: float = float("nan")
    p_bootstrap: float = float("nan")
    skewness: float = 0.0

    @property
    def p_claim(self) -> float:
        """The larger of `p` and `p_bootstrap`, times 1 + abs(skewness), at most 1; NaN for fewer than two units.

        A small sample of skewed differences often has no values from the longer tail. The factor corrects the p value
        for this missing tail. The factor was chosen by simulation in `experiments/comparison`.
        """
        return float(np.minimum(1, np.fmax(self.p, self.p_bootstrap) * (1 + abs(self.skewness))))

    @property
    def excludes_zero(self) -> bool:
        """Whether the t interval and the bootstrap interval exclude 0. Without the second, only the first is used."""
        low, high = np.fmin(self.low, self.low_bootstrap), np.fmax(self.high, self.high_bootstrap)
        return bool(low > 0 or high < 0)


#: Unit -> value, or one value per unit in the order that all arms share.
Values = Mapping[Any, float] | Sequence[float] | np.ndarray


def compare(first: Values, second: Values, adjusted: bool = False) -> Difference:
    """The paired difference `first` minus `second`, over the units that have values in both.

    Parameters
    ----------
    first, second : mapping, or (n,) array_like
        A mapping from units to values, or arrays of values with the same order of units. Units without a finite
        value, such as the seeds of runs in which all weights became zero, are omitted.
    adjusted : bool
        The p value will be adjusted for many comparisons, so 99,999 instead of 9,999 resamples are drawn.

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
    if len(d) == 0:
        nan = float("nan")
        return Difference(nan, nan, nan, nan, nan, nan, 0)
    n_resamples = min(N_ADJUSTED, max(N_RESAMPLES, MOST_DRAWS // len(d))) if adjusted else N_RESAMPLES
    low, high, p = studentised_bootstrap(d, n_resamples)
    limits = *interval(d), low, high
    found = Difference(float(d.mean()), *limits, sign_flip(d, n_resamples), len(d), float("nan"), p, _skewness(d))
    return replace(found, p_holm=found.p_claim)


def interval(values: np.ndarray) -> tuple[float, float]:
    """t interval of the mean; NaN for fewer than two values."""
    from scipy.stats import t

    n = len(values)
    if n < 2:
        return float("nan"), float("nan")
    half = float(t.ppf(0.5 + LEVEL / 2, n - 1)) * values.std(ddof=1) / np.sqrt(n)
    return float(values.mean() - half), float(values.mean() + half)


def studentised_bootstrap(values: np.ndarray, n_resamples: int = N_RESAMPLES) -> tuple[float, float, float]:
    """Studentised bootstrap: interval of the mean, and two-sided p value of a zero mean.

    The results are NaN for fewer than five values. The seed is fixed, so results can be repeated. A resample of equal
    values has an infinite t ratio. So if most values are equal, a limit of the interval is infinite.

    The p value is the larger of two p values. The equal-tailed p value adapts to the skewness like the interval
    (Efron, Tibshirani 1993, section 12.5). The p value of the absolute t ratio is larger for symmetric values with
    heavy tails (Hall 1992, section 3.6).
    """
    n, mean = len(values), float(values.mean())
    if n < 5:
        return float("nan"), float("nan"), float("nan")
    if _all_equal(values):
        return mean, mean, 1.0 if mean == 0 else 1 / (1 + n_resamples)
    ratios, scale = _resampled_ratios(values, n_resamples), values.std(ddof=1)
    found = np.quantile(ratios, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    low, high = np.where(np.abs(found) > 1e100, np.copysign(np.inf, found), found) * scale
    tails = (ratios >= mean / scale).sum(), (ratios <= mean / scale).sum()
    count = 1 + np.array([2 * min(tails) + 1, (np.abs(ratios) >= abs(mean / scale)).sum()])
    return mean - float(high), mean - float(low), min(1.0, float(count.max()) / (1 + n_resamples))


def _resampled_ratios(values: np.ndarray, n_resamples: int) -> np.ndarray:
    """Ratios (mean of a resample - mean) / (standard deviation of the resample) of all resamples.

    If all values of a resample are equal, its ratio is infinite, or 0 if its mean is the mean of the values. Infinite
    ratios are set to +-1e200, because quantiles interpolate.
    """
    rng = np.random.default_rng(20210)
    drawn = values[rng.integers(0, len(values), (n_resamples, len(values)))]
    scale = drawn.std(axis=1, ddof=1)
    away = drawn.mean(axis=1) - values.mean()
    return np.divide(away, scale, out=1e200 * np.sign(away), where=scale > 1e-9 * values.std(ddof=1))


def _all_equal(values: np.ndarray) -> bool:
    """Whether the values are equal up to rounding."""
    return bool(values.std() <= 1e-12 * np.abs(values).max())


def _skewness(values: np.ndarray) -> float:
    """Third central moment over the cubed standard deviation; 0 for equal values."""
    centred = values - values.mean()
    return 0.0 if _all_equal(values) else float((centred**3).mean() / values.std() ** 3)


def sign_flip(values: np.ndarray, n_resamples: int = N_RESAMPLES) -> float:
    """Two-sided p value of the sign-flip test of a zero mean: exact up to 13 values, else with random flips."""
    from scipy.stats import permutation_test

    n = len(values)
    if n < 2:
        return float("nan")
    if not values.any():
        return 1.0
    draws = 2**n if n <= EXACT else n_resamples
    found = permutation_test(
        (values,),
        lambda x, axis: x.mean(axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=draws,
        batch=2000,
        rng=np.random.default_rng(20210),
    )
    return float(found.pvalue)


def holm(p: Sequence[float]) -> np.ndarray:
    """p values, adjusted by Holm's method (1979). A NaN, which marks a missing comparison, is not changed."""
    values = np.asarray(p, dtype=float)
    out = np.full(len(values), np.nan)
    order = [k for k in np.argsort(values) if np.isfinite(values[k])]
    worst = 0.0
    for rank, k in enumerate(order):
        worst = max(worst, min(1.0, (len(order) - rank) * values[k]))
        out[k] = worst
    return out


def compare_arms(table: Mapping[str, Values], reference: str) -> dict[str, Difference]:
    """Differences of every compared method from the reference, with p values adjusted for all comparisons.

    Parameters
    ----------
    table : mapping
        Name of a compared method -> values, as for `compare`.
    reference : str
        The method with which the other methods are compared.

    Returns
    -------
    dict
        Mapping from names of methods, without the reference, to `Difference`.
    """
    if reference not in table:
        raise InputError(f"there is no arm {reference!r}", f"there are: {', '.join(table) or 'no arms'}")
    found = {arm: compare(values, table[reference], True) for arm, values in table.items() if arm != reference}
    p = holm([d.p_claim for d in found.values()])
    return {arm: replace(d, p_holm=float(q)) for (arm, d), q in zip(found.items(), p, strict=True)}


def slope(times: np.ndarray, values: np.ndarray) -> float:
    """Least-squares slope of values over times; NaN for fewer than two times."""
    return float(np.polyfit(times, values, 1)[0]) if len(times) > 1 else float("nan")


def conclusion(difference: Difference, first: str, second: str, where: str = "", unit: str = "scene") -> str:
    """The conclusion from a difference, as a sentence. `unit` is the word for a paired unit."""
    d, at = difference, f" on {where}" if where else ""
    if d.n == 0:
        return f"{first} and {second}{at}: no {unit} has both."
    if d.n < 2:
        return f"{first} and {second}{at}: no difference can be claimed at n = 1."
    numbers = f"{d.mean:+#.3g}, 95 % interval {d.low:+#.3g} to {d.high:+#.3g}"
    found = f"{numbers}, p {d.p_holm:.2g} after Holm, n = {d.n}"
    if not d.excludes_zero and (d.low > 0 or d.high < 0):
        found = f"{found}, bootstrap interval {d.low_bootstrap:+#.3g} to {d.high_bootstrap:+#.3g}"
    if not d.excludes_zero:
        return f"{first} and {second}{at}: no difference can be claimed at n = {d.n} ({found})."
    if d.n < CLAIM:
        return f"{first} minus {second}{at}: {found}. A first look: claims need {CLAIM} {unit}s."
    if not d.p_holm < 1 - LEVEL:
        return f"{first} minus {second}{at}: {found}. The intervals exclude 0, but no claim is left after adjustment."
    return f"{first} is {'above' if d.mean > 0 else 'below'} {second}{at} ({found})."
