"""Segmentations drawn from a tree by Metropolis-Hastings (paper IV-B, Algorithm 1).

The chain starts at the optimal cut c* and aims at ``p(c) = exp(-(v(c*) - v(c))^2 / s2)`` with
``s2 = sigma2 v(c*)^2``. Values that are log odds (`MergeLogOdds`) have natural units and need no such scale: with a
`temperature` the chain aims at ``p(c) = exp((v(c) - v(c*)) / temperature)``, at 1 the law that the odds stand for.

- ``mst``: ``MetropolisHastingsCuts(temperature=1)``: one chain, MoveNode mixed with subtree redraws.
- ``paper``: ``MetropolisHastingsCuts(0.25, burn_in=0, thinning=20, redraw_share=0)``.
- ``authors``: ``MetropolisHastingsCuts(0.25, burn_in=0, thinning=20, moves="authors", redraw_share=0, restart=True,
  include_optimal=True, redraw_repeated=True)``.

>>> sample = MetropolisHastingsCuts().sample(np.random.default_rng(0), tree, w, 5)
>>> sample.diagnostics["acceptance"], sample.diagnostics["autocorrelation_steps"]
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf
from typing import Any

import numpy as np

from mstfilter.errors import InputError
from mstfilter.segmentation.gibbs import best_envelope, gibbs
from mstfilter.segmentation.interfaces import CutSample, CutSampler
from mstfilter.segmentation.moves import (
    AuthorsMoves,
    CutState,
    FeasibleMoves,
    MoveRule,
    NodeMoves,
    SubtreeRedraw,
)
from mstfilter.segmentation.optimal import check_values, optimal_cut
from mstfilter.segmentation.tree import Tree

__all__ = ["CutChain", "MetropolisHastingsCuts"]

RULES: dict[str, type[MoveRule]] = {"node": NodeMoves, "feasible": FeasibleMoves, "authors": AuthorsMoves}


class CutChain:
    """A Metropolis-Hastings chain over cuts, one step at a time.

    Parameters
    ----------
    tree : Tree
    w : (N,) array
        Node values.
    best : float
        v(c*).
    s2 : float
        Scale of the target law, in squared units of value.
    cut : array of int
        Where it starts.
    temperature : float
        If > 0, the target is the Gibbs law at this temperature, in units of value, and s2 plays no part.
    """

    def __init__(
        self, tree: Tree, w: np.ndarray, best: float, s2: float, cut: np.ndarray, temperature: float = 0.0
    ) -> None:
        self.state = CutState(tree, cut.tolist())
        self.w = w.tolist()
        self.best, self.s2, self.temperature = best, s2, temperature
        self.value = sum(self.w[x] for x in self.state.nodes)
        self.steps = self.accepted = 0

    def log_target(self, value: float) -> float:
        """Unnormalised log p of a cut of this value."""
        if self.temperature > 0:
            return (value - self.best) / self.temperature
        return -((self.best - value) ** 2) / self.s2

    def judge(self, rule: MoveRule, choice: Any) -> tuple[Any, float, float]:
        """Move (None: stay), value after it and log of the acceptance ratio of a choice."""
        move = rule.outcome(self.state, choice)
        if move is None or move.log_ratio == -inf:
            return None, self.value, -inf
        value = self.value
        for x in move.removed:
            value -= self.w[x]
        for x in move.added:
            value += self.w[x]
        return move, value, self.log_target(value) - self.log_target(self.value) + move.log_ratio

    def step(self, random: Any, rule: MoveRule) -> None:
        """One step under a rule."""
        move, value, log_ratio = self.judge(rule, rule.choose(random, self.state))
        self.steps += 1
        if move is not None and (log_ratio >= 0 or random() < exp(log_ratio)):
            self.state.apply(move)
            self.value = value
            self.accepted += 1

    def cut(self) -> np.ndarray:
        """The present cut, ascending."""
        return np.sort(np.array(self.state.nodes, dtype=np.int64))


@dataclass(frozen=True)
class MetropolisHastingsCuts(CutSampler):
    """Cuts from a Metropolis-Hastings chain started at the optimal cut.

    Parameters
    ----------
    sigma2 : float
        s2 relative to the squared value of the optimal cut. No unit. Unused with a temperature.
    burn_in : int
        Steps before the first sample (on top of `thinning`), once a chain.
    thinning : int
        Steps from one sample to the next.
    moves : {"node", "feasible", "authors"}
        Local moves: uniform node then direction (the paper; exact), uniform over possible moves (exact), or
        the authors' program, whose forward probability is faulty.
    redraw_share : float
        Share of the steps that redraw a random subtree instead of a local move.
    restart : bool
        Start at the optimal cut again for each sample.
    include_optimal : bool
        The first sample is the optimal cut itself.
    redraw_repeated : bool
        A cut that was drawn before is drawn once more, then kept whatever it is.
    temperature : float
        0: the law of the paper. Above: the Gibbs law exp(v / temperature), in units of value.
    """

    sigma2: float = 1e-3
    burn_in: int = 1000
    thinning: int = 500
    moves: str = "node"
    redraw_share: float = 0.3
    restart: bool = False
    include_optimal: bool = False
    redraw_repeated: bool = False
    temperature: float = 0.0

    def __post_init__(self) -> None:
        if self.moves not in RULES:
            raise InputError(f"move rule {self.moves!r} is not known", f"there are: {', '.join(RULES)}")
        if not self.sigma2 > 0:
            raise InputError(f"sigma2 is {self.sigma2!r}, expected a number > 0")
        if self.temperature < 0:
            raise InputError(f"temperature is {self.temperature!r}, expected a number >= 0")
        if self.burn_in < 0 or self.thinning < 1:
            raise InputError(f"burn_in {self.burn_in!r} must be >= 0 and thinning {self.thinning!r} >= 1")
        if not 0 <= self.redraw_share <= 1:
            raise InputError(f"redraw_share is {self.redraw_share!r}, expected a share 0 .. 1")

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        """`n` cuts from the chain."""
        w = check_values(tree, w)
        optimal = optimal_cut(tree, w)
        best = float(w[optimal].sum())
        s2 = max(self.sigma2 * best**2, 1e-300)
        local = RULES[self.moves]()
        redraw = None
        if self.redraw_share > 0:
            warm = self.temperature > 0
            law = gibbs(tree, w, 1 / self.temperature) if warm else best_envelope(tree, w, best, s2)
            redraw = SubtreeRedraw(law)
        random = _uniforms(rng)

        chain = CutChain(tree, w, best, s2, optimal, self.temperature)
        trace: list[float] = []
        steps = accepted = 0

        def advance(n_steps: int) -> None:
            for _ in range(n_steps):
                if redraw is not None and random() < self.redraw_share:
                    chain.step(random, redraw)
                else:
                    chain.step(random, local)
                trace.append(chain.value)

        def draw() -> np.ndarray:
            nonlocal chain, steps, accepted
            if self.restart:
                steps, accepted = steps + chain.steps, accepted + chain.accepted
                chain = CutChain(tree, w, best, s2, optimal, self.temperature)
                advance(self.burn_in)
            advance(self.thinning)
            return chain.cut()

        cuts: list[np.ndarray] = [optimal] if self.include_optimal and n > 0 else []
        seen = {cut.tobytes() for cut in cuts}
        if not self.restart:
            advance(self.burn_in)
        while len(cuts) < n:
            cut = draw()
            if self.redraw_repeated and cut.tobytes() in seen:
                cut = draw()
            seen.add(cut.tobytes())
            cuts.append(cut)
        steps, accepted = steps + chain.steps, accepted + chain.accepted
        v = np.array([w[cut].sum() for cut in cuts])
        diagnostics: dict[str, Any] = {
            "steps": steps,
            "acceptance": accepted / steps if steps else 0.0,
            "distinct": len(seen) / max(n, 1),
            "size_of_best": len(optimal),
        }
        if not self.restart:
            diagnostics["autocorrelation_steps"] = _autocorrelation(np.array(trace[self.burn_in :]))
        return CutSample(tuple(cuts), v, np.array([chain.log_target(float(x)) for x in v]), diagnostics)


def _uniforms(rng: np.random.Generator, block: int = 1024) -> Any:
    """A function that gives uniform numbers one by one, drawn in blocks: ten times faster than single draws."""

    def numbers() -> Any:
        while True:
            yield from rng.random(block).tolist()

    return numbers().__next__


def _autocorrelation(trace: np.ndarray) -> float | None:
    """Integrated autocorrelation time of a trace in steps; None where it is too short or constant.

    A chain shorter than about 50 such times underestimates it: the figure is a warning, not a certificate.
    """
    if len(trace) < 100 or np.ptp(trace) == 0:
        return None
    from emcee.autocorr import integrated_time

    return float(integrated_time(trace, tol=0, quiet=True)[0])
