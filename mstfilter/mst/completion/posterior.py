"""Completion by a prior over whole objects: which boxes, cylinders, vessels (...) could have been seen like this?

>>> Posterior().complete(rng, frame, masks, grid)                  # the posterior mean of the occupancy
>>> Posterior(kinds=(BoxKind(), CylinderKind(share=2))).fill(rng, seen)
>>> Posterior().draw(rng, seen)                                    # the occupancy of one shape of the posterior

A candidate is a kind of shape (`kinds`) in a bounding box. The box has a *frame*: its axes, from the support plane,
the normals of the visible faces, the smallest rectangle around them, the direction to the camera, or the principal
axes; and the height at which it rests, on the table or on a surface below. Within a frame, a candidate is a vector u,
whose prior is standard normal. It moves the ends of the box from the ends of the readings by a few millimetres, or,
where no free space follows, outwards by a length of the order of the visible extents; it turns the box by a few
degrees; and it says how the shape fills the box.

The log likelihood of a candidate has four terms:

    - n_eff * mean(rho(distance of the object's readings from the surface / sigma))     heavy tails
    - penalty * (volume in voxels that are observed as free)
    - penalty * (volume in voxels of another surface)
    - rho(distance of the lowest point from the support), or a penalty for what would hardly stand on its foot

Readings that are near each other have errors in common, above all that of the shape itself, which is never quite a
cylinder. So n_eff is far below the number of readings: the likelihood is tempered.

Candidates of all kinds and frames are one population of a sequential Monte Carlo sampler (Del Moral, Doucet, Jasra,
"Sequential Monte Carlo samplers", 2006), in which the likelihood is raised to a power that grows from 0 to 1 so that
the effective sample size falls by a constant factor. Kinds and frames that fit badly die out, so what is left in the
end are samples of the posterior with each kind in proportion to its evidence. Moves propose new values of some of the
numbers, u' = sqrt(1 - s^2) u + s e, which leaves the prior invariant, so the likelihood alone decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import ndtr

from mstfilter.base.fields import NonNegativeFloat, PositiveFloat, PositiveInt, Share
from mstfilter.mst.completion.candidates import Boxes, Groups, ShapeEvidence, in_metres, shape_groups
from mstfilter.mst.completion.extrude import Extrude
from mstfilter.mst.completion.kinds import (
    BoxKind,
    ConeKind,
    CylinderKind,
    EllipsoidKind,
    ShapeKind,
    SuperquadricKind,
    TurnedKind,
    VesselKind,
)
from mstfilter.mst.completion.lattice import OnLattice
from mstfilter.mst.completion.observed import ObservedBox
from mstfilter.smc.resampling import inverse_cdf

SHAPE_KINDS = (
    BoxKind(share=3.0),
    CylinderKind(share=2.0),
    ConeKind(),
    TurnedKind(),
    EllipsoidKind(),
    SuperquadricKind(),
    VesselKind(),
)

# What stands has a foot at least a quarter as wide as it is high; log likelihood lost for each factor e of less.
_SLENDER, _STABLE = 0.25, 3.0
_REST = 0.004  # metres, standard deviation of the lowest point about the support
# Metres. Readings are compared this far outside of the surface, so the wrong side of a wall does not explain them.
_OUTSIDE = 0.003
_NO_FIT = 1.2  # residual of all readings, in standard deviations, from which "no kind fits" is more likely
_TAIL = 4.0  # degrees of freedom of the residuals
_CERTAIN = 0.999  # probability that a kind fits, from which the object is not extruded too
# Fitted to meshes of the tuning pool: depth in voxels behind the measured surface, and the share of such voxels that
# are occupied although no shape reaches there; the factor of this share in parts of the mask that may show other
# things; mean and standard deviation of the depth, in voxels, at which the object begins.
_DEEP = 0.7  # voxels behind the readings, where a thin wall has ended
_LAYER, _ASIDE, _FRONT = ((0.5, 0.65, 1.0, 1.4), (0.85, 0.75, 0.55, 0.45)), 0.6, (-0.05, 0.2)
_MOSTLY = 0.6  # of the surface of all views, that the latest one shows if the others are left out
_LEAST_GROUP = 6  # candidates of each kind and frame
_STAGES = 20  # at most
_FIRST = 2  # candidates of the first stage, in units of `n`
_MOVES, _CHANGED = 2, 0.35  # moves of a stage, and the share of the numbers that a move changes
_KEPT = 0.25  # effective sample size after a stage of the sampler, as a share
_SCALES = np.array([0.12, 0.4, 0.95], np.float32)  # s of a move
_MOST_DISTANCES = 400_000  # of the mean occupancy


@dataclass(frozen=True)
class Posterior(OnLattice):
    """Completion by the posterior mean over whole shapes.

    Parameters
    ----------
    kinds : tuple of ShapeKind
        The kinds of shapes.
    n : int
        Candidates after the first stage of the sampler; before it, there are twice as many.
    sigma : float
        Standard deviation in metres of the distance of a reading from the surface.
    misfit : float
        Part of this standard deviation that grows with the object, as a share of its size: real things differ from
        the kinds.
    tempering, most_readings : float
        A voxel of visible surface counts as `tempering` independent readings, all together as at most
        `most_readings`.
    penalty : float
        Log likelihood lost for each voxel of a shape that is observed as free or as another surface.
    other_shape : float
        Prior weight of the answer that no kind fits; the shape is then extruded.
    """

    kinds: tuple[ShapeKind, ...] = SHAPE_KINDS
    n: PositiveInt = 256
    sigma: PositiveFloat = 0.003
    misfit: NonNegativeFloat = 0.015
    tempering: PositiveFloat = 0.3
    most_readings: PositiveFloat = 40.0
    penalty: NonNegativeFloat = 0.3
    other_shape: Share = 0.02

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        """Posterior mean of the occupancy (a, b, c). It draws no number of `rng`, so an object has one answer."""
        [(p, fits)] = self.opinions([rng], [seen])
        return p if fits > _CERTAIN else fits * p + (1 - fits) * Extrude().fill(rng, seen)

    def opinions(
        self, rngs: Sequence[np.random.Generator], seen: Sequence[ObservedBox]
    ) -> list[tuple[np.ndarray, float]]:
        """The mean occupancy under the kinds, and the probability that one of them fits."""
        found = []
        for one in seen:
            drawn = self.sample(np.random.default_rng(0), one) if one.surface.any() else None
            empty = np.zeros(one.surface.shape, np.float32), 0.0
            found.append(empty if drawn is None else (drawn.occupancy(), 1 - drawn.other_shape))
        return found

    def draw(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        """Occupancy (a, b, c) of one shape of the posterior."""
        if not seen.surface.any():
            return np.zeros(seen.surface.shape, np.float32)
        drawn = self.sample(rng, seen)
        if rng.random() < drawn.other_shape:
            return Extrude().fill(rng, seen)
        return drawn.take(rng.integers(self.n, size=1)).occupancy()

    def sample(self, rng: np.random.Generator, seen: ObservedBox) -> ShapeSamples:
        """Samples of the posterior, of equal weight. `seen` has visible surface.

        Earlier views count if they show much that the latest frame does not. A view that moved with the object is off
        by up to half a voxel, more than the readings, and the errors of its readings are alike.
        """
        latest = seen.latest
        if latest is not None and latest.surface.sum() >= _MOSTLY * seen.surface.sum():
            seen = latest
        evidence = ShapeEvidence.of(seen)
        groups = shape_groups(evidence, self.kinds)
        count = np.maximum(np.rint(_FIRST * self.n * groups.prior), _LEAST_GROUP).astype(int)
        group = np.repeat(np.arange(len(count)), count)
        log_w = np.log(groups.prior / count)[group]
        d = 9 + max(kind.n_shape for kind in self.kinds)
        u = rng.standard_normal((d, len(group)), dtype=np.float32)
        found = self._log_likelihoods(evidence, groups, group, u)
        power, log_evidence = 0.0, 0.0
        for stage in range(_STAGES):
            step = 1 - power if stage == _STAGES - 1 else _next_step(log_w, found, 1 - power, _KEPT)
            power += step
            log_w = log_w + step * found
            top = log_w.max()
            w = np.exp(log_w - top)
            log_evidence += top + np.log(w.sum())
            chosen = inverse_cdf(w, rng.random(1), self.n)
            group, u, found = group[chosen], u[:, chosen], found[chosen]
            log_w = np.full(self.n, -np.log(self.n))
            for _ in range(_MOVES):
                s = _SCALES[rng.integers(len(_SCALES), size=self.n)]
                s = s * (rng.random((d, self.n), dtype=np.float32) < _CHANGED)
                proposed = np.sqrt(1 - s * s) * u + s * rng.standard_normal((d, self.n), dtype=np.float32)
                theirs = self._log_likelihoods(evidence, groups, group, proposed)
                accept = np.log(rng.random(self.n)) < power * (theirs - found)
                u, found = np.where(accept, proposed, u), np.where(accept, theirs, found)
            if power >= 1:
                break
        none = self._log_of_residuals(evidence, np.full((1, 1), _NO_FIT)).item()
        other = self.other_shape / (self.other_shape + (1 - self.other_shape) * np.exp(min(log_evidence - none, 50)))
        boxes = groups.boxes(group, u)
        return ShapeSamples(self.kinds, groups.kind[group], boxes, float(other), evidence, seen)

    def _log_likelihoods(
        self, evidence: ShapeEvidence, groups: Groups, group: np.ndarray, u: np.ndarray
    ) -> np.ndarray:
        """Log likelihood (n,) of candidates u (d, n) of groups (n,)."""
        order = np.argsort(groups.kind[group], kind="stable")  # a slice of candidates for each kind
        kinds, group = groups.kind[group][order], group[order]
        boxes, found = groups.boxes(group, u[:, order]), np.empty(len(order))
        for k in np.unique(kinds):
            part = slice(*np.searchsorted(kinds, (k, k + 1)))
            kind, own = self.kinds[k], boxes.take(part)
            found[order[part]] = self._log_likelihood(evidence, kind, own) + kind.log_weight(own.half, own.shape)
        off = (boxes.lowest(groups.round[group]) - groups.support[group]) / _REST
        foot = np.array([kind.foot for kind in self.kinds])[kinds] * boxes.half[:2].min(axis=0)
        narrow = np.maximum(np.log(_SLENDER * boxes.half[2] / foot), 0)
        found[order] -= np.where(groups.upright[group], _STABLE * narrow, (_TAIL + 1) / 2 * np.log1p(off**2 / _TAIL))
        return found

    def _log_likelihood(self, evidence: ShapeEvidence, kind: ShapeKind, boxes: Boxes) -> np.ndarray:
        points = np.concatenate([evidence.own + _OUTSIDE * evidence.normal, evidence.free, evidence.other])
        distance = kind.distance(boxes.half, boxes.shape, boxes.local(points))
        n_own, n_free = len(evidence.own), len(evidence.free)
        sigma = self.sigma + self.misfit * evidence.size
        found = self._log_of_residuals(evidence, (distance[:n_own] - _OUTSIDE) / sigma)
        # A free voxel beside the surface is not inside.
        volume = np.clip((_thin(kind, boxes, evidence.voxel) - distance[n_own:]) / evidence.voxel, 0, 1)
        found -= self.penalty * evidence.weight_free * volume[:n_free].sum(axis=0)
        return np.asarray(found - self.penalty * evidence.weight_other * volume[n_free:].sum(axis=0))

    def _log_of_residuals(self, evidence: ShapeEvidence, residual: np.ndarray) -> np.ndarray:
        n = min(self.tempering * evidence.n_surface, self.most_readings)
        return np.asarray(-n * (_TAIL + 1) / 2 * np.log1p(residual**2 / _TAIL).mean(axis=0))


class DrawnShape(Posterior):
    """Draws one shape of the posterior for each object, so hypotheses differ where the shape is open."""

    stochastic: ClassVar[bool] = True

    def fill(self, rng: np.random.Generator, seen: ObservedBox) -> np.ndarray:
        return self.draw(rng, seen)


@dataclass(frozen=True, eq=False)
class ShapeSamples:
    """Samples of a posterior over the shapes of an object."""

    kinds: tuple[ShapeKind, ...]
    kind: np.ndarray  #: (n,) index of the kind of each sample
    boxes: Boxes
    other_shape: float  #: probability that no kind fits
    evidence: ShapeEvidence
    seen: ObservedBox

    def take(self, index: np.ndarray) -> ShapeSamples:
        """Some of the samples."""
        return replace(self, kind=self.kind[index], boxes=self.boxes.take(index))

    def occupancy(self) -> np.ndarray:
        """Mean occupancy (a, b, c) float32 of the samples. Voxels that are observed as free get 0.

        The occupancy of a voxel is the share of it that is inside, by the distance of its centre from the surface.
        Whatever the shape, a layer behind the readings belongs to the object, and what lies in front of them does
        not: `_LAYER`, `_FRONT`. A wall thinner than a voxel fills the voxels whose centres are within half a voxel of
        its middle (`mstfilter.lab.simulation.shapes`), so it begins in front of the readings and ends soon behind.
        """
        p, voxel, evidence = np.zeros(self.seen.surface.shape, np.float32), self.evidence.voxel, self.evidence
        reach = np.abs(self.boxes.axes * self.boxes.half).sum(axis=1) + voxel
        low, high = (self.boxes.centre - reach).min(axis=1), (self.boxes.centre + reach).max(axis=1)
        index = np.argwhere(~self.seen.free)
        points = in_metres(index, self.seen, voxel)
        near = ((points >= low) & (points <= high)).all(axis=1)
        index, points, n = index[near], points[near], len(self.kind)
        kept = int(np.clip(_MOST_DISTANCES // max(len(points), 1), 8, n))
        drawn = self.take(np.arange(0, n, -(-n // kept)))
        total, thinness = np.zeros(len(points), np.float32), 0.0
        for k in np.unique(drawn.kind):
            kind, boxes = self.kinds[k], drawn.boxes.take(np.flatnonzero(drawn.kind == k))
            distance = kind.distance(boxes.half, boxes.shape, boxes.local(points))
            thin = _thin(kind, boxes, voxel)
            total += np.clip(0.5 + (thin - distance) / voxel, 0, 1).sum(axis=1)
            thinness += float(thin.sum()) / voxel / len(drawn.kind)  # 0 solid .. 1/2 a sheet
        p[tuple(index.T)] = total / len(drawn.kind)
        depth = evidence.depth
        layer = np.interp(depth, *_LAYER) * np.where(evidence.main, 1, _ASIDE)
        layer *= np.where(depth > _DEEP, 1 - 2 * thinness, 1)
        at = tuple(evidence.layer.T)
        p[at] = np.maximum(p[at], layer) * ndtr((depth - _FRONT[0] + thinness) / _FRONT[1])
        return p


def _thin(kind: ShapeKind, boxes: Boxes, voxel: float) -> np.ndarray:
    """Metres (n,) by which both sides of a wall are moved outwards: in voxels, no wall is thinner than one."""
    return np.maximum(voxel - kind.thickness(boxes.half, boxes.shape), 0) / 2


def _next_step(log_w: np.ndarray, found: np.ndarray, most: float, share: float) -> float:
    """The step of the power, at most `most`, after which the effective sample size is a share of what it was."""

    def ess(step: float) -> float:
        w = log_w + step * found
        w = np.exp(w - w.max())
        return float(w.sum() ** 2 / (w**2).sum())

    target = share * ess(0.0)
    if ess(most) >= target:
        return most
    low, high = 0.0, most
    for _ in range(20):
        middle = (low + high) / 2
        low, high = (middle, high) if ess(middle) >= target else (low, middle)
    return low
