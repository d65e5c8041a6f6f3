"""Interfaces of the parts of fusion that a user can replace.

==============  =====================================================================  ===========================
interface       task                                                                   field of a preset
==============  =====================================================================  ===========================
`PairOdds`      log odds that two cells of the image belong to one object              ``update.pairs``
`Projection`    clears voxels of a prediction that a frame observes as free            ``update.free_space``
`Division`      groups the pixels of a frame by object, as far as a clip shows it      ``update.division``
`Structure`     draws which conflicts may merge, and the painting order                ``update.crossover.structure``
`Evidence`      scores built candidates by one part of the data                        ``update.evidence``
==============  =====================================================================  ===========================

>>> log_score = evidence.log_score(hypotheses, clip)       # (n,) nats, larger is better
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np

from mstfilter.errors import InputError
from mstfilter.results import Checked, check_array, check_list, check_type, describe_value, returns
from mstfilter.scene import Clip, Frame, Hypothesis

if TYPE_CHECKING:
    from mstfilter.fusion.cells import Cells

#: Vertices in painting order, and edges (child, parent); see `Structure.draw`.
OrderAndEdges = tuple[list[int], list[tuple[int, int]]]


def _check_pair(found: tuple[Any, Any], first: str, second: str) -> None:
    """Raise InputError unless a result is a tuple or list of two."""
    check_type(found, (tuple, list), f"{first} and {second}")
    if len(found) != 2:
        raise InputError(f"returns {len(found)} values, expected {first} and {second}")


def _check_projected(self: Projection, found: tuple[Any, float], hypothesis: Any, frame: Frame) -> tuple[Any, float]:
    _check_pair(found, "a hypothesis", "a share")
    projected, share = found
    check_type(projected, type(hypothesis), f"a {type(hypothesis).__name__}")
    if not isinstance(share, Real) or not 0 <= share <= 1 + 1e-9:
        raise InputError(f"returns the share {describe_value(share)}, expected a number from 0 to 1")
    return projected, float(share)


def _check_refined(self: Projection, found: Any, hypotheses: Sequence[Any], clip: Clip) -> Any:
    _check_pair(found, "hypotheses", "shares")
    n = len(hypotheses)
    return tuple(check_list(found[0], n, object, "hypotheses")), check_array(found[1], (n,), "iuf", 0, 1)


class Projection(Checked, ABC):
    """Projects a hypothesis onto the set of hypotheses that agree with a frame."""

    @returns(_check_projected)
    @abstractmethod
    def project(self, hypothesis: Any, frame: Frame) -> tuple[Any, float]:
        """The nearest hypothesis that agrees with a frame, and the share of voxels that it keeps, in [0, 1]."""

    @returns(_check_refined)
    def refine(self, hypotheses: Sequence[Any], clip: Clip) -> tuple[tuple[Any, ...], np.ndarray]:
        """Project hypotheses about the end of a clip onto its last frame; also returns the shares of voxels (n,)."""
        pairs = [self.project(hypothesis, clip.after) for hypothesis in hypotheses]
        return tuple(h for h, _ in pairs), np.array([q for _, q in pairs])


def _check_division(self: Division, found: np.ndarray | None, clip: Clip) -> np.ndarray | None:
    return None if found is None else check_array(found, clip.after.depth.shape, "iu", at_least=-1)


class Division(Checked, ABC):
    """Groups the pixels of a frame by object, as far as the clip shows it."""

    @returns(_check_division)
    @abstractmethod
    def divide(self, clip: Clip) -> np.ndarray | None:
        """Numbers (H, W) int32 of the pixels of the last frame; None if the clip gives no information.

        Pixels with different numbers >= 0 belong to different objects; -1 is unknown. A clip of a single frame, for
        example, gives no information.
        """


class PairOdds(Checked, ABC):
    """How likely two cells of an image belong to one object."""

    @returns(lambda self, found, cells, weights, clip: check_array(found, (len(cells.pairs),), finite=False))
    @abstractmethod
    def log_odds(self, cells: Cells, weights: np.ndarray, clip: Clip) -> np.ndarray:
        """Log odds (e,) of "one object" for ``cells.pairs`` (e, 2), all pairs of cells of one component.

        Parameters
        ----------
        cells : mstfilter.fusion.Cells
            The common refinement of the samples and the predictions, with the label of every cell in each of them.
        weights : (n,) ndarray
            Weights of the predictions. What their sum lacks of 1 is the probability that all of them are wrong.
        clip : Clip
            Its last frame is the image.
        """


def _check_structure(
    self: Structure, found: Any, rng: Any, graph: nx.Graph, component: Sequence[int]
) -> OrderAndEdges:
    _check_pair(found, "an order", "edges")
    order, edges = (check_type(part, (list, tuple), "lists") for part in found)
    if sorted(order) != sorted(component):
        raise InputError(f"returns the order {list(order)}, expected each vertex of {list(component)} once")
    place = {v: k for k, v in enumerate(order)}
    for edge in edges:
        if len(edge) != 2 or not graph.has_edge(*edge):
            raise InputError(f"returns the edge {edge}, which is no edge of the graph")
        if place[edge[0]] > place[edge[1]]:
            raise InputError(f"returns the edge {edge}: the child {edge[0]} is painted after its parent {edge[1]}")
    return list(order), list(edges)


class Structure(Checked, ABC):
    """Draws the order in which objects in conflict are painted, and the conflicts that may end in a merge."""

    @returns(_check_structure)
    @abstractmethod
    def draw(self, rng: np.random.Generator, graph: nx.Graph, component: Sequence[int]) -> OrderAndEdges:
        """Draw an order and directed edges for one component of the conflict graph.

        Parameters
        ----------
        graph : networkx.Graph
            The conflict graph (`ConflictGraph.networkx`). The neighbours of a vertex, ``graph[v]``, ascend.
        component : sequence of int
            Vertices of one connected component, ascending.

        Returns
        -------
        order : list of int
            All vertices of the component, first to last painted; later ones paint over earlier ones.
        edges : list of (child, parent)
            Edges of the graph along which the child may be merged into the parent, which is painted after it.
        """


class Evidence(Checked, ABC):
    """One term of the score of a candidate.

    The documentation of a term states which data it uses, so that users see which data are counted twice.
    """

    @returns(lambda self, found, hypotheses, clip: check_array(found, (len(hypotheses),)).astype(np.float64))
    @abstractmethod
    def log_score(self, hypotheses: Sequence[Hypothesis], clip: Clip) -> np.ndarray:
        """Log score (n,) of hypotheses about the end of a clip, in nats, finite, up to a common constant."""
