"""Weight of particles after a resampling: test cases, their statistics, likely faults, and generators that count.

A `Case` is a list of weights and a number of particles to select. A `Sample` collects, over many calls, the weight
that each particle and each group of particles carries, in units of the total weight. `fault_message` compares the
mean with the expected weights and names the likely fault.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Any
from unittest import SkipTest

import numpy as np

from mstfilter.smc.testing.contract import FALSE_ALARM


@dataclass(frozen=True)
class Case:
    """Weights, number of particles to select, and first number of calls."""

    weights: tuple[float, ...]
    n: int
    calls: int = 1000


def _mixed(m: int, heavy: float) -> tuple[float, ...]:
    """(m,) weights: one heavy weight, zeros, ties and light weights, with more mass in the second half.

    The first weight of the second half is the fraction `heavy` of the total. An eighth of the others is zero, and a
    quarter is at most 5e-4 of the heaviest weight.
    """
    kind = np.arange(m) % 8
    weights = np.select(
        [kind == 1, np.isin(kind, (2, 5)), np.isin(kind, (0, 6)), kind == 3],
        [0.0, 0.0, 1.0, 2.0],
        1.0 + np.linspace(0.0, 1.5, m),
    )
    weights[m // 2] = 0.0
    weights[m // 2 :] *= 1.6
    weights[m // 2] = weights.sum() * heavy / (1 - heavy)
    weights[kind == 2] = 5e-4 * weights[m // 2]
    weights[kind == 5] = 5e-5 * weights[m // 2]
    return tuple(weights.tolist())


_FIVE = (0.41, 0.24, 0.2, 0.1, 0.05)
CASES = (
    Case((0.11, 0.36, 0.15, 0.38), 3),
    Case(_FIVE, 7),
    Case((0.05, 0.1, 0.2, 0.24, 0.41), 2),
    Case((0.12, 0.05, 0.16, 0.08, 0.33, 0.26), 6),  # n = m, and below: ties, zeros
    Case((3.0, 1.0, 1.0, 3.0, 3.0, 1.0, 2.0, 2.0), 8),
    Case((0.0, 2.0, 0.0, 1.0, 1.5, 0.0, 0.6), 7),
    Case((0.0, 2.0, 2.0, 1.0, 1.0, 0.0, 0.6), 4),
    Case((0.05, 0.3, 0.25, 0.08, 0.32), 7),  # the sizes of a case above, other weights
    Case(_FIVE, 1),
    Case((0.8, 0.2), 1),
    Case((0.06, 0.7, 0.2, 0.04), 4),
    Case((0.06, 0.7, 0.2, 0.04), 101),
    Case((0.02, 0.95, 0.03), 3),
    Case((0.01, 0.02, 0.012, 0.95, 0.008), 401),
    Case(_mixed(32, 0.46), 32),
    Case(_mixed(32, 0.2), 31),
    Case(_mixed(125, 0.2), 5),
    Case(tuple(np.linspace(1.0, 3.0, 100).tolist()), 2),
    Case((1.0,), 2, 10),
    Case(_mixed(300, 0.3), 300, 500),  # more particles than 8 bits count
)
#: The fraction n W of the heaviest particle is not an integer. 1 % of its weight is nine standard errors of
#: multinomial copies.
HEAVY_CASES = (Case(_mixed(8, 0.4985), 2001, 1700),)
HEAVY_CASES_OF_WEIGHTS = (*HEAVY_CASES, Case(_mixed(2000, 0.49983), 2000, 500))
#: Random numbers that a case may draw; a call of a generator counts as 15 numbers.
BUDGET = 40_000_000
#: A case with a deviation of this many standard errors gets more calls, up to so many times as many as at first.
_SUSPICIOUS = 4.0
MOST_CALLS = 16
#: Bets of a test, as fractions of the largest stake.
_STAKES = 0.9 * 0.5 ** np.arange(10)


class Sample:
    """The weight that particles and groups of particles of a case carry, over many calls.

    Each mean is tested by betting (Waudby-Smith, Ramdas 2024, "Estimating means of bounded random variables by
    betting"). Let calls x_1, x_2, ... in [0, b] have expectation mu, and let s be any stake from -1 / (b - mu) to 1 /
    mu. The product of 1 + s (x_k - mu) over the calls has expectation 1. By Ville's inequality, the largest value of
    the product over any number of calls exceeds 1 / p with probability at most p. The test needs no normal
    approximation and no variance. So a scheme that gives very many copies in rare calls passes. Calls may be added in
    unclear cases.
    """

    def __init__(self, case: Case) -> None:
        W = np.asarray(case.weights) / np.sum(case.weights)
        self.case, self.expected, self.calls = case, np.concatenate([W, groups_of(case) @ W]), 0
        self.equal_weights, self.all_n, self.total, self._most = True, True, 1.0, 1.0
        self._first: float | None = None  # weight of the first particle of the first call
        self._rows: list[np.ndarray] = []

    def add(self, ancestors: np.ndarray, weights: np.ndarray) -> None:
        """Add a call with its ancestors and its output weights in units of the old mean."""
        n = len(weights)
        total = float(weights.sum()) / n
        self._rows.append(np.bincount(ancestors, weights, minlength=len(self.case.weights)) / n)
        self.calls += 1
        first = weights[0] if self._first is None else self._first
        self._first = first
        self.equal_weights = self.equal_weights and bool(np.abs(weights - first).max() <= 1e-9 * first)
        self.all_n = self.all_n and n == self.case.n
        self._most = max(self._most, total)
        if abs(total - 1) > abs(self.total - 1):
            self.total = total

    @property
    def carried(self) -> np.ndarray:
        """(calls, m + k) fraction of the weight that each particle and each of k groups carries."""
        rows = np.array(self._rows)
        return np.concatenate([rows, rows @ groups_of(self.case).T], axis=1)

    @property
    def largest(self) -> float:
        """Largest weight that a call can carry: 1, or four times the largest observed if the total is not kept."""
        return 1.0 if self._most <= 1 + 1e-9 else 4 * self._most

    def evidence(self) -> np.ndarray:
        """(m + k,) log evidence against the expectation of each particle and group.

        The evidence exceeds log(2 / p) with probability at most p. The result is 0 if the mean is less than four
        standard errors away. 16 copies are added to all calls, for particles that are rarely selected.
        """
        x = self.carried
        found, sd = x.mean(axis=0), x.std(axis=0)
        beyond = np.abs(found - self.expected)
        clear = _SUSPICIOUS * sd / np.sqrt(len(x)) + _SUSPICIOUS**2 / (self.case.n * len(x))
        columns = np.flatnonzero(beyond > clear)
        result = np.zeros(x.shape[1])
        for j in columns.tolist():
            sign = np.sign(found[j] - self.expected[j])
            mean = self.expected[j]
            gains = sign * (x[:, j] - mean) / max(mean if sign > 0 else self.largest - mean, 1e-12)
            bets = np.log1p(_STAKES[:, None] * gains).sum(axis=1)
            result[j] = bets.max() + np.log(np.exp(bets - bets.max()).mean())
        return result


def quantile(n_tails: int) -> float:
    """z of a normal variable that exceeds it with probability FALSE_ALARM / n_tails."""
    return -NormalDist().inv_cdf(FALSE_ALARM / n_tails)


@lru_cache(maxsize=64)
def groups_of(case: Case) -> np.ndarray:
    """(k, m) masks as floats: all particles, the first half, the light ones, and those of each common weight."""
    w = np.asarray(case.weights)
    values, counts = np.unique(w, return_counts=True)
    masks = [np.ones(len(w), bool), np.arange(len(w)) < len(w) // 2, (w > 0) & (w < 1e-3 * w.max())]
    return np.array([*masks, *(w == value for value in values[counts > 1])], dtype=np.float64)


def fault_message(sample: Sample, column: int) -> str:
    """How the particle or group with the largest deviation violates its expectation."""
    case, expected, mean = sample.case, sample.expected, sample.carried.mean(axis=0)
    m, n = len(case.weights), case.n
    got, want = n * mean, n * expected
    who = f"particle {column} (W = {expected[column]:.3g})"
    if column >= m:
        members = np.flatnonzero(groups_of(case)[column - m])
        who = f"the group of particles {', '.join(map(str, members[:3]))}, ... (W = {expected[column]:.3g})"
    fault = (
        f"copies are biased: {who} gets {got[column]:.3f} copies on average, expected {want[column]:.3f}"
        if sample.equal_weights
        else f"output weights are wrong: {who} carries {mean[column]:.3f} of the weight on average, "
        f"expected {expected[column]:.3f}"
    )
    hint = _hint(got[:m], want[:m], n, sample.calls)
    return f"{m} particles to {n}: {fault}{'; ' if hint else ''}{hint}"


def _hint(got: np.ndarray, want: np.ndarray, n: int, calls: int) -> str:
    """The likely fault, from the mean and the expected numbers of copies of each particle."""
    m, excess, heaviest = len(want), got - want, int(np.argmax(want))
    half, top = m // 2, want[heaviest]
    if m == n and np.allclose(got, 1.0):
        return "every particle is selected once: particles with n = m must be resampled too"
    for shift in (-1, 1):
        if np.abs(np.roll(got, -shift) - want).max() < np.abs(excess).max() / 4:
            return "the copies are those of the particle next to it: off by one?"
    if np.abs(np.sort(got) - np.sort(want)).max() < np.abs(excess).max() / 4:
        return "the copies are those of other particles: are the particles sorted, and not the ancestors?"
    for value in np.unique(want[want > 0]):
        tied = np.flatnonzero(want == value)
        if len(tied) > 1 and got[tied[1:]].sum() < 0.1 * value and got[tied[0]] > 1.5 * value:
            return f"all copies of the particles of equal weight go to the first of them, particle {tied[0]}"
    never = (want > 0) & (got <= 0)
    if want[never].sum() * calls > 20 and want[never].max() < want[got > 0].min():
        return f"weights up to {want[never].max() / top:.2g} of the largest are never selected: are they dropped?"
    first, second = slice(0, half), slice(half, m)
    inside = [
        np.abs(got[s] / got[s].sum() - want[s] / want[s].sum()).max() for s in (first, second) if got[s].sum() > 0
    ]
    if abs(got[first].sum() / n - half / m) < 0.02 < abs(want[first].sum() / n - half / m) and max(inside) < 0.05:
        return "each half of the particles gets half of the copies: are the halves resampled apart?"
    some = (want > 0.01) & (got > 0)
    if len(np.unique(want[some])) > 2:
        power, shift = np.polyfit(np.log(want[some]), np.log(got[some]), 1, w=np.sqrt(want[some]))
        residual = np.log(got[some]) - power * np.log(want[some]) - shift
        if abs(power - 1) > 0.03 and np.abs(residual).max() < 0.15:
            return f"copies grow as w^{power:.2f}: are the weights {'flattened' if power < 1 else 'sharpened'}?"
    if top < 0.6 * n and 0.3 < excess.max() < 1.1 and excess.max() > 0.8 * np.abs(excess).sum() / 2:
        return f"one of {n} positions always goes to particle {int(np.argmax(excess))}"
    if int(np.argmax(np.abs(excess))) == heaviest:
        return f"the heaviest particle gets {100 * excess[heaviest] / top:+.2g} %"
    return ""


def evidence_hint(total: float, W: np.ndarray) -> str:
    """A hint if the mean weight after selection equals that over the positive weights."""
    if (W > 0).all() or abs(total * (W > 0).mean() - 1) > 1e-9:
        return ""
    return ": it is the mean over the positive weights only, divide by the number of all particles"


def log_of(weights: Any) -> np.ndarray:
    """Log weights, -inf for zero."""
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(weights, dtype=np.float64))


class CountingGenerator(np.random.Generator):
    """The generator ``default_rng(seed)``, which counts its draws and skips the test above a budget.

    `budget` is a number of draws, and a call counts as 15 draws. `slow` is the reason of the skip.
    """

    def __init__(self, seed: int, budget: int, slow: str) -> None:
        super().__init__(np.random.PCG64(np.random.SeedSequence(seed)))
        self.budget, self.slow, self.drawn = budget, slow, 0

    def count(self, size: int) -> None:
        self.drawn += size + 15
        if self.drawn > self.budget:
            raise SkipTest(f"{self.slow}: more than {self.budget:.3g} random numbers are drawn")


def _counted(name: str) -> Callable[..., Any]:
    draw = getattr(np.random.Generator, name)

    def method(self: CountingGenerator, *arguments: Any, **named: Any) -> Any:
        result = draw(self, *arguments, **named)
        self.count(np.size(result))
        return result

    return method


for _name, _value in vars(np.random.Generator).items():
    if callable(_value) and not _name.startswith("_") and _name not in ("spawn", "shuffle"):
        setattr(CountingGenerator, _name, _counted(_name))


class ConstantGenerator(CountingGenerator):
    """A generator whose `random` always returns the same value."""

    def __init__(self, value: float, budget: int) -> None:
        super().__init__(0, budget, "constant")
        self._value = value

    def random(self, size=None, dtype=np.float64, out=None):  # type: ignore[no-untyped-def]
        self.count(int(np.prod(size or ())))
        return self._value if size is None else np.full(size, self._value)
