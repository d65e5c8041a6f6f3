"""Exact expectations of whatever draws: every outcome of its generator, with its probability.

>>> for probability, result in outcomes(lambda rng: rng.random() < 0.3, cells=10):
...     total += probability * result                       # 0.3 exactly

A generator that is scripted: `outcomes` runs a function once for every script. A uniform is one of `cells` midpoints,
all equally likely, which is exact where what is computed jumps at multiples of 1 / cells only. With ``coins=True``
arrays of uniforms are decided where they are compared: ``rng.random(k) * scale < bound`` is true with the exact
probability.
"""

from __future__ import annotations

from itertools import combinations, permutations
from unittest import SkipTest

import numpy as np


class Scripted(np.random.Generator):
    """Takes its decisions from a script of digits; digits beyond it are 0."""

    def __init__(self, script, cells, coins):
        super().__init__(np.random.PCG64(0))
        self.script, self.cells, self.coins = script, cells, coins
        self.taken, self.probability = [], 1.0

    def digit(self, weights):
        """Index of an outcome, with probabilities proportional to `weights` (zeros never come up)."""
        possible = np.flatnonzero(np.asarray(weights) > 0)
        k = self.script[len(self.taken)] if len(self.taken) < len(self.script) else 0
        self.taken.append((k, len(possible)))
        self.probability *= weights[possible[k]] / np.sum(weights)
        return int(possible[k])

    def random(self, size=None):
        if isinstance(size, tuple):
            (size,) = size
        if self.coins and size is not None:
            return Coins(self, size)
        drawn = [(self.digit(np.ones(self.cells)) + 0.5) / self.cells for _ in range(1 if size is None else size)]
        return drawn[0] if size is None else np.array(drawn)

    def integers(self, low, high, size):
        return np.array([low + self.digit(np.ones(high - low)) for _ in range(size)], dtype=np.int64)

    def permutation(self, n):
        orders = list(permutations(range(n)))
        return np.array(orders[self.digit(np.ones(len(orders)))])

    def choice(self, n, k, replace, shuffle):
        assert not replace and not shuffle
        subsets = list(combinations(range(n), k))
        return np.array(subsets[self.digit(np.ones(len(subsets)))])


class Coins:
    """Uniforms times a scale; compared with a bound they become decisions of exact probability."""

    def __init__(self, rng, size, scale=1.0):
        self.rng, self.size, self.scale = rng, size, scale

    def __mul__(self, scale):
        return Coins(self.rng, self.size, self.scale * scale)

    def __lt__(self, bound):
        p = np.clip(np.broadcast_to(bound / self.scale, self.size), 0.0, 1.0)
        return np.array([self.rng.digit([1 - a, a]) == 1 for a in p], dtype=bool)

    def __ge__(self, bound):
        return ~(self < bound)


def outcomes(run, cells=1, coins=False):
    """(probability, result) of every script; the probabilities add up to one."""
    script, total = [], 0.0
    while True:
        rng = Scripted(script, cells, coins)
        result = run(rng)
        total += rng.probability
        yield rng.probability, result
        digits = list(rng.taken)
        while digits and digits[-1][0] == digits[-1][1] - 1:
            digits.pop()
        if not digits:
            break
        script = [k for k, _ in digits[:-1]] + [digits[-1][0] + 1]
    assert abs(total - 1) < 1e-9, "outcomes are missing"


class ConstantGenerator(np.random.Generator):
    """A generator whose `random` always returns one value. Skips the test after 10,000 calls."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self._value, self._calls = value, 0

    def random(self, size=None, dtype=np.float64, out=None):
        self._calls += 1
        if self._calls > 10_000:
            raise SkipTest("it does not end")
        return self._value if size is None else np.full(size, self._value)
