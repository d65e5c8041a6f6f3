"""Differences between arms, paired by scene, and what may be said of them.

>>> difference = compare({"a": 0.9, "b": 0.8, "c": 0.8}, {"a": 0.7, "b": 0.7, "c": 0.6})
>>> round(difference.mean, 3), difference.n
(0.167, 3)

The unit is the scene: what seeds of the filter give on one scene is averaged first. A t interval, a studentised
bootstrap interval beside it, and the p value of flipping the signs of the differences, which assumes no more than
that they are symmetric about zero if there is no difference. p values of one table are adjusted by Holm's rule.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

LEVEL = 0.95
CLAIM = 20  # scenes below which nothing is claimed
EXACT = 12  # scenes up to which all sign flips are tried
N_FLIPS = 9999
N_BOOTSTRAP = 4999


@dataclass(frozen=True)
class Difference:
    """The mean of paired differences.

    Parameters
    ----------
    mean : float
    low, high : float
        t interval; NaN for one scene.
    low_bootstrap, high_bootstrap : float
        Studentised bootstrap; NaN below five scenes.
    p : float
        Of sign flips, two-sided; NaN for one scene.
    n : int
        Scenes that both arms have.
    p_holm : float
        After adjustment for all comparisons of the table; `p` where there is one only.
    """

    mean: float
    low: float
    high: float
    low_bootstrap: float
    high_bootstrap: float
    p: float
    n: int
    p_holm: float = float("nan")


def compare(first: Mapping[str, float], second: Mapping[str, float]) -> Difference:
    """First minus second over the scenes that both have.

    Parameters
    ----------
    first, second : mapping
        Scene -> figure. Scenes without a finite figure are left out.
    """
    scenes = [s for s in first if s in second and np.isfinite(first[s]) and np.isfinite(second[s])]
    d = np.array([first[s] - second[s] for s in scenes])
    if len(d) == 0:
        nan = float("nan")
        return Difference(nan, nan, nan, nan, nan, nan, 0)
    p = sign_flip(d)
    return Difference(float(d.mean()), *interval(d), *studentised(d), p, len(d), p)


def interval(values: np.ndarray, level: float = LEVEL) -> tuple[float, float]:
    """t interval of the mean; NaN for fewer than two values."""
    from scipy.stats import t

    n = len(values)
    if n < 2:
        return float("nan"), float("nan")
    half = float(t.ppf(0.5 + level / 2, n - 1)) * values.std(ddof=1) / np.sqrt(n)
    return float(values.mean() - half), float(values.mean() + half)


def studentised(values: np.ndarray, level: float = LEVEL, n_resamples: int = N_BOOTSTRAP) -> tuple[float, float]:
    """Studentised bootstrap interval of the mean (Efron, Tibshirani 1993, section 12.5); NaN below five values.

    The same values give the same interval. Resamples in which all values are equal have no scale and are left out.
    """
    n = len(values)
    if n < 5:
        return float("nan"), float("nan")
    spread = values.std(ddof=1)
    if spread <= 1e-12 * max(1.0, np.abs(values).max()):
        return float(values.mean()), float(values.mean())
    rng = np.random.default_rng(20210)
    drawn = values[rng.integers(0, n, (n_resamples, n))]
    scale = drawn.std(axis=1, ddof=1)
    good = scale > 1e-9 * spread
    ratio = (drawn.mean(axis=1)[good] - values.mean()) / scale[good]
    low, high = np.quantile(ratio, [0.5 - level / 2, 0.5 + level / 2])
    return float(values.mean() - high * spread), float(values.mean() - low * spread)


def sign_flip(values: np.ndarray) -> float:
    """Two-sided p value of a mean of zero by flipping signs: all of them up to 12 values, else 9999 drawn ones."""
    from scipy.stats import permutation_test

    n = len(values)
    if n < 2:
        return float("nan")
    if not values.any():
        return 1.0
    draws = 2**n if n <= EXACT else N_FLIPS
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
    """p values adjusted by Holm's rule (1979); what is NaN is no comparison and stays so."""
    values = np.asarray(p, dtype=float)
    out = np.full(len(values), np.nan)
    order = [k for k in np.argsort(values) if np.isfinite(values[k])]
    worst = 0.0
    for rank, k in enumerate(order):
        worst = max(worst, min(1.0, (len(order) - rank) * values[k]))
        out[k] = worst
    return out


def adjusted(differences: Sequence[Difference]) -> list[Difference]:
    """The comparisons of one table, their p values adjusted together."""
    return [replace(d, p_holm=float(p)) for d, p in zip(differences, holm([d.p for d in differences]), strict=True)]


def slope(times: np.ndarray, values: np.ndarray) -> float:
    """Least-squares slope of values over times; NaN for fewer than two."""
    times, values = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    if len(times) < 2:
        return float("nan")
    centred = times - times.mean()
    return float(centred @ values / (centred @ centred))


def conclusion(difference: Difference, first: str, second: str, where: str = "") -> str:
    """What a difference says, in words that claim no more than it shows."""
    d, at = difference, f" on {where}" if where else ""
    if d.n == 0:
        return f"{first} and {second}{at}: no scene has both."
    if d.n < 2:
        return f"{first} and {second}{at}: no difference can be claimed at n = 1."
    found = f"{d.mean:+.3f}, 95 % interval {d.low:+.3f} to {d.high:+.3f}, p {d.p_holm:.2g} after Holm, n = {d.n}"
    if not (d.low > 0 or d.high < 0):
        return f"{first} and {second}{at}: no difference can be claimed at n = {d.n} ({found})."
    word = "above" if d.mean > 0 else "below"
    if d.n < CLAIM:
        return f"{first} is {word} {second}{at} ({found}): a first look, no claim below {CLAIM} scenes."
    if not d.p_holm < 1 - LEVEL:
        return f"{first} is {word} {second}{at} by its own interval, not after adjustment ({found}): no claim."
    return f"{first} is {word} {second}{at} ({found})."
