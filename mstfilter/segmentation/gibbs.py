"""Exact draws of cuts from Gibbs laws, and by rejection from the law of the paper.

Under the Gibbs law a cut has probability proportional to exp(b v(c)) with v additive over nodes. One pass up the
tree gives the probability ``stop[n]`` that a cut which reaches node n holds n itself; walking down from the root
with these coins draws a cut exactly.

The paper's law, exp(-(v* - v)^2 / s2), lies below a scaled Gibbs law for any b,
``exp(-d^2 / s2) <= exp(-b d + b^2 s2 / 4)``, so Gibbs draws accepted with probability
``exp(-(d - b s2 / 2)^2 / s2)`` are exact and independent: `ExactCuts`. The b that accepts most often solves
``b = 2 E_b[d] / s2``.

>>> sample = ExactCuts().sample(np.random.default_rng(0), tree, w, 10)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, log1p

import numpy as np

from mstfilter.errors import InputError
from mstfilter.segmentation.interfaces import CutSample, CutSampler
from mstfilter.segmentation.optimal import check_values, optimal_cut
from mstfilter.segmentation.tree import Tree

__all__ = ["ExactCuts", "Gibbs", "best_envelope", "gibbs"]


@dataclass(frozen=True, eq=False)
class Gibbs:
    """A Gibbs law over the cuts of a tree (and of its subtrees).

    Parameters
    ----------
    tree : Tree
    b : float
        Inverse temperature, per unit of value.
    w : list of float
        Node values.
    log_z : list of float
        Log normaliser of every subtree.
    stop : list of float
        Probability that a cut which reaches the node holds the node itself.
    mean : list of float
        Expected value of the part of a cut inside the subtree.
    """

    tree: Tree
    b: float
    w: list[float]
    log_z: list[float]
    stop: list[float]
    mean: list[float]

    def draw(self, random: Callable[[], float], node: int) -> list[int]:
        """A cut of the subtree of `node`, unordered; `random` gives uniform numbers in [0, 1)."""
        children, stop = self.tree.child_tuples, self.stop
        cut, stack = [], [node]
        while stack:
            node = stack.pop()
            if random() < stop[node]:
                cut.append(node)
            else:
                stack.extend(children[node])
        return cut

    def log_prob(self, cut: list[int], node: int) -> float:
        """Log probability of a cut of the subtree of `node`."""
        return self.b * sum(self.w[x] for x in cut) - self.log_z[node]

    def expected_size(self) -> float:
        """Expected number of nodes in a cut."""
        size = [0.0] * self.tree.n_nodes
        for node in range(self.tree.n_nodes):
            inside = sum(size[c] for c in self.tree.child_tuples[node])
            size[node] = self.stop[node] + (1 - self.stop[node]) * inside
        return size[-1]


def gibbs(tree: Tree, w: np.ndarray, b: float) -> Gibbs:
    """The Gibbs law with inverse temperature `b` under node values `w` (N,)."""
    values = check_values(tree, w).tolist()
    n = tree.n_nodes
    log_z, stop, mean = [0.0] * n, [1.0] * n, [0.0] * n
    for node, children in enumerate(tree.child_tuples):
        own = b * values[node]
        if not children:
            log_z[node], mean[node] = own, values[node]
            continue
        split = inner = 0.0
        for child in children:
            split += log_z[child]
            inner += mean[child]
        if own >= split:
            log_z[node] = own + log1p(exp(split - own))
        else:
            log_z[node] = split + log1p(exp(own - split))
        stop[node] = pi = exp(own - log_z[node])
        mean[node] = pi * values[node] + (1 - pi) * inner
    return Gibbs(tree, b, values, log_z, stop, mean)


def best_envelope(tree: Tree, w: np.ndarray, best: float, s2: float) -> Gibbs:
    """The Gibbs law that fits the paper's law best: b = 2 E_b[best - v] / s2, by bisection in log b."""
    low = 0.0
    high = 2 * (best - gibbs(tree, w, 0.0).mean[-1]) / s2
    law = gibbs(tree, w, high)
    for _ in range(60):
        middle = (low * high) ** 0.5 if low > 0 else high / 64
        law = gibbs(tree, w, middle)
        if middle * s2 > 2 * (best - law.mean[-1]):
            high = middle
        else:
            low = middle
        # The envelope is exact for any b; this precision costs no acceptance.
        if high <= 0 or (low > 0 and high / low < 1.01):
            break
    return law


@dataclass(frozen=True)
class ExactCuts(CutSampler):
    """Independent exact draws from exp(-(v* - v)^2 / s2), or from exp(v / temperature).

    Parameters
    ----------
    sigma2 : float
        s2 relative to the squared value of the optimal cut: ``s2 = sigma2 v*^2``. No unit.
    max_tries : int
        Gibbs draws for each wanted cut before giving up.
    temperature : float
        0: the law of the paper. Above: the Gibbs law, in units of value; nothing is rejected, sigma2 plays no part.
    """

    sigma2: float = 1e-3
    max_tries: int = 100000
    temperature: float = 0.0

    def __post_init__(self) -> None:
        if not self.sigma2 > 0:
            raise InputError(f"sigma2 is {self.sigma2!r}, expected a number > 0")
        if self.temperature < 0:
            raise InputError(f"temperature is {self.temperature!r}, expected a number >= 0")

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        """`n` independent cuts."""
        best = float(check_values(tree, w)[optimal_cut(tree, w)].sum())
        s2 = max(self.sigma2 * best**2, 1e-300)
        warm = self.temperature > 0
        law = gibbs(tree, w, 1 / self.temperature) if warm else best_envelope(tree, w, best, s2)
        cuts: list[np.ndarray] = []
        values: list[float] = []
        tries = 0
        while len(cuts) < n:
            tries += 1
            if tries > self.max_tries * n:
                raise InputError(
                    f"exact cut sampler accepted {len(cuts)} of {tries - 1} draws, {n} are wanted",
                    "use the `mh` sampler for this tree, or raise max_tries",
                )
            cut = law.draw(rng.random, tree.root)
            d = best - sum(law.w[x] for x in cut)
            if warm or rng.random() < exp(-((d - law.b * s2 / 2) ** 2) / s2):
                cuts.append(np.sort(np.array(cut, dtype=np.int64)))
                values.append(best - d)
        v = np.array(values)
        diagnostics = {
            "acceptance": n / tries if tries else 1.0,
            "distinct": len({c.tobytes() for c in cuts}) / max(n, 1),
        }
        log_p = (v - best) / self.temperature if warm else -((best - v) ** 2) / s2
        return CutSample(tuple(cuts), v, log_p, diagnostics)
