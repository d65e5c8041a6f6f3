"""What a weighted population of hypotheses believes about the scene: queries for planners.

>>> belief = Belief(state.population)
>>> belief.occupancy()[tuple(belief.voxel([0.1, 0.0, 0.02]))]     # probability that something is there
>>> belief.same_object_at_pixels(camera, (310, 200), (340, 210))  # one object or two?
>>> belief.object_count()                                         # probability of 0, 1, 2, ... objects
>>> max(cameras, key=belief.view_information)                     # where to look from
>>> belief.push_map(tolerance=50)                                 # where a push tells hypotheses apart

Below, hypothesis i has labels L_i and the weight w_i, normalised. A label is a name within its hypothesis only, so
nothing here compares labels of different hypotheses, and nothing changes with the names. Voxels are indices (x, y, z)
as integers; `Belief.voxel` and `Belief.box` turn metres into them. Pixels are (column, row). A region is a bool array
of the grid's shape, or voxels (..., 3). Entropy and information are in nats (divide by log 2 for bits).

**Information.** Every action (looking at a region, from a camera, pushing) has one outcome under each hypothesis, and
what it is expected to teach is the mutual information of hypothesis and outcome. Without noise this is exactly the
entropy of the weights summed over equal outcomes, at most `partition_entropy()`, itself at most log n. It is about
what the hypotheses disagree on: what all of them have wrong, no number here shows. Outcomes that differ in one voxel
are two; with `tolerance` (in voxels or pixels) outcomes count as different as far as they differ by more than that
(formula in `mstfilter.fusion.information`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from mstfilter.errors import InputError
from mstfilter.fusion.information import (
    binary_entropy,
    canonical_rows,
    entropy,
    foreseen,
    hamming,
    noisy_information,
    partition_distance,
    tolerated,
)
from mstfilter.fusion.places import box_of, camera_of, flat_of, pixels_of, region_of, single, voxel_of
from mstfilter.fusion.refinement import Refinement, refine
from mstfilter.scene import Camera, Hypothesis, VoxelGrid, project, render_hypothesis
from mstfilter.smc import Population, first_seen

__all__ = ["Belief"]

DEPTH_STEP = 0.01  # of a voxel: depths closer than this are equal but for rounding


@dataclass(frozen=True, eq=False)
class Belief:
    """A posterior over scenes, as far as its hypotheses reach.

    Parameters
    ----------
    population : Population
        Hypotheses on one grid with unnormalised log weights, such as ``state.population``. Equal hypotheses are
        looked at once; those of weight 0 not at all.

    Raises
    ------
    InputError
        The population is empty or does not hold hypotheses, or their grids differ.
    """

    population: Population

    def __post_init__(self) -> None:
        if not isinstance(self.population, Population):
            raise InputError(
                f"a belief is made of a Population, not of {type(self.population).__name__}",
                "Belief(state.population), or Belief(Population(hypotheses, log_weights))",
            )
        particles = self.population.particles
        if isinstance(particles, Mapping | np.ndarray) or not all(isinstance(h, Hypothesis) for h in particles):
            raise InputError("a belief is about particles that are hypotheses, not vectors or other objects")
        for k, h in enumerate(particles):
            if h.grid != self.grid:
                raise InputError(
                    f"hypothesis {k} has a grid of {h.grid.shape} voxels of {h.grid.voxel_size:g} m from "
                    f"{h.grid.origin.tolist()}, hypothesis 0 one of {self.grid.shape} voxels of "
                    f"{self.grid.voxel_size:g} m from {self.grid.origin.tolist()}",
                    "the hypotheses of a belief share one grid",
                )

    def __len__(self) -> int:
        return len(self.population)

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The n particles."""
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
    def _merged(self) -> tuple[tuple[Hypothesis, ...], np.ndarray]:
        """Different hypotheses of positive weight, and their weights."""
        which = first_seen(h.key for h in self.hypotheses)
        mass = np.bincount(which, self.weights)
        example = np.unique(which, return_index=True)[1]
        kept = np.flatnonzero(mass > 0)
        return tuple(self.hypotheses[int(example[k])] for k in kept), mass[kept]

    @property
    def _mass(self) -> np.ndarray:
        return self._merged[1]

    @cached_property
    def _refined(self) -> Refinement:
        return refine([h.labels for h in self._merged[0]])

    # Places ---------------------------------------------------------------------------------------------------

    def voxel(self, points: Any) -> np.ndarray:
        """Voxels (..., 3) that hold world points (..., 3) in metres; a point outside the grid is an InputError."""
        return voxel_of(self.grid, points)

    def box(self, lower: Any, upper: Any) -> np.ndarray:
        """Region (X, Y, Z) bool: voxels whose centres lie in the box between two corners in metres."""
        return box_of(self.grid, lower, upper)

    def _cells(self, voxels: Any) -> np.ndarray:
        """(...) cells of voxels (..., 3)."""
        return self._refined.cells.ravel()[flat_of(self.grid, voxels)]

    def _region(self, region: Any) -> tuple[np.ndarray, np.ndarray]:
        """Cells that a region meets, and how many of its voxels lie in each; None is the whole grid."""
        counts = self._refined.sizes
        if region is not None:
            inside = self._refined.cells.ravel()[region_of(self.grid, region)]
            counts = np.bincount(inside, minlength=len(counts))
        met = np.flatnonzero(counts)
        return met, counts[met]

    # What is there --------------------------------------------------------------------------------------------

    def occupancy(self) -> np.ndarray:
        """(X, Y, Z) probability that a voxel belongs to any object: ``p(v) = sum_i w_i [L_i(v) > 0]``."""
        return (self._mass @ (self._refined.objects > 0))[self._refined.cells]

    def occupancy_entropy(self) -> np.ndarray:
        """(X, Y, Z) entropy of "occupied or free": ``-p log p - (1 - p) log(1 - p)``, p the `occupancy`."""
        return binary_entropy(self._mass @ (self._refined.objects > 0))[self._refined.cells]

    def same_object(self, a: Any, b: Any) -> np.ndarray:
        """Probability that two voxels belong to the same object: ``sum_i w_i [L_i(a) = L_i(b) > 0]``.

        Parameters
        ----------
        a, b : (..., 3) int
            Voxels; they are broadcast against each other. For a = b it is the occupancy.

        Returns
        -------
        (...) float
        """
        one, other = self._refined.objects[:, self._cells(a)], self._refined.objects[:, self._cells(b)]
        return np.tensordot(self._mass, (one == other) & (one > 0), axes=1)

    def object_at(self, voxel: Any) -> np.ndarray:
        """(X, Y, Z) where the object at a voxel (3,) reaches: ``same_object(voxel, v)`` for every voxel v."""
        own = self._refined.objects[:, self._cells(single(voxel, 3))]
        same = (self._refined.objects == own[:, None]) & (own > 0)[:, None]
        return (self._mass @ same)[self._refined.cells]

    def same_object_at_pixels(self, camera: Camera, a: Any, b: Any) -> np.ndarray:
        """Probability that two pixels show the same object: ``sum_i w_i [R_i(a) = R_i(b) > 0]``, R_i = Project(h_i).

        Parameters
        ----------
        camera : Camera
        a, b : (..., 2) int
            Pixels (column, row); they are broadcast against each other.

        Returns
        -------
        (...) float
        """
        images = self._images(camera)
        a, b = pixels_of(camera, a), pixels_of(camera, b)
        same = [(image[a] == image[b]) & (image[a] > 0) for image in images]
        return np.tensordot(self._mass, np.stack(same), axes=1)

    def object_at_pixel(self, camera: Camera, pixel: Any) -> np.ndarray:
        """(H, W) probability that each pixel shows the same object as `pixel`, (column, row)."""
        images = self._images(camera)
        row, column = pixels_of(camera, single(pixel, 2))
        return sum(
            w * ((r == r[row, column]) & (r[row, column] > 0)) for w, r in zip(self._mass, images, strict=True)
        )

    def object_count(self, region: Any = None) -> np.ndarray:
        """(K + 1,) probability of k objects, k = 0 .. K: ``sum_i w_i [hypothesis i has k objects]``.

        With a region only objects are counted that have a voxel in it.
        """
        named = np.cumsum(self._refined.named(self._region(region)[0]))
        return np.bincount(np.diff(named[self._refined.first]), self._mass)

    def mean_object_count(self, region: Any = None) -> float:
        """Expected number of objects: ``sum_k k p(k)``, p as in `object_count`."""
        p = self.object_count(region)
        return float(np.arange(len(p)) @ p)

    # How sure it is -------------------------------------------------------------------------------------------

    def _faces(self, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces between different cells: (X, Y, Z) bool of the lower voxel, P(both occupied), P(same object)."""
        cells = np.moveaxis(self._refined.cells, axis, 0)
        where = np.zeros(cells.shape, bool)
        where[:-1] = (cells[:-1] != cells[1:]) & (cells[:-1] > 0) & (cells[1:] > 0)
        lower, upper = cells[:-1][where[:-1]], cells[1:][where[:-1]]
        both, same = np.zeros(len(lower)), np.zeros(len(lower))
        for w, row in zip(self._mass, self._refined.objects, strict=True):
            one, other = row[lower], row[upper]
            both += w * ((one > 0) & (other > 0))
            same += w * ((one > 0) & (one == other))
        return where, both, same

    def boundary(self) -> np.ndarray:
        """(3, X, Y, Z) probability that two objects meet at a face.

        ``[a, v] = sum_i w_i [L_i(v) > 0, L_i(v') > 0, L_i(v) != L_i(v')]``, v' the next voxel along axis a; 0 where
        the grid ends.
        """
        found = np.zeros((3, *self.grid.shape))
        for axis in range(3):
            where, both, same = self._faces(axis)
            np.moveaxis(found[axis], axis, 0)[where] = np.maximum(both - same, 0.0)
        return found

    def boundary_entropy(self) -> np.ndarray:
        """(X, Y, Z) how unsure the segmentation is at a voxel: the most uncertain of its six faces, at most log 2.

        A face between v and v' has ``H(S | B) = P(B) h(P(S | B))`` with B: both are occupied, S: by the same object,
        ``h(p) = -p log p - (1 - p) log(1 - p)``. So doubt about occupancy alone, which `occupancy_entropy` shows,
        counts nothing here: H(B, S) = H(B) + H(S | B).
        """
        found = np.zeros(self.grid.shape)
        for axis in range(3):
            where, both, same = self._faces(axis)
            face = np.zeros(where.shape)
            face[where] = both * binary_entropy(np.divide(same, both, out=np.zeros_like(same), where=both > 0))
            out = np.moveaxis(found, axis, 0)
            np.maximum(out, face, out=out)
            np.maximum(out[1:], face[:-1], out=out[1:])
        return found

    def partition_entropy(self, region: Any = None, tolerance: float = 0.0) -> float:
        """Entropy of the segmentation of a region (default: the whole grid): which voxels are free, which together.

        ``-sum_s P(s) log P(s)``, P(s) the weight of the hypotheses that divide the region in the way s. It is also
        the information of learning the true segmentation there. Without region and tolerance it bounds every
        information. The distance for the tolerance is the number of voxels that must change hands.
        """
        tolerance = tolerated(tolerance)
        cells, sizes = self._region(region)
        rows = canonical_rows(self._refined.objects[:, cells])
        return foreseen(self._mass, rows, partition_distance, sizes, tolerance)

    # What an action would teach -------------------------------------------------------------------------------

    def look_information(self, region: Any, tolerance: float = 0.0) -> float:
        """Information of learning which voxels of a region are occupied (occluded or not).

        Outcome: ``{v in region: L_i(v) > 0}``. For one voxel this is its `occupancy_entropy`.
        """
        tolerance = tolerated(tolerance)
        cells, sizes = self._region(region)
        return foreseen(self._mass, self._refined.objects[:, cells] > 0, hamming, sizes, tolerance)

    def view_information(
        self, camera: Camera, tolerance: float = 0.0, sees: Literal["depth", "objects"] = "depth"
    ) -> float:
        """Information of an image from a camera.

        Parameters
        ----------
        camera : Camera
            Real or imagined; ``camera.scaled(0.25)`` is cheaper.
        tolerance : float
            Pixels.
        sees : {"depth", "objects"}
            Outcome: the depth image of the objects (to a hundredth of a voxel; no table behind them), or which pixels
            show the same object, as if the image were segmented without fault.
        """
        tolerance = tolerated(tolerance)
        if sees == "objects":
            image = refine(self._images(camera))
            rows = canonical_rows(image.objects)
            return foreseen(self._mass, rows, partition_distance, image.sizes, tolerance)
        if sees != "depth":
            raise InputError(f'a camera sees {sees!r}, expected "depth" or "objects"')
        step = DEPTH_STEP * self.grid.voxel_size
        depths = (render_hypothesis(h, camera_of(camera)).depth.ravel() for h in self._merged[0])
        pixels = np.stack([np.nan_to_num(np.round(d / step), nan=-1).astype(np.int32) for d in depths])
        pixels = pixels[:, (pixels != pixels[0]).any(axis=0)]
        return foreseen(self._mass, pixels, hamming, np.ones(pixels.shape[1]), tolerance)

    def push_information(self, region: Any, tolerance: float = 0.0) -> float:
        """Information of pushing at a voxel or a region and seeing which voxels move along.

        Outcome: ``{v: L_i(v) = L_i(u) > 0 for a u in region}``, all voxels of all objects that have one in the region
        (nothing where it is free). What they push in turn is left out.
        """
        tolerance = tolerated(tolerance)
        moved = self._refined.named(self._region(region)[0])[self._refined.objects]
        return foreseen(self._mass, moved, hamming, self._refined.sizes, tolerance)

    def push_map(self, tolerance: float = 0.0) -> np.ndarray:
        """(X, Y, Z) `push_information` of each single voxel."""
        tolerance = tolerated(tolerance)
        refined, mass = self._refined, self._mass
        overlap = refined.overlaps()
        volume = overlap.diagonal()
        apart = volume[:, None] + volume[None, :] - 2 * overlap
        near = np.exp(-apart / tolerance) if tolerance else (apart == 0).astype(np.float64)
        information = np.zeros(len(refined.sizes))
        for w, own in zip(mass, refined.objects, strict=True):
            alike = sum(v * near[own, other] for v, other in zip(mass, refined.objects, strict=True))
            information -= w * np.log(alike)
        return np.maximum(information, 0.0)[refined.cells]

    # Anything else --------------------------------------------------------------------------------------------

    def expect(self, function: Callable[[Hypothesis], Any]) -> Any:
        """``sum_i w_i f(h_i)`` of numbers or arrays, such as the probability that a path is free."""
        pairs = zip(self.weights, self.hypotheses, strict=True)
        return sum(w * np.asarray(function(h), dtype=np.float64) for w, h in pairs if w > 0)

    def information(self, outcome: Callable[[Hypothesis], Hashable]) -> float:
        """Information of an action of your own whose outcome follows from the hypothesis.

        ``H(O)``, ``P(O = o) = sum_i w_i [outcome(h_i) = o]``. The outcome must not contain labels: they are names.
        """
        outcomes = [(outcome(h), w) for w, h in zip(self.weights, self.hypotheses, strict=True) if w > 0]
        try:
            which = first_seen(o for o, _ in outcomes)
        except TypeError as error:
            raise InputError(f"an outcome cannot be compared ({error})", "for arrays: array.tobytes()") from error
        return entropy(np.bincount(which, [w for _, w in outcomes]))

    def noisy_information(self, probabilities: Callable[[Hypothesis], Any]) -> float:
        """Information of an action whose outcome is uncertain even if the hypothesis is known.

        ``H(O) - sum_i w_i H(O | i)``, exact; ``probabilities(h_i)`` gives (k,) ``P(O = o | i)`` for k outcomes.
        """
        pairs = [(w, probabilities(h)) for w, h in zip(self.weights, self.hypotheses, strict=True) if w > 0]
        try:
            channel = np.array([p for _, p in pairs], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"probabilities of outcomes are not one list of k numbers ({error})") from error
        if channel.ndim != 2 or not (channel >= 0).all() or not np.allclose(channel.sum(axis=1), 1):
            raise InputError("probabilities of outcomes are negative or do not sum to 1 for a hypothesis")
        return noisy_information(np.array([w for w, _ in pairs]), channel)

    def reweighted(self, log_likelihood: Callable[[Hypothesis], float]) -> Belief:
        """The belief after an observation: log weights plus ``log p(observation | h_i)``; -inf rules out."""
        return Belief(self.population.reweighted(np.array([float(log_likelihood(h)) for h in self.hypotheses])))

    def sample(self, rng: np.random.Generator, n: int = 1) -> tuple[Hypothesis, ...]:
        """n independent draws, each ``h_i`` with probability ``w_i``."""
        if n < 1:
            raise InputError(f"{n} samples were asked for, expected at least 1")
        return tuple(self.hypotheses[int(k)] for k in rng.choice(len(self), size=n, p=self.weights))

    def _images(self, camera: Camera) -> list[np.ndarray]:
        return [project(h, camera_of(camera)) for h in self._merged[0]]
