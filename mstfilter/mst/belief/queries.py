"""Questions to weighted hypotheses, as a planner asks them: probabilities, entropies, expected information.

>>> belief = Belief(state.population)
>>> belief.occupancy()[tuple(belief.voxel([0.1, 0.0, 0.02]))]     # probability that the voxel is occupied
>>> belief.same_object_at_pixels(camera, (310, 200), (340, 210))  # probability that two pixels show one object
>>> belief.object_count()                                         # probability of 0, 1, 2, ... objects
>>> belief.open_borders(camera)[0].one_object                     # probability of "one object" across a border
>>> max(cameras, key=belief.view_information)                     # the most informative camera
>>> belief.estimate()                                             # the hypothesis of least expected loss
>>> belief.push_map(tolerance=50)                                 # information of a push at each voxel
>>> belief.objects()                                              # a table: where, how certain, hidden, one with what

The probability of a statement is the total weight of the hypotheses in which it holds: hypothesis i has labels L_i
and the normalised weight w_i. Each hypothesis numbers its objects as it likes, so no answer depends on the numbers.
Questions about the occupancy of voxels also use the occupancy probabilities of each hypothesis
(`Hypothesis.occupancy`); those about segmentations and actions use the labels alone.

A filter keeps few hypotheses, so their weights are coarse. But the update of `mst` weighs up to 100 segmentations of
the last image before it keeps some. If a belief is given these too, it answers questions about pixels of that image
from all of them:

>>> belief = Belief.of_step(state, info)                          # as `Stream.belief`, `RunFolder.belief(t)`
>>> belief.kept.open_borders(camera)                              # what the kept hypotheses alone say

Voxels are integer indices (x, y, z), which `Belief.voxel` finds for points in metres. Pixels are (column, row). A
region is a bool array of the grid's shape, or voxels (..., 3). Entropy and information are in nats (divide by log 2
for bits). What the information of an action is, and its `tolerance` (in voxels or pixels), is explained in
`mstfilter.mst.belief.information`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.ndimage import distance_transform_edt

from mstfilter.base.errors import InputError, check_component, check_number
from mstfilter.base.lazy import late
from mstfilter.mst.belief.information import (
    binary_entropy,
    canonical_rows,
    entropy,
    hamming,
    outcome_information,
    partition_distance,
)
from mstfilter.mst.belief.objects import ObjectTable, object_table
from mstfilter.scene import (
    Camera,
    CommonRefinement,
    Hypothesis,
    VoxelGrid,
    WeightedSegmentations,
    check_grids,
    common_refinement,
    memo,
    project,
    render_hypothesis,
    scaled_area,
)
from mstfilter.scoring import pairwise_quality
from mstfilter.scoring.metrics import refined_quality
from mstfilter.smc import Info, Population, State, first_seen

Action = TypeVar("Action")

_DEPTH_STEP = 0.01  # voxels: depths are rounded to this step before they are compared
_REACH = 0.05  # of the width of an image: how far a pixel without a reading may be from one
_LEAST_PART = 200  # pixels of a part beside an open border, in an image of 640 x 480 pixels


class Border(NamedTuple):
    """A border in an image: the hypotheses disagree whether both sides of it are one object."""

    one_object: float  #: probability that both sides are one object, if both are objects
    pixels: np.ndarray  #: (m, 2) pixels (column, row) on the border
    #: (2, H, W) bool, the two objects on its sides in the most probable segmentation in which they are two
    sides: np.ndarray

    def __repr__(self) -> str:
        column, row = self.middle.tolist()
        return f"Border(one_object={self.one_object:.2f}, middle=({column}, {row}), {len(self.pixels)} pixels)"

    @property
    def middle(self) -> np.ndarray:
        """The pixel (2,) of the border that is nearest to the mean of its pixels."""
        return np.asarray(self.pixels[np.linalg.norm(self.pixels - self.pixels.mean(axis=0), axis=1).argmin()])


@dataclass(frozen=True, eq=False)
class Belief:
    """What the filter believes about the scene: a posterior, represented by weighted hypotheses.

    Its methods answer with probabilities, or with the expected information of an action, and `estimate` names the one
    hypothesis to use if only one can be used.

    Parameters
    ----------
    population : Population
        Hypotheses on one grid with unnormalised log weights, such as ``state.population``. Those that are equal are
        merged, and those of weight 0 are ignored.
    seen : WeightedSegmentations, optional
        All segmentations of the last image that the filter has weighed. If asked with the camera of this image,
        `same_object_at_pixels`, `open_borders`, `disagreement` and `objects` answer from them.
    pause : int, optional
        Index of the last pause. By default, the last one at which an object of a hypothesis was seen.
    """

    population: Population
    seen: WeightedSegmentations | None = None
    pause: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.population, Population):
            raise InputError(
                f"Belief takes a Population, not a {type(self.population).__name__}", "Belief(state.population)"
            )
        particles = self.population.particles
        if not all(isinstance(h, Hypothesis) for h in particles):
            raise InputError("the particles of a belief must be hypotheses, not vectors or other objects")
        check_grids("", particles, self.grid)

    @classmethod
    def of_step(cls, state: State, info: Info) -> Belief:
        """The belief after a step, with all segmentations that the update has weighed, if it notes them."""
        if state.population is None:
            raise InputError("the state has no particles before the first step", "state, info = filter.step(...)")
        return cls(state.population, info.notes.get("update", {}).get("segmentations"), info.t)

    @property
    def kept(self) -> Belief:
        """The belief of the kept hypotheses alone."""
        return Belief(self.population, pause=self.pause)

    def __repr__(self) -> str:
        weights = ", ".join(f"{w:.3g}" for w in np.sort(self._mass)[::-1][:8]) + ", ..." * (len(self._mass) > 8)
        head = f"Belief: {len(self)} hypotheses, {len(self._mass)} distinct"
        head = "Belief: 1 hypothesis" if len(self) == 1 else head
        return f"{head}\n  {self.grid.text}\n  weights {weights}"

    _repr_html_ = late("mstfilter.app.report.display:to_html", "What a notebook shows.")

    plot = late(
        "mstfilter.app.report.answer:plot_belief", "Objects and open borders over an image (H, W, 3) of a camera."
    )

    def __len__(self) -> int:
        return len(self.population)

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The n hypotheses of the population."""
        return tuple(self.population.particles)

    @property
    def weights(self) -> np.ndarray:
        """(n,) weights w, sum 1."""
        return self.population.weights

    @property
    def grid(self) -> VoxelGrid:
        """The grid of all hypotheses."""
        return self.population.particles[0].grid

    @cached_property
    def distinct(self) -> tuple[tuple[Hypothesis, ...], np.ndarray]:
        """Distinct hypotheses of positive weight, and their weights."""
        which = first_seen(h.key + (h.occupancy.key if h.occupancy else b"") for h in self.hypotheses)
        mass = np.bincount(which, self.weights)
        example = np.unique(which, return_index=True)[1]
        kept = np.flatnonzero(mass > 0)
        return tuple(self.hypotheses[int(example[k])] for k in kept), mass[kept]

    @property
    def _mass(self) -> np.ndarray:
        return self.distinct[1]

    @cached_property
    def refined_voxels(self) -> CommonRefinement:
        """The cells of voxels that no distinct hypothesis separates."""
        return common_refinement([h.labels for h in self.distinct[0]])

    # Voxels and regions ---------------------------------------------------------------------------------------

    def voxel(self, points: Any) -> np.ndarray:
        """Voxels (..., 3) that contain world points (..., 3) in metres. Points outside the grid raise InputError."""
        points = np.asarray(points, dtype=np.float64)
        if points.shape[-1:] != (3,):
            raise InputError(f"points have shape {points.shape}, expected (..., 3) in metres")
        index = self.grid.index_of(points)
        outside = ~self.grid.contains(index)
        if outside.any():
            raise InputError(
                f"point {points[outside][0].tolist()} m lies outside the grid "
                f"(so do {outside.sum()} of {outside.size} points)",
                f"the grid extends from {self.grid.origin.tolist()} to {self.grid.upper.tolist()} m",
            )
        return index

    # Probabilities --------------------------------------------------------------------------------------------

    def occupancy(self) -> np.ndarray:
        """Probability (X, Y, Z) that a voxel is occupied: ``p(v) = sum_i w_i o_i(v)``.

        o_i(v) is the probability, in hypothesis i, of the most probable object at voxel v (`Hypothesis.shares`).
        """
        shares = [h.shares.probability for h in self.distinct[0]]
        return sum((w * p.astype(np.float64) for w, p in zip(self._mass, shares, strict=True)), np.zeros(()))

    def same_object(self, a: Any, b: Any) -> np.ndarray:
        """Probability (...) that two voxels belong to the same object.

        ``sum_i w_i [k_i(a) = k_i(b) > 0] min(o_i(a), o_i(b))``, where hypothesis i has the most probable object
        k_i(v) at voxel v, with probability o_i(v) (`Hypothesis.shares`). An object is taken to be a level set of its
        probabilities, so the minimum is the probability that it contains both voxels. `a` and `b` (..., 3) are
        broadcast against each other: a = b gives the occupancy, and all voxels as b give the extent of the object at
        a.
        """
        at_a, at_b = np.broadcast_arrays(_flat_voxels(self.grid, a), _flat_voxels(self.grid, b))
        found = np.zeros(at_a.shape)
        for w, (owner, p) in zip(self._mass, self._flat_shares, strict=True):
            found += w * ((owner[at_a] == owner[at_b]) & (owner[at_a] > 0)) * np.minimum(p[at_a], p[at_b])
        return found

    @cached_property
    def _flat_shares(self) -> list[tuple[np.ndarray, np.ndarray]]:
        shares = [h.shares for h in self.distinct[0]]
        return [(one.owner.ravel(), one.probability.ravel().astype(np.float64)) for one in shares]

    def same_object_at_pixels(self, camera: Camera, a: Any, b: Any) -> np.ndarray:
        """Probability (...) that two pixels show the same object: ``sum_i w_i [R_i(a) = R_i(b) > 0]``.

        R_i is the label image of hypothesis i. `a` and `b` (..., 2) are pixels (column, row); they are broadcast.
        """
        refined, mass = self.refined_image(camera)
        a, b = _rows_and_columns(camera, a), _rows_and_columns(camera, b)
        objects_a, objects_b = refined.objects[:, refined.cells[a]], refined.objects[:, refined.cells[b]]
        return np.tensordot(mass, (objects_a == objects_b) & (objects_a > 0), axes=1)

    def object_count(self) -> np.ndarray:
        """Probability (K + 1,) of k = 0 .. K objects: ``sum_i w_i [hypothesis i has k objects]``."""
        return np.bincount(np.diff(self.refined_voxels.first), self._mass)

    # Boundaries and entropy -----------------------------------------------------------------------------------

    def boundary_entropy(self) -> np.ndarray:
        """Entropy (X, Y, Z) of the segmentation at a voxel, the largest over its six faces; at most log 2.

        The entropy of a face is ``H(S | B) = P(B) h(P(S | B))`` with ``h(p) = -p log p - (1 - p) log(1 - p)``, where
        B means that both voxels at the face are occupied, and S that one object occupies both. Whether they are
        occupied is another question, whose entropy H(B) is not included: H(B, S) = H(B) + H(S | B).
        """
        largest = np.zeros(self.grid.shape)
        for axis in range(3):
            out, face = np.moveaxis(largest, axis, 0), self._entropy_of_faces(axis)
            np.maximum(out[:-1], face, out=out[:-1])
            np.maximum(out[1:], face, out=out[1:])
        return largest

    def _entropy_of_faces(self, axis: int) -> np.ndarray:
        """H(S | B) of the faces between neighbouring voxels along `axis`, which is the first axis of the result."""
        cells = np.moveaxis(self.refined_voxels.cells, axis, 0)
        lower, upper = cells[:-1], cells[1:]
        differ = (lower != upper) & (lower > 0) & (upper > 0)  # inside a cell, both are always one object
        a, b = self.refined_voxels.objects[:, lower[differ]], self.refined_voxels.objects[:, upper[differ]]
        both, same = self._mass @ ((a > 0) & (b > 0)), self._mass @ ((a > 0) & (a == b))
        entropy = np.zeros(differ.shape)
        entropy[differ] = both * binary_entropy(np.divide(same, both, out=np.zeros_like(same), where=both > 0))
        return entropy

    def disagreement(self, camera: Camera) -> np.ndarray:
        """Map (H, W) of the expected Jaccard distance between the objects that two hypotheses show at a pixel.

        Both hypotheses are drawn by weight: ``1 - sum_ij w_i w_j J(A_i, A_j)``, where A_i is the set of pixels of the
        object that hypothesis i shows at the pixel, and J the Jaccard index: 1 if neither shows an object there, and
        0 if only one does.
        """
        refined, mass = self.refined_image(camera)
        jaccard = refined.jaccard(refined.overlaps())
        jaccard[0, 0] = 1  # neither shows an object
        rows = refined.objects
        same = sum(
            w * v * jaccard[a, b] for w, a in zip(mass, rows, strict=True) for v, b in zip(mass, rows, strict=True)
        )
        return np.clip(1 - same, 0, 1)[refined.cells]

    def open_borders(self, camera: Camera | None = None, at_least: float = 0.05) -> list[Border]:
        """Borders in the image that separate two objects in some hypotheses only, the most uncertain first.

        A border is open if the probability that both sides are one object, given that both sides are objects, is
        between `at_least` and 1 - `at_least`. Both sides must be objects with a probability above `at_least`.
        Borders separate the parts of the common refinement of all label images. In an image of 640 x 480, parts of
        fewer than 200 pixels join the nearest larger part, and borders of fewer than 14 pixels are left out. Borders
        of one object with the same answer in all hypotheses are one border. The default `camera` is that of the last
        image, if the belief has its weighted segmentations.
        """
        check_number("at_least", at_least, at_least=0, at_most=0.5)
        if camera is None:
            if self.seen is None:
                raise InputError("the belief does not know the camera of the last image", "open_borders(camera)")
            camera = self.seen.camera
        refined, mass = self.refined_image(camera)
        least = scaled_area(_LEAST_PART, camera.width * camera.height)
        small = (refined.sizes < least)[refined.cells]
        nearest = distance_transform_edt(small, return_distances=False, return_indices=True)
        a, b, pixels = _neighbours(refined.cells if small.all() else refined.cells[tuple(nearest)])
        of_a, of_b = refined.objects[:, a], refined.objects[:, b]
        both, same = (of_a > 0) & (of_b > 0), (of_a > 0) & (of_a == of_b)
        p_both, p_same = mass @ both, mass @ same
        one = np.divide(p_same, p_both, out=np.ones_like(p_same), where=p_both > at_least)
        borders: dict[bytes, list[int]] = {}  # pixels that ask the same question, about the same object
        for k in np.flatnonzero((p_both > at_least) & (one >= at_least) & (one <= 1 - at_least)).tolist():
            borders.setdefault(np.concatenate([both[:, k], same[:, k], of_a[same[:, k], k]]).tobytes(), []).append(k)
        doubt = {key: p_both[k[0]] * float(binary_entropy(one[k[0]])) for key, k in borders.items()}
        order = sorted(doubt, key=lambda key: -doubt[key])
        return [
            Border(float(one[borders[k][0]]), pixels[borders[k]], _sides(refined, mass, a, b, borders[k]))
            for k in order
            if len(borders[k]) ** 2 >= least
        ]

    def partition_entropy(self, tolerance: float = 0.0) -> float:
        """Entropy of the segmentation of the scene, in nats.

        ``-sum_s P(s) log P(s)``, where P(s) is the weight of the hypotheses with segmentation s. This is the expected
        information of being told the true segmentation, so without tolerance no outcome that the labels determine
        tells more. The distance for the tolerance is `information.partition_distance`.
        """
        rows = canonical_rows(self.refined_voxels.objects)
        return outcome_information(self._mass, rows, partition_distance, self.refined_voxels.sizes, tolerance)

    # Expected information of actions --------------------------------------------------------------------------

    def view_information(self, camera: Camera, tolerance: float = 0.0) -> float:
        """Information of an image from a camera; `tolerance` in pixels. Use ``camera.scaled(0.25)`` to save time.

        The outcome is the depth image of the objects, rounded to a hundredth of a voxel and without the table.
        """
        step = _DEPTH_STEP * self.grid.voxel_size
        check_component("camera", camera, Camera)
        depths = (render_hypothesis(h, camera).depth.ravel() for h in self.distinct[0])
        pixels = np.stack([np.nan_to_num(np.round(d / step), nan=-1).astype(np.int32) for d in depths])
        pixels = pixels[:, (pixels != pixels[0]).any(axis=0)]
        return outcome_information(self._mass, pixels, hamming, np.ones(pixels.shape[1]), tolerance)

    def push_information(self, region: Any, tolerance: float = 0.0) -> float:
        """Information of a push at a voxel or a region, if the moved voxels are observed.

        The outcome ``{v | L_i(v) = L_i(u) > 0 for a u in region}`` has all voxels of the objects with a voxel in the
        region. Other objects that these would push along are ignored.
        """
        cells = np.unique(self.refined_voxels.cells.ravel()[_flat_region(self.grid, region)])
        moved = self.refined_voxels.objects_in(cells)[self.refined_voxels.objects]
        return outcome_information(self._mass, moved, hamming, self.refined_voxels.sizes, tolerance)

    def push_map(self, tolerance: float = 0.0) -> np.ndarray:
        """`push_information` (X, Y, Z) of each voxel."""
        check_number("tolerance", tolerance, at_least=0, unit="number of voxels")
        refined, mass = self.refined_voxels, self._mass
        overlap = refined.overlaps()
        volume = overlap.diagonal()
        distance = volume[:, None] + volume[None, :] - 2 * overlap
        near = np.exp(-distance / tolerance) if tolerance else (distance == 0).astype(np.float64)
        information = np.zeros(len(refined.sizes))
        for w, row in zip(mass, refined.objects, strict=True):
            same_outcome = sum(v * near[row, other] for v, other in zip(mass, refined.objects, strict=True))
            information -= w * np.log(same_outcome)
        return np.maximum(information, 0.0)[refined.cells]

    def most_informative(
        self, actions: Sequence[Action], information: Callable[[Action], float], at_least: float = 1e-9
    ) -> Action | None:
        """The action of largest expected information; of several, the first.

        None if no action has `at_least` nats, for example because the hypotheses agree on all outcomes.
        """
        values = [information(action) for action in actions]
        if np.isnan(values).any():
            raise InputError(f"the information of action {int(np.isnan(values).argmax())} is NaN")
        best = int(np.argmax(values)) if values else 0
        return actions[best] if values and values[best] >= at_least else None

    # Functions of the user ------------------------------------------------------------------------------------

    def information(self, outcome: Callable[[Hypothesis], Hashable]) -> float:
        """Information of an action whose outcome is determined by the hypothesis.

        It is ``H(O)`` with ``P(O = o) = sum_i w_i [outcome(h_i) = o]``. The outcome must not contain labels, because
        each hypothesis numbers its objects as it likes.
        """
        outcomes = [(outcome(h), w) for w, h in zip(self.weights, self.hypotheses, strict=True) if w > 0]
        try:
            which = first_seen(o for o, _ in outcomes)
        except TypeError as error:
            raise InputError(f"outcomes cannot be compared ({error})", "for arrays: array.tobytes()") from error
        if any(isinstance(o, float) and o != o for o, _ in outcomes):
            raise InputError("an outcome is NaN, which is not equal to itself", "return None, or another constant")
        return entropy(np.bincount(which, [w for _, w in outcomes]))

    def estimate(self) -> Hypothesis:
        """The hypothesis of least expected loss: ``argmin_i sum_j w_j loss(h_i, h_j)``.

        The loss is 1 - quality (weighted coverage in the form ``objects``). If the true scene is distributed as the
        belief says, no hypothesis is a better single answer.

        The sum over a few kept hypotheses is a noisy estimate of the expected loss. If the belief has all weighted
        segmentations of the last image, the loss in this image is known better: the same sum over them. The
        difference of both sums in the image corrects the sum over voxels (a control variate).
        """
        return self.hypotheses[self.estimate_index]

    @cached_property
    def estimate_index(self) -> int:
        """Index of `estimate` in `hypotheses`."""
        hypotheses, mass = self.distinct
        quality = pairwise_quality([h.labels for h in hypotheses]) @ mass
        if (seen := self.segmentations) is not None and len(hypotheses) > 1:
            n = len(hypotheses)
            shown = np.stack([seen.cell_labels(project(h, seen.camera)) for h in hypotheses])
            in_image = refined_quality(seen.refined_with(shown))[:n]
            quality = quality + in_image[:, n:] @ seen.weights - in_image[:, :n] @ mass
        return self.hypotheses.index(hypotheses[int(np.argmax(quality))])

    def objects(self, camera: Camera | None = None, previous: ObjectTable | None = None) -> ObjectTable:
        """One table of the objects: existence, place, shape, visible or hidden, and which may belong together.

        See `mstfilter.mst.belief.objects`. `camera` is that of the last image, whose pixels are asked about visible
        objects; by default, that of the weighted segmentations, and if there are none, only voxels are asked. With
        the table of the `previous` pause, objects keep their numbers.
        """
        return object_table(self, camera, previous)

    def refined_image(self, camera: Camera) -> tuple[CommonRefinement, np.ndarray]:
        """The cells of the segmentations that a camera sees, and the weights (n,) of the segmentations."""
        seen = self.segmentations
        if seen is not None and seen.are_of(camera):
            return seen.refinement, seen.weights
        images, keys = self._images(camera), [h.key for h in self.distinct[0]]
        return memo("refined image", (camera.key, *keys), lambda: common_refinement(images)), self._mass

    @cached_property
    def segmentations(self) -> WeightedSegmentations | None:
        """The weighted segmentations of the last image, if they are known, also where it has no depth.

        Segmentations are of depth readings. A pixel without one that shows an object in more than half of the kept
        hypotheses, by weight, has the cell of the nearest reading of an object.
        """
        if self.seen is None:
            return None
        cells = self.seen.cells
        shown = sum(w * (project(h, self.seen.camera) > 0) for h, w in zip(*self.distinct, strict=True))
        holes = (cells == 0) & (shown > 0.5)
        if not holes.any() or not cells.any():
            return self.seen
        distance, at = distance_transform_edt(cells == 0, return_indices=True)
        holes &= distance < _REACH * cells.shape[1]
        return replace(self.seen, cells=np.where(holes, cells[tuple(at)], cells))

    def _images(self, camera: Camera) -> list[np.ndarray]:
        check_component("camera", camera, Camera)
        return [project(h, camera) for h in self.distinct[0]]


