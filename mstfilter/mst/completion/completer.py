"""Completion: the space that an object fills, from the part of its surface that was seen (paper, section IV-B).

A segment of a depth image shows only the front of an object. A `Completer` estimates the hidden part, for one mask at
a time and without regard to other segments, so hypotheses that have a segment in common share its completion.

>>> completions = Extrude().complete(rng, frame, [mask_a, mask_b], grid)
>>> labels = arbitrate(completions, grid)            # (X, Y, Z), 1 for mask_a, 2 for mask_b

To add a method, inherit `Completer` and override `fill`. It gets an `ObservedBox`, a small box of the grid around the
object, and returns the probability of each voxel. `complete` takes care of the rest: it clears the voxels that are
observed as free, and if no voxel then reaches a probability of 0.5, it puts back the visible surface, so that no
visible object is lost. If your method is faster for many boxes together, override `fill_many`. An array of the wrong
shape, or with numbers that are not probabilities, is an error (`mstfilter.base.results`).

`arbitrate` makes the label grid. If several completions contain a voxel,

1. it belongs to the object with most depth readings in it;
2. without readings, to the object of largest probability, if this reaches the threshold;
3. if tied, to the object with the nearest visible surface.

So the labels do not depend on the order of the objects: renumbered completions give renumbered labels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from scipy.spatial import cKDTree

from mstfilter.base.errors import InputError
from mstfilter.base.results import check_list, check_probabilities, check_type, returns, warn_once
from mstfilter.mst.completion.observed import ObservedBox, SurfaceRule, encode_box, observed_again
from mstfilter.scene import (
    Clip,
    Frame,
    ObjectView,
    Occupancy,
    VoxelGrid,
    areas_of_colours,
    component_key,
    content_key,
    memo_many,
    read_only,
)
from mstfilter.smc import child


@dataclass(frozen=True, eq=False)
class Completion:
    """The completed object of one segment, in a box of the grid."""

    offset: np.ndarray  #: (3,) int, index of the box's first voxel in the grid
    #: (a, b, c) float32, probability of being occupied by the object; empty if the mask has no reading in the grid.
    probability: np.ndarray
    points: np.ndarray  #: (a, b, c) int32: depth readings of the mask in each voxel: the visible surface
    key: str  #: key of the contents of frame, mask, views, grid and completer
    #: What the completion is based on, oldest first, if views were given: those that the frame does not contradict,
    #: and last that of the frame, if it shows the object.
    views: tuple[ObjectView, ...] = ()

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """Slices of the box in the grid."""
        a, b, c = (slice(int(o), int(o) + n) for o, n in zip(self.offset, self.probability.shape, strict=True))
        return a, b, c

    def shifted(self, log_odds: float) -> Completion:
        """The completion with `log_odds` added to the log odds of all voxels with probability between 0 and 1."""
        p = self.probability
        odds = np.exp(np.float32(np.clip(log_odds, -80, 80))) * p  # float32 overflows at 89
        return replace(self, probability=read_only(odds / (odds + (1 - p))))

    def with_surface(self) -> Completion:
        """The completion, with probability 1 for voxels that contain readings if no voxel reaches 0.5."""
        p = self.probability
        return self if (p >= 0.5).any() else replace(self, probability=read_only(np.where(self.points > 0, 1, p)))


def _check_filled(self: Completer, found: Any, rngs: Any, seen: Sequence[ObservedBox]) -> list[np.ndarray]:
    found = check_list(found, len(seen), object, "arrays")
    return [check_probabilities(p, one.surface.shape) for p, one in zip(found, seen, strict=True)]


def _check_completions(
    self: Completer, found: Any, rngs: Any, frame: Frame, masks: Any, grid: VoxelGrid, views: Any = None
) -> Any:
    for one in check_list(found, len(masks), Completion, "Completion"):
        shape = one.points.shape
        check_probabilities(one.probability, shape)
        if len(shape) != 3 or (np.add(one.offset, shape) > grid.shape).any() or np.min(one.offset) < 0:
            raise InputError(f"returns a box of shape {shape} at {one.offset}, the grid has {grid.shape}")
    return found


@dataclass(frozen=True)
class Completer(SurfaceRule, ABC):
    """Estimates the hidden part of objects. The parameters are those of `SurfaceRule`: what a frame shows of them."""

    #: Whether `fill` draws random numbers. The result is then not reused for the next hypothesis.
    stochastic: ClassVar[bool] = False

    @property
    def draws(self) -> bool:
        """Whether a call uses its generator."""
        return self.stochastic

    @property
    def weights_key(self) -> str:
        """A hash of the trained weights; empty if there are none."""
        return ""

    @returns(lambda self, found, rng, seen: check_probabilities(found, seen.surface.shape))
    @abstractmethod
    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        """Probability (a, b, c) that the object occupies each voxel."""

    @returns(_check_filled)
    def fill_many(self, rngs: Sequence[np.random.Generator], seen: Sequence[ObservedBox]) -> list[np.ndarray]:
        """The probabilities of the voxels of several boxes."""
        return [self.fill(rng, one) for rng, one in zip(rngs, seen, strict=True)]

    def opinions(
        self, rngs: Sequence[np.random.Generator], seen: Sequence[ObservedBox]
    ) -> list[tuple[np.ndarray, float]]:
        """The probabilities of the voxels of several boxes, each with a factor 0 .. 1 of its weight in a pool.

        The factor is 1, unless a completer knows that it cannot judge an object (`Posterior`).
        """
        return [(p, 1.0) for p in self.fill_many(rngs, seen)]

    def estimate(self, rngs: Sequence[np.random.Generator], seen: Sequence[ObservedBox]) -> list[np.ndarray]:
        """Call `fill_many`, and warn if the result ignores the input.

        Raises InputError if random numbers are drawn although `stochastic` is False, because results are reused.
        """
        before = _states(rngs)
        filled = self.fill_many(rngs, seen)
        if not self.stochastic and before != _states(rngs):
            raise InputError(
                f"{type(self).__name__} draws random numbers, but its `stochastic` is False",
                "add stochastic: ClassVar[bool] = True to the class",
            )
        if fault := fault_of(seen, filled):
            warn_once(self, "fill", fault, "`mstfilter check` tests the completer")
        return filled

    def at(self, clip: Clip) -> Completer:
        """The completer of the clip's last frame: the completer itself, unless it is a `ClipCompleter`."""
        return self

    def complete(
        self, rng: np.random.Generator, frame: Frame, masks: Sequence[np.ndarray], grid: VoxelGrid
    ) -> list[Completion]:
        """Complete several masks of a frame, whose pose says where in the grid it looks.

        Parameters
        ----------
        rng : Generator
            Only stochastic completers draw from it; each mask has a random stream of its own.
        masks : sequence of (H, W) bool
            Each mask is one segment. Pixels without a reading, on the robot, or outside the grid are ignored.

        Returns
        -------
        list of Completion
            One for each mask. Voxels observed as free have probability 0. If the mask has a reading in the grid, at
            least one voxel has a probability of 0.5 or more, so no visible object is lost.
        """
        streams = [child(rng, "mask", k) if self.stochastic else rng for k in range(len(masks))]
        return self.complete_each(streams, frame, masks, grid)

    @returns(_check_completions)
    def complete_each(
        self,
        rngs: Sequence[np.random.Generator],
        frame: Frame,
        masks: Sequence[np.ndarray],
        grid: VoxelGrid,
        views: Sequence[tuple[ObjectView, ...]] | None = None,
    ) -> list[Completion]:
        """Complete masks with a given random stream for each mask, and with earlier views of each object.

        The completion of a mask does not depend on the other masks. The views of an object are moved to its current
        pose; with them, a mask (H, W) may be empty. `Completion.views` has those that were used, and is empty if the
        completer uses none.
        """
        masks = [np.asarray(mask, dtype=bool) for mask in masks]
        for mask in masks:
            if mask.shape != frame.depth.shape:
                raise InputError(f"mask has shape {mask.shape}, the frame is {frame.depth.shape}")
        given = [()] * len(masks) if views is None else views
        kind, of_completer = "mask" if views is None else "again", component_key(self)
        names = [
            content_key(
                kind, np.packbits(mask), frame.key, grid.key, of_completer, *self._version, *(v.name for v in past)
            )
            for mask, past in zip(masks, given, strict=True)
        ]

        def compute(missing: Sequence[int]) -> list[Completion]:
            boxes = [observed_again(frame, masks[k], given[k], grid, self) for k in missing]
            filled = self.estimate([rngs[k] for k in missing], [seen for _, _, seen, _ in boxes])
            found = []
            for k, (offset, now, seen, used), p in zip(missing, boxes, filled, strict=True):
                one = finish(offset, seen, p, names[k].hex()[:16])
                if views is not None:
                    colours = areas_of_colours(frame, masks[k])
                    view = ObjectView(offset, *encode_box(now), one.key, colours=colours)
                    latest = (view,) if now.surface.any() else ()
                    one = replace(one, views=(*used, *latest))
                found.append(one)
            return found

        if self.stochastic:
            return compute(range(len(masks)))
        # An object is rarely seen again with the same motions, so other runs seldom need its completion from views.
        return memo_many("completion", names, compute, shared=views is None)

    @property
    def _version(self) -> tuple[str, ...]:
        return (self.weights_key,) if self.weights_key else ()


