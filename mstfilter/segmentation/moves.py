"""Moves of a Markov chain over the cuts of a tree (MoveNode, paper IV-B), with exact proposal ratios.

Going *up* at a node of the cut replaces it and all its siblings, which must be in the cut, by their parent; going
*down* replaces a node by its children. Any of the m siblings can propose the same way up, so with a node drawn
uniformly from n and a fair coin for the direction ``g(up) = m / (2 n)`` and back ``1 / (2 n')``.

A rule draws a *choice*; what the choice leads to is deterministic:

>>> state = CutState(tree, cut)
>>> rule = NodeMoves()
>>> move = rule.outcome(state, rule.choose(random, state))     # None: the chain stays
>>> move.removed, move.added, move.log_ratio                   # log_ratio = log g(back) - log g(forward)

`choices` lists all choices with their probabilities: the tests build transition matrices from it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import exp, inf, log
from typing import Any, NamedTuple

from mstfilter.segmentation.gibbs import Gibbs
from mstfilter.segmentation.tree import Tree

__all__ = ["AuthorsMoves", "CutState", "FeasibleMoves", "Move", "MoveRule", "NodeMoves", "SubtreeRedraw"]

Uniform = Callable[[], float]


class CutState:
    """A cut under change: constant-time insertion, removal and draws.

    Mutable on purpose: it lives inside one call of a sampler.
    """

    def __init__(self, tree: Tree, cut: list[int]) -> None:
        self.children = tree.child_tuples
        self.parent = tree.parent.tolist()
        self.root = tree.root
        self.nodes: list[int] = []
        self.position = [-1] * tree.n_nodes
        self.inside = [0] * tree.n_nodes  # children of the node that are in the cut
        self.splittable = 0  # nodes of the cut that have children
        for node in cut:
            self._insert(node)

    def _insert(self, node: int) -> None:
        self.position[node] = len(self.nodes)
        self.nodes.append(node)
        if node != self.root:
            self.inside[self.parent[node]] += 1
        self.splittable += bool(self.children[node])

    def _remove(self, node: int) -> None:
        place, last = self.position[node], self.nodes.pop()
        if last != node:
            self.nodes[place] = last
            self.position[last] = place
        self.position[node] = -1
        if node != self.root:
            self.inside[self.parent[node]] -= 1
        self.splittable -= bool(self.children[node])

    def apply(self, move: Move) -> None:
        """Carry a move out."""
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
        """The nodes of the cut inside the subtree of `node`; empty if an ancestor of it is in the cut."""
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


class Move(NamedTuple):
    """Nodes that leave and enter the cut, and log g(back) - log g(forward) of the proposal."""

    removed: tuple[int, ...] | list[int]
    added: tuple[int, ...] | list[int]
    log_ratio: float


class MoveRule(ABC):
    """How a chain proposes its next cut."""

    @abstractmethod
    def choose(self, random: Uniform, state: CutState) -> Any:
        """Draw a choice."""

    @abstractmethod
    def outcome(self, state: CutState, choice: Any) -> Move | None:
        """What a choice leads to; None: the chain stays."""

    @abstractmethod
    def choices(self, state: CutState) -> list[tuple[float, Any]]:
        """All choices with their probabilities."""


@dataclass(frozen=True)
class NodeMoves(MoveRule):
    """A node of the cut uniformly, then up or down by a fair coin; what is impossible stays (the paper)."""

    def choose(self, random: Uniform, state: CutState) -> tuple[int, bool]:
        """A node of the cut and whether to go up."""
        draw = random() * 2 * len(state.nodes)
        return state.nodes[int(draw) >> 1], bool(int(draw) & 1)

    def outcome(self, state: CutState, choice: tuple[int, bool]) -> Move | None:
        """The move with its exact ratio."""
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

    def choices(self, state: CutState) -> list[tuple[float, tuple[int, bool]]]:
        """Every node and direction."""
        share = 0.5 / len(state.nodes)
        return [(share, (node, upward)) for node in state.nodes for upward in (False, True)]


def _feasible(state: CutState, collapse: bool) -> list[tuple[int, bool]]:
    moves = []
    for node in state.nodes:
        if (node != state.root) if collapse else (state.up(node) >= 0):
            moves.append((node, True))
        if state.children[node]:
            moves.append((node, False))
    return moves


@dataclass(frozen=True)
class FeasibleMoves(MoveRule):
    """Uniform over the moves that are possible, with the exact ratio."""

    def choose(self, random: Uniform, state: CutState) -> tuple[int, bool] | None:
        """A node of the cut and whether to go up."""
        moves = _feasible(state, collapse=False)
        return moves[int(random() * len(moves))] if moves else None

    def outcome(self, state: CutState, choice: tuple[int, bool] | None) -> Move | None:
        """The move with its exact ratio, by counting the moves there and back."""
        if choice is None:
            return None
        node, upward = choice
        here = len(_feasible(state, collapse=False))
        removed = state.children[state.parent[node]] if upward else (node,)
        added = (state.parent[node],) if upward else state.children[node]
        m = len(removed if upward else added)
        state.apply(Move(removed, added, 0.0))
        there = len(_feasible(state, collapse=False))
        state.apply(Move(added, removed, 0.0))
        ways = m if upward else 1 / m
        return Move(removed, added, log(here / (ways * there)))

    def choices(self, state: CutState) -> list[tuple[float, tuple[int, bool] | None]]:
        """Every node and direction."""
        moves = _feasible(state, collapse=False)
        return [(1 / len(moves), move) for move in moves] or [(1.0, None)]


@dataclass(frozen=True)
class AuthorsMoves(MoveRule):
    """The authors' program, fault included: not stationary for the law it aims at.

    Uniform over (node, direction) where up is allowed anywhere below the root and deletes all that the cut
    holds below the parent. The forward probability of going up is taken as 1 / M although each of the
    siblings in the cut proposes the same cut, so merges are accepted too often.
    """

    def choose(self, random: Uniform, state: CutState) -> tuple[int, bool] | None:
        """A node of the cut and whether to go up."""
        moves = _feasible(state, collapse=True)
        return moves[int(random() * len(moves))] if moves else None

    def outcome(self, state: CutState, choice: tuple[int, bool] | None) -> Move | None:
        """The move with the authors' ratio."""
        if choice is None:
            return None
        node, upward = choice
        here = self._count(state, len(state.nodes), state.splittable)
        if upward:
            parent = state.parent[node]
            removed = state.below(parent)
            if len(removed) > state.inside[parent]:
                # Something below the parent was split deeper: no single move leads back.
                return Move(removed, (parent,), -inf)
            splittable = state.splittable - sum(1 for x in removed if state.children[x]) + 1
            there = self._count(state, len(state.nodes) - len(removed) + 1, splittable, parent == state.root)
            return Move(removed, (parent,), log(here / there))
        children = state.children[node]
        splittable = state.splittable - 1 + sum(1 for x in children if state.children[x])
        there = self._count(state, len(state.nodes) - 1 + len(children), splittable, False)
        return Move((node,), children, log(here / there))

    @staticmethod
    def _count(state: CutState, n: int, splittable: int, is_root: bool | None = None) -> int:
        """Number of feasible moves: every node goes up, but the root; every inner node goes down."""
        if is_root is None:
            is_root = state.position[state.root] >= 0
        return (0 if is_root else n) + splittable

    def choices(self, state: CutState) -> list[tuple[float, tuple[int, bool] | None]]:
        """Every node and direction."""
        moves = _feasible(state, collapse=True)
        return [(1 / len(moves), move) for move in moves] or [(1.0, None)]


