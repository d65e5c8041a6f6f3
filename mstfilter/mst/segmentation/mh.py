"""Segmentations drawn from a tree by Metropolis-Hastings (paper IV-B, Algorithm 1).

The chain starts at the optimal cut c*. If values are log odds (`MergeLogOdds`), a `temperature` gives the target
``p(c) = exp((v(c) - v(c*)) / temperature)``. Other values need a scale, and the published target has one: ``p(c) =
exp(-(v(c*) - v(c))^2 / s2)`` with ``s2 = sigma2 v(c*)^2``.

- ``mst`` uses ``MetropolisHastingsCuts(temperature=1)``, one chain with MoveNode and subtree redraws.
- ``paper`` uses ``MetropolisHastingsCuts(0.25, burn_in=0, thinning=20)``.
- ``authors`` uses ``MetropolisHastingsCuts(0.25, burn_in=0, thinning=20, moves="authors", restart=True,
  include_optimal=True, redraw_repeated=True)``.

>>> sample = MetropolisHastingsCuts().sample(np.random.default_rng(0), tree, w, 5)
>>> sample.diagnostics["acceptance"], sample.diagnostics["autocorrelation_steps"]

A `MoveRule` proposes the next cut. MoveNode (`NodeMoves`) draws one of the n nodes of the cut, and then *up* or
*down* with equal probability. Down replaces the node by its children; up replaces it and all its siblings, which must
be in the cut, by their parent. Since each of the m siblings proposes the same move up, this has the probability
``g(up) = m / (2 n)``, and the reverse move ``1 / (2 n')``, where n' is the number of nodes after the move up. A rule
first draws a choice at random, which then determines the move:

>>> state = CutState(tree, cut)
>>> rule = NodeMoves()
>>> move = rule.outcome(state, rule.choose(random, state))     # None: the chain stays
>>> move.removed, move.added, move.log_ratio                   # log_ratio = log g(back) - log g(forward)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from math import exp, inf, log
from typing import Any, Literal, NamedTuple

import numpy as np

from mstfilter.base.fields import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Share
from mstfilter.mst.segmentation.cuts import CutSample, CutSampler, Gibbs, check_values, gibbs, optimal_cut
from mstfilter.mst.segmentation.tree import Tree


class Move(NamedTuple):
    """Nodes that a move removes and adds, and log g(back) - log g(forward) of the move."""

    removed: tuple[int, ...] | list[int]
    added: tuple[int, ...] | list[int]
    log_ratio: float


class CutState:
    """A mutable cut. Nodes are inserted, removed or drawn uniformly in constant time."""

    def __init__(self, tree: Tree, cut: list[int]) -> None:
        self.children = tree.children
        self.parent = tree.parent.tolist()
        self.root = tree.root
        self.nodes: list[int] = []
        self.position = [-1] * tree.n_nodes  # index of the node in `nodes`
        self.inside = [0] * tree.n_nodes  # number of children that are in the cut
        self.splittable = 0  # number of nodes of the cut that have children
        for node in cut:
            self._insert(node)

    def _insert(self, node: int) -> None:
        self.position[node] = len(self.nodes)
        self.nodes.append(node)
        if node != self.root:
            self.inside[self.parent[node]] += 1
        self.splittable += bool(self.children[node])

    def _remove(self, node: int) -> None:
        position, last = self.position[node], self.nodes.pop()
        if last != node:
            self.nodes[position] = last
            self.position[last] = position
        self.position[node] = -1
        if node != self.root:
            self.inside[self.parent[node]] -= 1
        self.splittable -= bool(self.children[node])

    def apply(self, move: Move) -> None:
        """Replace the removed nodes of a move by the added nodes."""
        for node in move.removed:
            self._remove(node)
        for node in move.added:
            self._insert(node)

    def up(self, node: int) -> int:
        """The parent if the node and all its siblings are in the cut, else -1."""
        if node == self.root:
            return -1
        parent = self.parent[node]
        return parent if self.inside[parent] == len(self.children[parent]) else -1

    def below(self, node: int) -> list[int]:
        """Nodes of the cut inside the subtree of `node`; empty if an ancestor of `node` is in the cut."""
        found, stack = [], [node]
        while stack:
            top = stack.pop()
            if self.position[top] >= 0:
                found.append(top)
            else:
                stack.extend(self.children[top])
        return found

    def covered_from_above(self, node: int) -> bool:
        """Whether a proper ancestor of the node is in the cut."""
        while node != self.root:
            node = self.parent[node]
            if self.position[node] >= 0:
                return True
        return False


class MoveRule(ABC):
    """Proposes the next cut of a Metropolis-Hastings chain."""

    @abstractmethod
    def choose(self, random: Callable[[], float], state: CutState) -> Any:
        """Draw a choice. ``random()`` is uniform in [0, 1)."""

    @abstractmethod
    def outcome(self, state: CutState, choice: Any) -> Move | None:
        """The move that results from a choice; None if the cut does not change."""


@dataclass(frozen=True)
class NodeMoves(MoveRule):
    """MoveNode of the paper: a random node of the cut moves up or down with equal probability, if possible."""

    def choose(self, random: Callable[[], float], state: CutState) -> tuple[int, bool]:
        """A random node of the cut, and whether it moves up."""
        draw = random() * 2 * len(state.nodes)
        return state.nodes[int(draw) >> 1], bool(int(draw) & 1)

    def outcome(self, state: CutState, choice: tuple[int, bool]) -> Move | None:
        node, upward = choice
        n = len(state.nodes)
        if upward:
            parent = state.up(node)
            if parent < 0:
                return None
            children = state.children[parent]
            m = len(children)
            return Move(children, (parent,), log(n / (m * (n - m + 1))))
        children = state.children[node]
        if not children:
            return None
        m = len(children)
        return Move((node,), children, log(m * n / (n + m - 1)))


@dataclass(frozen=True)
class AuthorsMoves(MoveRule):
    """The moves of the authors' program, including an error: the target distribution is not stationary.

    The choice is uniform over (node, direction). A move up, which every node except the root can make, replaces all
    nodes of the cut below the parent by the parent. The program takes 1 / (number of choices) as its forward
    probability. But each sibling in the cut proposes the same move, so merges are accepted too often.
    """

    def choose(self, random: Callable[[], float], state: CutState) -> tuple[int, bool] | None:
        """A node of the cut, and True for a move up; None if no move is possible."""
        moves = self.possible(state)
        return moves[int(random() * len(moves))] if moves else None

    @staticmethod
    def possible(state: CutState) -> list[tuple[int, bool]]:
        """All moves (node, True for a move up)."""
        moves = []
        for node in state.nodes:
            if node != state.root:
                moves.append((node, True))
            if state.children[node]:
                moves.append((node, False))
        return moves

    def outcome(self, state: CutState, choice: tuple[int, bool] | None) -> Move | None:
        if choice is None:
            return None
        node, upward = choice
        at_root = state.position[state.root] >= 0
        here = self._count(len(state.nodes), state.splittable, at_root)
        if upward:
            parent = state.parent[node]
            removed = state.below(parent)
            if len(removed) > state.inside[parent]:
                # A child of the parent was split: no single move leads back.
                return Move(removed, (parent,), -inf)
            splittable = state.splittable - sum(1 for x in removed if state.children[x]) + 1
            there = self._count(len(state.nodes) - len(removed) + 1, splittable, parent == state.root)
            return Move(removed, (parent,), log(here / there))
        children = state.children[node]
        splittable = state.splittable - 1 + sum(1 for x in children if state.children[x])
        there = self._count(len(state.nodes) - 1 + len(children), splittable, False)
        return Move((node,), children, log(here / there))

    @staticmethod
    def _count(n: int, splittable: int, at_root: bool) -> int:
        """Number of possible moves: up for every node except the root, and down for every inner node."""
        return (0 if at_root else n) + splittable


@dataclass(frozen=True, eq=False)
class SubtreeRedraw(MoveRule):
    """Redraws the cut of a random subtree from the Gibbs distribution `law`, which is the target of the chain.

    The root of the subtree is uniform over the inner nodes; if an ancestor of it is in the cut, the cut does not
    change. A choice is (inner node, new nodes).
    """

    law: Gibbs

    def choose(self, random: Callable[[], float], state: CutState) -> tuple[int, list[int]]:
        """An inner node, and the new nodes of the cut inside its subtree."""
        tree = self.law.tree
        inner = tree.n_nodes - tree.n_leaves
        if inner == 0:
            return tree.root, [tree.root]
        node = tree.n_leaves + int(random() * inner)
        if state.covered_from_above(node):
            return node, []
        return node, self.law.draw(random, node)

    def outcome(self, state: CutState, choice: tuple[int, list[int]]) -> Move | None:
        node, added = choice
        if not added or state.covered_from_above(node):
            return None
        removed = state.below(node)
        w = self.law.w
        old, new = sum(w[x] for x in removed), sum(w[x] for x in added)
        return Move(removed, added, self.law.b * (old - new))  # log of exp(b v(old)) / exp(b v(new))


LOCAL_MOVES: dict[str, type[MoveRule]] = {"node": NodeMoves, "authors": AuthorsMoves}


class CutChain:
    """A Metropolis-Hastings chain over cuts that starts at an initial cut.

    A cut of value v has the log probability ``log_p(v)`` in the target distribution, up to a constant.
    """

    def __init__(self, tree: Tree, w: np.ndarray, log_p: Callable[[float], float], cut: np.ndarray) -> None:
        self.tree, self.w, self.log_p = tree, w.tolist(), log_p
        self.steps = self.accepted = 0
        self.restart(cut)

    def restart(self, cut: np.ndarray) -> None:
        """Continue the chain from another cut."""
        self.state = CutState(self.tree, cut.tolist())
        self.value = sum(self.w[x] for x in self.state.nodes)

    def judge(self, rule: MoveRule, choice: Any) -> tuple[Move | None, float, float]:
        """The move of a choice (None: no change), the value of the cut after it, and the log acceptance ratio."""
        move = rule.outcome(self.state, choice)
        if move is None or move.log_ratio == -inf:
            return None, self.value, -inf
        value = self.value
        for x in move.removed:
            value -= self.w[x]
        for x in move.added:
            value += self.w[x]
        return move, value, self.log_p(value) - self.log_p(self.value) + move.log_ratio

    def step(self, random: Callable[[], float], rule: MoveRule) -> None:
        """Make one step of the chain with a move rule."""
        move, value, log_ratio = self.judge(rule, rule.choose(random, self.state))
        self.steps += 1
        if move is not None and (log_ratio >= 0 or random() < exp(log_ratio)):
            self.state.apply(move)
            self.value = value
            self.accepted += 1

    def cut(self) -> np.ndarray:
        """The present cut, in ascending order."""
        return np.sort(np.array(self.state.nodes, dtype=np.int64))


@dataclass(frozen=True)
class MetropolisHastingsCuts(CutSampler):
    """Cuts from a Metropolis-Hastings chain that starts at the optimal cut.

    Parameters
    ----------
    sigma2 : float
        s2 divided by the squared value of the optimal cut. With a temperature, s2 is not used.
    burn_in : int
        Number of steps before the first sample of each chain, in addition to `thinning`.
    thinning : int
        Number of steps between samples.
    moves : {"node", "authors"}
        Rule of the local moves: the exact rule of the paper, or the rule of the authors' program.
    redraw_share : float
        Fraction of steps that redraw a random subtree instead of making a local move; 0 if the temperature is 0.
    restart : bool
        If True, start a new chain at the optimal cut for each sample.
    include_optimal : bool
        If True, the first sample is the optimal cut.
    redraw_repeated : bool
        If True, a cut that was sampled before is replaced by one further cut, which may also be a repetition.
    temperature : float
        Temperature of the target exp(v / temperature), in units of value. If the temperature is 0, the chain has the
        target of the paper.
    """

    sigma2: PositiveFloat = 1e-3
    burn_in: NonNegativeInt = 1000
    thinning: PositiveInt = 500
    moves: Literal["node", "authors"] = "node"
    redraw_share: Share = 0.3
    restart: bool = False
    include_optimal: bool = False
    redraw_repeated: bool = False
    temperature: NonNegativeFloat = 0.0

    def sample(self, rng: np.random.Generator, tree: Tree, w: np.ndarray, n: int) -> CutSample:
        w = check_values(tree, w)
        optimal = optimal_cut(tree, w)
        log_p = self._law(float(w[optimal].sum()))
        chain = CutChain(tree, w, log_p, optimal)
        values = self._values(rng, chain, w)
        trace: list[float] = []

        def draw() -> np.ndarray:
            if self.restart:
                chain.restart(optimal)
                trace.extend(islice(values, self.burn_in))
            trace.extend(islice(values, self.thinning))
            return chain.cut()

        cuts: list[np.ndarray] = [optimal] if self.include_optimal and n > 0 else []
        seen = {cut.tobytes() for cut in cuts}
        if not self.restart:
            trace.extend(islice(values, self.burn_in))
        while len(cuts) < n:
            cut = draw()
            if self.redraw_repeated and cut.tobytes() in seen:
                cut = draw()
            seen.add(cut.tobytes())
            cuts.append(cut)
        diagnostics: dict[str, Any] = {
            "steps": chain.steps,
            "acceptance": chain.accepted / chain.steps if chain.steps else 0.0,
            "distinct": len(seen) / max(n, 1),
            "size_of_best": len(optimal),
        }
        if not self.restart:
            diagnostics["autocorrelation_steps"] = _autocorrelation(np.array(trace[self.burn_in :]))
        return CutSample(tuple(cuts), np.array([log_p(float(w[cut].sum())) for cut in cuts]), diagnostics)

    def _law(self, best: float) -> Callable[[float], float]:
        """Log probability of a cut relative to the optimal cut, from its value. `best` is v(c*)."""
        if self.temperature > 0:
            return lambda value: (value - best) / self.temperature
        s2 = max(self.sigma2 * best**2, 1e-300)
        return lambda value: -((best - value) ** 2) / s2

    def _values(self, rng: np.random.Generator, chain: CutChain, w: np.ndarray) -> Iterator[float]:
        """Make an unlimited number of steps of a chain. Yields the value of the cut after each step."""
        random = _uniforms(rng).__next__
        local = LOCAL_MOVES[self.moves]()
        redraw = None
        if self.redraw_share > 0 and self.temperature > 0:
            redraw = SubtreeRedraw(gibbs(chain.tree, w, 1 / self.temperature))
        while True:
            chain.step(random, local if redraw is None or random() >= self.redraw_share else redraw)
            yield chain.value


def _uniforms(rng: np.random.Generator) -> Iterator[float]:
    """Uniform random numbers. Drawing blocks of numbers is ten times faster than drawing single numbers."""
    while True:
        yield from rng.random(1024).tolist()


def _autocorrelation(trace: np.ndarray) -> float | None:
    """Integrated autocorrelation time of a trace in steps; None for a constant trace or fewer than 100 steps.

    The estimate is too low for a chain shorter than about 50 autocorrelation times. A low value does not prove
    convergence.
    """
    if len(trace) < 100 or np.ptp(trace) == 0:
        return None
    from emcee.autocorr import integrated_time

    return float(integrated_time(trace, tol=0, quiet=True)[0])
