"""Which predicted objects have moved as one body.

Two things that move together through a push are more probably one thing: one thing must move as one, while two that
touch do so only if they are pushed as one. So common motion is evidence of "one object". How strong it is says the
coefficient `together` of `PairEvidence`; by default it is 0.

>>> bodies = common_motions(hypothesis)                 # number of the body of each label, 0 at rest
>>> bodies[a] == bodies[b] > 0                          # the objects a and b moved, and as one body
"""

from __future__ import annotations

from itertools import combinations

import networkx as nx
import numpy as np

from mstfilter.scene import Hypothesis, ObjectRecord

_MOVED = 0.01  # metres: an object that moved less says nothing
#: Metres, and share of the distance moved: two objects moved as one body if their motions differ by less.
_RIGID, _RIGID_SHARE = 0.004, 0.1
_SOME = 200  # voxels of an object at which motions are compared


def common_motions(hypothesis: Hypothesis) -> np.ndarray:
    """The body (labels + 1,) int of each label of a predicted hypothesis: objects with one number moved as one body.

    Label 0 and objects that moved by less than a centimetre have the number 0. The motion is that since the objects
    were last changed, that is, of the last clip.
    """
    found = np.zeros(int(hypothesis.labels.max(initial=0)) + 1, np.int64)
    moved = {}
    for record in hypothesis.objects:
        if record.source is not None:
            points = _points(hypothesis, record)
            if len(points) and float(np.linalg.norm(_way(record, points), axis=1).mean()) > _MOVED:
                moved[record.label] = record, points
    graph = nx.Graph()
    graph.add_nodes_from(moved)
    for a, b in combinations(moved, 2):
        if _as_one(moved[a], moved[b]):
            graph.add_edge(a, b)
    for number, body in enumerate(nx.connected_components(graph), start=1):
        found[list(body)] = number
    return found


def _points(hypothesis: Hypothesis, record: ObjectRecord) -> np.ndarray:
    """Some points (m, 3) of an object where it is now, in metres."""
    crop = hypothesis.crop(record.label)
    index = np.argwhere(crop.occupied)
    index = index[:: max(1, len(index) // _SOME)] + crop.offset
    grid = hypothesis.grid
    return np.asarray(grid.origin + grid.voxel_size * (index + 0.5))


def _way(record: ObjectRecord, points: np.ndarray) -> np.ndarray:
    """How far (m, 3) the motion of an object has carried points that are now at `points`."""
    return points - record.motion.inv().apply(points)


def _as_one(one: tuple[ObjectRecord, np.ndarray], other: tuple[ObjectRecord, np.ndarray]) -> bool:
    points = np.concatenate([one[1], other[1]])
    ways = _way(one[0], points), _way(other[0], points)
    apart = float(np.linalg.norm(ways[0] - ways[1], axis=1).mean())
    return apart < max(_RIGID, _RIGID_SHARE * float(np.linalg.norm(ways[0], axis=1).mean()))