def _sides(refined: CommonRefinement, mass: np.ndarray, a: np.ndarray, b: np.ndarray, at: list[int]) -> np.ndarray:
    """Both objects (2, H, W) bool at the pairs `at` of neighbouring cells a, b, where they are most probably two."""
    first, second = refined.objects[:, a[at]], refined.objects[:, b[at]]
    two = (first > 0) & (second > 0) & (first != second)
    best = int((mass * two.any(axis=1)).argmax())
    k = at[int(two[best].argmax())]
    row = refined.objects[best]
    return np.stack([(row == row[cell])[refined.cells] for cell in (a[k], b[k])])


def _check_indices(name: str, index: np.ndarray, shape: tuple[int, ...], hint: str) -> None:
    """Raise InputError unless `index` (..., k) holds integers that are at least 0 and below `shape` (k,)."""
    if index.shape[-1:] != (len(shape),) or not np.issubdtype(index.dtype, np.integer):
        raise InputError(
            f"{name}s have type {index.dtype} and shape {index.shape}, expected integers (..., {len(shape)})", hint
        )
    outside = ((index < 0) | (index >= shape)).any(axis=-1)
    if outside.any():
        size = " x ".join(str(n) for n in shape)
        raise InputError(f"{name} {index[outside][0].tolist()} lies outside the {size} {name}s", hint)