def _states(rngs: Sequence[np.random.Generator | None]) -> list[Any]:
    return [rng.bit_generator.state for rng in rngs if rng is not None]


_FEW_VOXELS = 20  # of visible surface, in all boxes together; fewer say nothing about a completer


def fault_of(seen: Sequence[ObservedBox], filled: Sequence[np.ndarray]) -> str | None:
    """Description of a fault if the probabilities of boxes ignore the input; None without a fault.

    Faults are equal probabilities of all voxels, and probabilities below 0.5 for over 98 % of the visible surface.
    """
    shown = [(p, one.surface) for p, one in zip(filled, seen, strict=True) if one.surface.any()]
    if sum(np.count_nonzero(surface) for _, surface in shown) < _FEW_VOXELS:
        return None
    first = float(shown[0][0].flat[0])
    if all(p.flat[0] == first and p.min() == p.max() for p, _ in shown):
        return f"returns a constant: {first:.4g} for all voxels of {len(shown)} boxes"
    surface = np.concatenate([p[surface] for p, surface in shown])
    n_occupied = int(np.count_nonzero(surface >= 0.5))
    if n_occupied < 0.02 * len(surface):
        return (
            f"leaves the visible surface empty: {n_occupied} of its {len(surface)} voxels have a probability of 0.5 "
            f"or more, the mean is {surface.mean():.3g}"
        )
    return None


