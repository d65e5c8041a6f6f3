"""Pushes that decide between one object and two.

If a belief does not know whether both sides of a border are one object, a push against one side tells: either the
other side moves too, or it stays. It must act along the border. A push across it would move two objects like one.

>>> for push in push_candidates(belief, camera, reach=((-0.4, -0.4, 0.0), (0.4, 0.4, 0.3))):
...     print(push.contact, push.direction, push.length, push.information)          # most informative first

The border, its two sides and their probabilities are those of `Belief.open_borders`; the shapes are those of
`Belief.estimate`. A candidate is left out if the robot cannot reach it, or if something is in the way of the tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mstfilter.base.errors import InputError, check_component, check_number
from mstfilter.mst.belief.information import hamming, outcome_information
from mstfilter.scene import Camera, VoxelGrid, render_hypothesis

if TYPE_CHECKING:
    from mstfilter.mst.belief.queries import Belief, Border

_OCCUPIED = 0.3  # probability of a voxel that is in the way of the tool
#: One side stands on the other if its lowest visible point is at most so many metres below the highest of the other,
#: and if the direction between their middles has such a z.
_STANDS, _STEEP = 0.015, 0.5
_OUTWARDS = 0.25  # of a side's extent: how far the contact is from the middle of the side, away from the border
_BAND = 0.012  # metres: width of the strip of voxels in which the first contact is looked for
_TOP = 0.20  # metres: height up to which the tool needs room


@dataclass(frozen=True, eq=False)
class PushCandidate:
    """A straight push along the table."""

    contact: np.ndarray  #: (3,) metres, where the tool touches the object
    direction: np.ndarray  #: (3,) unit vector, horizontal
    length: float  #: metres, from the contact to the end
    information: float  #: nats, expected from seeing what moves
    border: Border  #: the border that the push asks about
    clearance: float  #: metres of free way before the contact
    label: int  #: of the object of `Belief.estimate` that is touched

    def row(self) -> dict[str, Any]:
        """Where to push and what it tells, as plain types."""
        points = {"start": self.start, "contact": self.contact, "end": self.end, "direction": self.direction}
        lists = {name: np.round(point, 5).tolist() for name, point in points.items()}
        return {"information": round(self.information, 4), **lists, "border": self.border.middle.tolist()}

    def __repr__(self) -> str:
        (x, y, z), (a, b, _) = self.contact, self.direction
        return (
            f"PushCandidate(contact=({x:.3f}, {y:.3f}, {z:.3f}) m, direction=({a:.2f}, {b:.2f}, 0), "
            f"length={self.length:g} m, information={self.information:.2f} nats)"
        )

    @property
    def start(self) -> np.ndarray:
        """The point (3,) in metres where the tool comes down."""
        return np.asarray(self.contact - self.clearance * self.direction)

    @property
    def end(self) -> np.ndarray:
        """The point (3,) in metres where the tool goes up."""
        return np.asarray(self.contact + self.length * self.direction)


def push_candidates(
    belief: Belief,
    camera: Camera,
    reach: Any,
    length: float = 0.05,
    clearance: float = 0.05,
    tool_radius: float = 0.012,
    at_least: float = 0.05,
    borders: Sequence[Border] | None = None,
) -> list[PushCandidate]:
    """Pushes along the open borders of a belief, the most informative first; none if no border is open.

    Parameters
    ----------
    belief : Belief
    camera : Camera
        The camera of the last image, with its pose above the table.
    reach : (2, 3) array_like
        Lower and upper corner in metres of the box that the tool can reach, in the frame of the grid.
    length : float
        Metres that the tool pushes on after the contact.
    clearance : float
        Metres of free way before the contact.
    tool_radius : float
        Metres.
    at_least : float
        As in `Belief.open_borders`.
    borders : sequence of Border, optional
        The borders to ask about, if only some of the open ones matter.

    Raises InputError without a pose of the camera, for a reach that is no box or contains no part of the grid, and
    for a belief without objects.
    """
    check_component("camera", camera, Camera)
    for name, value in (("length", length), ("clearance", clearance), ("tool_radius", tool_radius)):
        check_number(name, value, at_least=0, unit="number of metres")
    if camera.T_world_camera is None:
        raise InputError(
            "the camera has no pose, so nothing is known about the table",
            "camera.at(mstfilter.scene.fit_support_plane(frame).T_world_camera)",
        )
    box = _box(reach, belief.grid)
    estimate = belief.estimate()
    if not estimate.n_objects:
        raise InputError("the belief has no objects, so there is nothing to push")
    depth = render_hypothesis(estimate, camera).depth
    scene = _Scene(belief, camera, camera.unproject(depth.astype(np.float32)), box, length, clearance, tool_radius)
    asked = belief.open_borders(camera, at_least) if borders is None else borders
    found = [push for border in asked for push in scene.pushes(border)]
    return sorted(found, key=lambda push: -push.information)


def _box(reach: Any, grid: VoxelGrid) -> np.ndarray:
    """The corners (2, 3) of what the robot can reach."""
    try:
        box = np.asarray(reach, dtype=np.float64)
    except (TypeError, ValueError):
        box = np.zeros(0)
    hint = "reach=((x, y, z), (x, y, z)): lower and upper corner in metres, in the frame of the grid"
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise InputError(f"reach is {reach!r}, expected two corners of a box", hint)
    if (box[1] <= grid.origin).any() or (box[0] >= grid.upper).any():
        raise InputError(
            f"nothing of the grid ({grid.origin.tolist()} to {grid.upper.tolist()} m) is in reach {box.tolist()}",
            hint,
        )
    return box


@dataclass(frozen=True, eq=False)
class _Scene:
    """What the pushes of a belief are planned in."""

    belief: Belief
    camera: Camera
    points: np.ndarray  #: (H, W, 3) of the visible surface of the estimate, NaN elsewhere
    box: np.ndarray
    length: float
    clearance: float
    radius: float

    def pushes(self, border: Border) -> list[PushCandidate]:
        """The possible pushes against the sides of a border."""
        sides = [self._surface(mask) for mask in border.sides]
        if min(map(len, sides)) < 10:
            return []
        middles = [side.mean(axis=0) for side in sides]
        normal = (middles[1] - middles[0]) / max(float(np.linalg.norm(middles[1] - middles[0])), 1e-9)
        rows, columns = border.pixels[:, 1], border.pixels[:, 0]
        on_border = self.points[rows, columns]
        on_border = on_border[np.isfinite(on_border[:, 2])]
        at = on_border.mean(axis=0) if len(on_border) else np.mean(middles, axis=0)
        lower, upper = sorted((side[:, 2] for side in sides), key=lambda z: float(z.mean()))
        above = float(np.percentile(upper, 5) - np.percentile(lower, 95)) > -_STANDS
        level = above and abs(float(normal[2])) > _STEEP
        if level:
            normal, directions = np.array([0.0, 0.0, np.sign(normal[2])]), _around()
        else:
            normal = np.append(normal[:2], 0.0) / np.linalg.norm(normal[:2])
            along = np.array([-normal[1], normal[0], 0.0])
            directions = np.array([along, -along])
        found = []
        for k, mask in enumerate(border.sides):
            outwards = normal if k else -normal
            if level and outwards[2] < 0:
                continue  # a push against the lower one moves both
            voxels = self._voxels(mask, at, outwards)
            information = self._information(mask)
            for direction in directions:
                push = self._push(voxels, direction, outwards, information, border)
                if push is not None:
                    found.append(push)
        return found

    def _surface(self, mask: np.ndarray) -> np.ndarray:
        points = self.points[mask]
        return points[np.isfinite(points[:, 2])]

    def _voxels(self, mask: np.ndarray, at: np.ndarray, outwards: np.ndarray) -> np.ndarray:
        """Centres (m, 3) of the voxels of one side: of the estimate's objects there, beyond the border."""
        grid, labels = self.belief.grid, self.belief.estimate().labels
        surface = grid.index_of(self._surface(mask))
        surface = surface[grid.contains(surface)]
        shown, count = np.unique(labels[tuple(surface.T)], return_counts=True)
        own = shown[(shown > 0) & (count > 0.1 * count.sum())]
        centres = grid.centres()[np.isin(labels, own)]
        return np.asarray(centres[(centres - at) @ outwards > 0])

    def _information(self, mask: np.ndarray) -> float:
        """Information of seeing which pixels move with those of a side."""
        refined, mass = self.belief.refined_image(self.camera)
        cells = np.bincount(refined.cells[mask], minlength=len(refined.sizes)).astype(float)
        cells[0] = 0
        pushed = refined.objects[:, int(cells.argmax())]
        moved = (refined.objects == pushed[:, None]) & (pushed[:, None] > 0)
        return outcome_information(mass, moved.astype(np.int64), hamming, refined.sizes, 0.2 * float(mask.sum()))

    def _push(
        self, voxels: np.ndarray, direction: np.ndarray, outwards: np.ndarray, information: float, border: Border
    ) -> PushCandidate | None:
        """The push against some voxels (m, 3) in a direction; None if it is not possible."""
        if len(voxels) < 5:
            return None
        half = self.belief.grid.voxel_size / 2
        across = np.cross(direction, (0.0, 0.0, 1.0))
        lateral = voxels @ across
        reach = np.ptp(lateral) / 2
        place = lateral.mean() + _OUTWARDS * reach * np.sign(outwards @ across)
        strip = voxels[np.abs(lateral - place) < max(_BAND, half)]
        if not len(strip):
            return None
        height = float(np.clip(np.median(strip[:, 2]), self.radius + half, None))
        first = strip[:, :] @ direction
        contact = (
            direction * (first.min() - half) + across * place + np.array([0.0, 0.0, height])
        )  # direction, across and z are at right angles
        touched = self.belief.grid.index_of(strip[first.argmin()][None])[0]
        label = int(self.belief.estimate().labels[tuple(touched)])
        push = PushCandidate(contact, direction, self.length, information, border, self.clearance, label)
        return push if self._is_possible(push) else None

    def _is_possible(self, push: PushCandidate) -> bool:
        """Whether start and end are in reach, the end is above the table, and nothing is in the way before."""
        ends = np.array([push.start, push.end])
        grid = self.belief.grid
        if (ends < self.box[0]).any() or (ends > self.box[1]).any() or not grid.contains(grid.index_of(ends)).all():
            return False
        steps = np.arange(0.0, push.clearance - self.radius, grid.voxel_size / 2)
        around = self.radius * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        tip = float(push.contact[2]) - self.radius  # the tool comes from above
        heights = np.arange(tip, max(_TOP, tip + 2 * self.radius), grid.voxel_size)
        way = push.start[:2] + steps[:, None] * push.direction[:2]
        columns = (way[:, None] + around).reshape(-1, 2)
        points = np.concatenate(
            [np.repeat(columns, len(heights), 0), np.tile(heights, len(columns))[:, None]], axis=1
        )
        index = grid.index_of(points)
        index = index[grid.contains(index)]
        return bool((self.belief.occupancy()[tuple(index.T)] < _OCCUPIED).all())


def _around(n: int = 8) -> np.ndarray:
    """Horizontal directions (n, 3)."""
    angle = np.arange(n) * 2 * np.pi / n
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