def _flat_voxels(grid: VoxelGrid, voxels: Any) -> np.ndarray:
    """Flat indices (...) of voxels (..., 3)."""
    index = np.asarray(voxels)
    _check_indices("voxel", index, grid.shape, "belief.voxel(points) finds the voxels of points in metres")
    return np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), grid.shape)


def _flat_region(grid: VoxelGrid, region: Any) -> np.ndarray:
    """Distinct flat indices (m,) of a region: a bool array of the grid's shape, or voxels (..., 3)."""
    where = np.asarray(region)
    if where.dtype != bool:
        return np.unique(_flat_voxels(grid, where))
    if where.shape != grid.shape:
        raise InputError(f"region has shape {where.shape}, the grid is {grid.shape}")
    return np.flatnonzero(where)


def _rows_and_columns(camera: Camera, pixels: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rows (...) and columns (...) of pixels (..., 2), which are (column, row)."""
    index = np.asarray(pixels)
    _check_indices("pixel", index, (camera.width, camera.height), "a pixel is (column, row)")
    return index[..., 1], index[..., 0]


def _neighbours(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells a < b (m,) of neighbouring pixels in different `cells` (H, W), and one of the two pixels (m, 2)."""
    found = []
    for axis in (0, 1):
        one, next_one = (np.moveaxis(cells, axis, 0)[part] for part in (np.s_[:-1], np.s_[1:]))
        where = np.argwhere(one != next_one)
        at = tuple(where.T)
        pixels = where[:, ::-1] if axis == 0 else where  # (column, row)
        found.append((np.minimum(one[at], next_one[at]), np.maximum(one[at], next_one[at]), pixels))
    a, b, pixels = (np.concatenate(column) for column in zip(*found, strict=True))
    return a, b, pixels