def finish(offset: np.ndarray, seen: ObservedBox, filled: np.ndarray, key: str) -> Completion:
    """A completion without free space. If no voxel reaches 0.5, the visible surface gets probability 1."""
    p = np.array(filled, dtype=np.float32)
    p[seen.free] = 0
    if p.size and not (p >= 0.5).any():
        p[seen.surface] = 1
    return Completion(read_only(offset), read_only(p), read_only(seen.points), key)


class ClipCompleter(Completer):
    """A completer that depends on the clip, for example because it reads files for each pause."""

    @returns(lambda self, found, clip: check_type(found, Completer, "a Completer"))
    @abstractmethod
    def at(self, clip: Clip) -> Completer:
        """The completer of the clip's last frame."""


def arbitrate(completions: Sequence[Completion], grid: VoxelGrid, threshold: float = 0.5) -> np.ndarray:
    """Label grid (X, Y, Z) uint16 of the completions of one hypothesis; 0 is free, and k + 1 is completion k.

    `threshold` is the least probability of an occupied voxel.
    """
    labels = np.zeros(grid.shape, dtype=np.uint16)
    most = np.zeros(grid.shape, dtype=np.int32)
    best = np.zeros(grid.shape, dtype=np.float32)
    tied = np.zeros(grid.shape, dtype=bool)
    for k, one in enumerate(completions):
        box = one.box
        p = np.where(one.probability >= threshold, one.probability, 0).astype(np.float32)
        claims = p > 0
        points = np.where(claims, one.points, 0)
        more = (points > most[box]) | ((points == most[box]) & (p > best[box]))
        equal = claims & (points == most[box]) & (p == best[box])
        tied[box] = (tied[box] | equal) & ~more
        labels[box][more] = k + 1
        most[box][more] = points[more]
        best[box][more] = p[more]
    if tied.any():
        _break_ties(labels, tied, most, best, completions, threshold)
    return labels