@dataclass(frozen=True, eq=False)
class SubtreeRedraw(MoveRule):
    """Redraw all that the cut holds inside a random subtree from a Gibbs law.

    An inner node is drawn uniformly, whatever the state; if the cut covers it from above, the chain stays.
    A choice is (inner node, new nodes).

    Parameters
    ----------
    law : Gibbs
        Surrogate to draw from.
    """

    law: Gibbs

    def choose(self, random: Uniform, state: CutState) -> tuple[int, list[int]]:
        """An inner node, and new nodes for what lies below it."""
        tree = self.law.tree
        inner = tree.n_nodes - tree.n_leaves
        if inner == 0:
            return tree.root, [tree.root]
        node = tree.n_leaves + int(random() * inner)
        if state.covered_from_above(node):
            return node, []
        return node, self.law.draw(random, node)

    def outcome(self, state: CutState, choice: tuple[int, list[int]]) -> Move | None:
        """The move with the ratio of the surrogate law."""
        node, added = choice
        if not added or state.covered_from_above(node):
            return None
        removed = state.below(node)
        w = self.law.w
        old, new = sum(w[x] for x in removed), sum(w[x] for x in added)
        return Move(removed, added, self.law.b * (old - new))

    def choices(self, state: CutState) -> list[tuple[float, tuple[int, list[int]]]]:
        """Every inner node with every cut below it: for small trees only."""
        tree = self.law.tree
        inner = range(tree.n_leaves, tree.n_nodes)
        if len(inner) == 0:
            return [(1.0, (tree.root, []))]
        return [
            (exp(self.law.log_prob(cut, node)) / len(inner), (node, cut))
            for node in inner
            for cut in cuts_below(tree, node)
        ]


def cuts_below(tree: Tree, node: int) -> list[list[int]]:
    """All cuts of the subtree of a node. Their number explodes: for small trees only."""
    table: list[list[list[int]]] = []
    for i, children in enumerate(tree.child_tuples[: node + 1]):
        own = [[i]]
        if children:
            products: list[list[int]] = [[]]
            for child in children:
                products = [a + b for a in products for b in table[child]]
            own += products
        table.append(own)
    return table[node]