def occupancy_of(
    completions: Sequence[Completion], labels: np.ndarray, grid: VoxelGrid, least: float = 0.02
) -> Occupancy | None:
    """The occupancy probabilities of one hypothesis from its completions; None if all probabilities are 0 or 1.

    A voxel is free or belongs to one of its candidate objects. The odds of an object against free space are the odds
    of its completion. `labels` (X, Y, Z) is the result of `arbitrate`. An object is not a candidate for a voxel if
    the labelled object has more readings in the voxel, or if no voxel has the object's label. Probabilities below
    `least` count as 0.
    """
    if all(((one.probability == 0) | (one.probability == 1)).all() for one in completions):
        return None
    owner, best = labels.copy(), np.zeros(grid.shape, np.float32)
    total = np.ones(grid.shape, np.float32)
    readings = np.zeros(grid.shape, np.int32)
    present = [(k, one) for k, one in enumerate(completions) if (labels[one.box] == k + 1).any()]
    for k, one in present:
        own = labels[one.box] == k + 1
        readings[one.box][own] = one.points[own]
    for k, one in present:
        box = one.box
        p = np.clip(one.probability, 0, 0.999)
        odds = np.where((p >= least) & (one.points >= readings[box]), p / (1 - p), 0).astype(np.float32)
        total[box] += odds
        own, best_here = labels[box] == k + 1, best[box]
        more = (labels[box] == 0) & (odds > best_here)
        owner[box][more] = k + 1
        best[box] = np.where(own | more, odds, best_here)
    return Occupancy(owner, best / total)


_FAR = 1e9  # voxels: the distance of an object without visible surface, beyond all others


def _break_ties(
    labels: np.ndarray,
    tied: np.ndarray,
    most: np.ndarray,
    best: np.ndarray,
    completions: Sequence[Completion],
    threshold: float,
) -> None:
    """Assign tied voxels to the object with the nearest visible surface, or the smaller key at equal distance."""
    order = sorted(range(len(completions)), key=lambda k: completions[k].key)
    voxels, points, p = np.argwhere(tied), most[tied], best[tied]
    distances = [_distance_of_contender(completions[k], voxels, points, p, threshold) for k in order]
    labels[tied] = np.array(order)[np.round(distances, 9).argmin(axis=0)] + 1


def _distance_of_contender(
    one: Completion, voxels: np.ndarray, points: np.ndarray, p: np.ndarray, threshold: float
) -> np.ndarray:
    """Distance (n,) of voxels (n, 3) from an object's surface; infinite if the object does not tie for the voxel.

    An object ties if its number of readings is `points` (n,) and its probability is `p` (n,).
    """
    local = voxels - one.offset
    contends = ((local >= 0) & (local < one.probability.shape)).all(axis=1)
    at = tuple(local[contends].T)
    own = one.probability[at]
    contends[contends] = (own >= threshold) & (own == p[contends]) & (one.points[at] == points[contends])
    distance = np.full(len(voxels), np.inf)
    surface = np.argwhere(one.points > 0) + one.offset
    if contends.any():
        distance[contends] = cKDTree(surface).query(voxels[contends])[0] if len(surface) else _FAR
    return distance
