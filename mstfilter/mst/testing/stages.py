"""Contracts of the stages of MST: boundaries, trees, cuts, completion, motions, projections.

Besides the properties that every component of an interface has, these contracts test what a stage makes of two clips
whose motions are known (`mstfilter.mst.testing.scenes.known_motions`). The bounds leave room for poor components.
They find results that are wrong: backwards, in another frame, of another image.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from scipy import ndimage

from mstfilter.base.errors import InputWarning
from mstfilter.mst.completion import Completer, ObservedBox, Posterior, ShapeKind, observed_box
from mstfilter.mst.completion.completer import fault_of
from mstfilter.mst.crossover import Crossover, CrossoverUpdate, Structure
from mstfilter.mst.partition import PairOdds, PartitionUpdate
from mstfilter.mst.segmentation import BoundaryModel, CutSampler, CutValue, TreeBuilder, TreeCutProposal
from mstfilter.mst.testing.scenes import KnownMotion, known_motions, scene_example
from mstfilter.mst.tracking import (
    DenseFlow,
    MaskTracker,
    MotionRule,
    MstRule,
    Registration,
    Track,
    TrackingTransition,
    segments_of,
)
from mstfilter.mst.tracking.registration import prepare
from mstfilter.mst.tracking.rigid import move_points
from mstfilter.mst.tracking.rules import fault_of_motions
from mstfilter.scene import Clip, Hypothesis, Projection, render_hypothesis, scene_cache
from mstfilter.smc import Component, Population, Proposal, Transition, child
from mstfilter.smc.testing.contract import (
    Contract,
    prerequisite,
    reports_errors,
    same,
    seeded,
    skips_errors,
)

#: The warnings of a run are properties of their own in a contract.
_quiet = partial(warnings.catch_warnings, action="ignore", category=InputWarning)
#: Interface of a stage -> the component of a filter that uses it.
STAGE_OWNERS: dict[type, Callable[[Any], Component]] = {
    BoundaryModel: lambda stage: TreeCutProposal(boundary=stage),
    TreeBuilder: lambda stage: TreeCutProposal(tree=stage),
    CutValue: lambda stage: TreeCutProposal(value=stage),
    CutSampler: lambda stage: TreeCutProposal(sampler=stage),
    Completer: lambda stage: TreeCutProposal(completer=stage),
    ShapeKind: lambda stage: TreeCutProposal(completer=Posterior(kinds=(stage,), n=32)),
    MaskTracker: lambda stage: TrackingTransition(tracker=stage),
    MotionRule: lambda stage: TrackingTransition(rule=stage),
    Registration: lambda stage: TrackingTransition(rule=MstRule(registration=stage)),
    Projection: lambda stage: CrossoverUpdate(free_space=stage),
    Structure: lambda stage: CrossoverUpdate(crossover=Crossover(structure=stage)),
    PairOdds: lambda stage: PartitionUpdate(pairs=stage),
}


class StageContract(Contract):
    """The contract of a stage of MST, which is tested as a part of the proposal, the tracking or the update."""

    example = staticmethod(scene_example)

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> Any:
        """The result of the proposal, transition or update that uses the component."""
        owner = next(use for interface, use in STAGE_OWNERS.items() if isinstance(component, interface))(component)
        population, clip = inputs["population"], inputs["observation"]
        scene_cache.clear()  # a repeated call runs the component again
        if isinstance(owner, Proposal):
            found = owner.sample(rng, clip, len(population))
        elif isinstance(owner, Transition):
            found = owner.predict(rng, population, clip)
        else:
            assert isinstance(owner, CrossoverUpdate | PartitionUpdate)
            found = owner.update(rng, population, population.take(np.arange(min(2, len(population)))), clip)
            if isinstance(owner, CrossoverUpdate):
                found = found.take(np.arange(0, len(found), 5))
        return found.realised()

    @prerequisite
    def test_works_in_its_place(self) -> None:
        """The filter step that uses the component returns hypotheses, also if no hypothesis has an object."""
        inputs = self.inputs(2)
        grid = inputs["observation"].grid
        empty = Hypothesis.from_labels(np.zeros(grid.shape, np.uint16), grid)
        for given in (self.inputs(1), self.inputs(4), {**inputs, "population": Population((empty, empty))}):
            with reports_errors(given):
                result = StageContract.call(self, self.make(), seeded(3), given)
            assert all(isinstance(h, Hypothesis) for h in result.particles), "the result has no hypotheses"


class CompleterContract(StageContract):
    """The contract of every `Completer`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> list[np.ndarray]:
        """The estimated probabilities in the boxes of three objects, computed without a cache."""
        seen = _boxes(component, _correct(inputs), inputs["observation"])
        return [np.array(p) for p in _estimated(component, rng, seen, inputs["observation"])]

    def _seen(self, cut: bool = False) -> tuple[list[ObservedBox], Clip]:
        """Boxes of the three objects in the example, and the example's clip."""
        inputs = self.inputs(1)
        return _boxes(self.make(), _correct(inputs), inputs["observation"], cut), inputs["observation"]

    def _filled(self, seen: list[ObservedBox], clip: Clip, first: int = 0) -> list[np.ndarray]:
        with skips_errors():
            return _estimated(self.make(), seeded(0), seen, clip, first)

    def test_works_for_any_box(self) -> None:
        """The completer works for a box with edges of different lengths, and for a box without voxels."""
        seen, clip = self._seen()
        odd = [_cropped(seen[0], *size) for size in ((7, 6, 5), (0, 0, 0))]
        with reports_errors("boxes of shape (7, 6, 5) and (0, 0, 0)"):
            _estimated(self.make(), seeded(0), odd, clip)

    def test_follows_what_is_seen(self) -> None:
        """The probabilities are not constant, and the visible surface is probably occupied."""
        seen, clip = self._seen()
        fault = fault_of(seen, self._filled(seen, clip))
        assert fault is None, f"{type(self.make()).__name__}.fill {fault}"

    def test_axes_are_those_of_the_grid(self) -> None:
        """The result has the axes of the box: a reversed result fits the visible surface less well."""
        seen, clip = self._seen(cut=True)
        filled = self._filled(seen, clip)
        choices = [axes for n in range(4) for axes in combinations(range(3), n)]
        fit = {axes: _on_surface(filled, seen, axes) for axes in choices}
        best = max(choices, key=lambda axes: fit[axes])
        assert fit[()] >= fit[best] - 0.05, (
            f"the visible surface has a mean probability of {fit[()]:.2f}, and of {fit[best]:.2f} if the axes {best} "
            "of the result are reversed"
        )

    def test_boxes_of_one_size_are_different(self) -> None:
        """A box gives the same result after another box of the same size."""
        seen, clip = self._seen()
        used = self.fresh()
        with skips_errors():
            alone = _estimated(self.fresh(), seeded(0), seen, clip)
            _estimated(used, seeded(0), [_mirrored(one) for one in seen], clip)
            after = _estimated(used, seeded(0), seen, clip)
        assert all(map(same, map(np.asarray, alone), map(np.asarray, after))), (
            "after other boxes of the same sizes, the results are others: it keeps results, by the size of a box?"
        )

    def test_objects_do_not_depend_on_others(self) -> None:
        """The result for an object depends neither on other objects nor on the order of the objects."""
        seen, clip = self._seen()
        every, last = self._filled(seen, clip), self._filled(seen[-1:], clip, len(seen) - 1)
        assert same(np.asarray(every[-1]), np.asarray(last[0])), (
            "an object is completed differently without the others"
        )


def _correct(inputs: dict[str, Any]) -> Hypothesis:
    """The hypothesis with the largest number of objects."""
    return max(inputs["population"].particles, key=lambda h: h.n_objects)


def _on_surface(filled: list[np.ndarray], seen: list[ObservedBox], axes: tuple[int, ...]) -> float:
    """Mean probability of the visible surface, with some axes of the probabilities reversed."""
    return float(np.mean([np.flip(p, axes)[one.surface].mean() for p, one in zip(filled, seen, strict=True)]))


def _boxes(completer: Completer, hypothesis: Hypothesis, clip: Clip, cut: bool = False) -> list[ObservedBox]:
    """The boxes of the objects of a hypothesis in the first frame. With `cut`, half of each mask is removed."""
    image, _ = render_hypothesis(hypothesis, clip.before.camera)
    masks = [image == k for k in np.unique(image[image > 0])]
    if cut:
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        masks = [mask & (u - v < (u - v)[mask].mean()) for mask in masks]
    return [observed_box(clip.before, mask, clip.grid, completer)[1] for mask in masks]


def _estimated(
    completer: Completer, rng: np.random.Generator, seen: list[ObservedBox], clip: Clip, first: int = 0
) -> list[np.ndarray]:
    """The estimated probabilities in the boxes. Box k uses the random stream `first` + k."""
    bound = completer.at(clip)
    with _quiet():
        return bound.estimate([child(rng, "box", first + k) for k in range(len(seen))], seen)


#: Fields of `ObservedBox` with a value for each voxel.
_IMAGES = [f.name for f in fields(ObservedBox) if f.name not in ("height", "latest")]


def _mirrored(box: ObservedBox) -> ObservedBox:
    """The box with its first axis reversed."""
    return replace(box, **{name: getattr(box, name)[::-1] for name in _IMAGES})


def _cropped(box: ObservedBox, a: int, b: int, c: int) -> ObservedBox:
    """The first ``a x b x c`` voxels of a box."""
    parts = {name: getattr(box, name)[:a, :b, :c] for name in _IMAGES}
    return ObservedBox(**parts, height=box.height[:c])


class MotionRuleContract(StageContract):
    """The contract of every `MotionRule`."""

    def call(self, component: Any, rng: np.random.Generator, inputs: dict[str, Any]) -> list[Any]:
        """Kind, motion, support and score of all candidate motions and of the chosen motion of each object."""
        found = []
        for label, track in _tracks(inputs):
            with _quiet():
                candidates = component.candidates(child(rng, "segment", label), track)
            chosen = component.choose(child(rng, "choice", label), candidates)
            found += [(c.kind, c.T.as_matrix(), c.support, c.score) for c in (*candidates, chosen)]
        return found

    def test_motions_stay_in_the_workspace(self) -> None:
        """No candidate moves an object farther than the workspace is wide."""
        component, rng = self.make(), seeded(0)
        for label, track in _tracks(self.inputs(1)):
            with skips_errors(), _quiet():
                candidates = component.candidates(child(rng, "segment", label), track)
            fault = fault_of_motions(candidates, track)
            assert fault is None, f"{type(component).__name__}.candidates {fault}"

    def test_motions_are_those_of_the_objects(self) -> None:
        """In two clips with known motions, a motion is not worse than rest, and the choice is by the score."""
        component, rng = self.make(), seeded(0)
        for known in known_motions():
            voxel, found, sizes = known.clip.grid.voxel_size, {}, {}
            for label, track in _known_tracks(known):
                self.check_time()
                with skips_errors(), _quiet():
                    candidates = component.candidates(child(rng, "segment", label), track)
                    chosen = [component.choose(child(rng, "choice", label, k), candidates) for k in range(16)]
                found[label] = self._compare(known, label, track.points, candidates, chosen, voxel)
                sizes[label] = max(
                    (_distance(c.T.apply(track.points), track.points) for c in candidates), default=0.0
                )
            # Rules that follow the images move the boxes that rest much less. Others, as random ones, move all alike.
            follows = max(size for label, size in sizes.items() if label != 1) < 0.1 * sizes[1]
            turned = known.motions[1].rotation.magnitude() > 0  # which a rule for shifts does not follow
            assert turned or not follows or found[1].min() <= 0.9 * voxel, (
                f"no candidate for a box that moves by 4 cm comes nearer than {100 * found[1].min():.1f} cm: is the "
                "unit metres, and the motion the whole one from the first frame to the last?"
            )

    @staticmethod
    def _compare(
        known: KnownMotion, label: int, points: np.ndarray, candidates: Any, chosen: list[Any], voxel: float
    ) -> np.ndarray:
        """Compare candidates and choices for an object with its motion. Returns errors of candidates in metres."""
        true = known.motions[label].apply(points)
        rest = _distance(points, true)
        errors, choices = (
            np.array([_distance(one.T.apply(points), true) for one in several]) for several in (candidates, chosen)
        )
        what = "a box that rests" if rest == 0 else f"a box whose points move by {100 * rest:.1f} cm"
        assert choices.mean() <= rest + 0.6 * voxel, (
            f"{what} ends {100 * choices.mean():.1f} cm from its place: T maps world points of the first frame to "
            "the last, in metres; a rotation about c is T(x) = R (x - c) + c"
        )
        scores = np.array([one.score for one in candidates])
        best = int(np.argmin(scores))
        clear = (np.delete(scores, best) > scores[best] + 1e-9).all() and errors[best] < 0.5 * voxel
        assert not clear or choices.min() < voxel, (
            f"for {what}, `choose` takes a candidate that errs by {100 * choices.min():.1f} cm; the one of the best "
            f"score, {scores[best]:.3g}, errs by {100 * errors[best]:.1f} cm: lower scores are better"
        )
        return errors


class ShapeKindContract(StageContract):
    """The contract of every `ShapeKind`."""

    def test_distance_is_metric(self) -> None:
        """Far outside, distances are positive and no larger than to the box's centre; some place is inside."""
        kind, rng = self.make(), seeded(0)
        half = rng.uniform(0.02, 0.1, (3, 40)).astype(np.float32)
        if kind.round:
            half[1] = half[0]
        shape = rng.random((kind.n_shape, 40), dtype=np.float32)
        ray = rng.standard_normal((3, 50, 40)).astype(np.float32)
        ray *= 0.5 / np.linalg.norm(ray, axis=0)
        with skips_errors():
            away = kind.distance(half, shape, ray)
            within = kind.distance(half, shape, rng.uniform(-1, 1, (3, 500, 40)).astype(np.float32) * half[:, None])
        assert np.shape(away) == (50, 40), f"the distances have shape {np.shape(away)}, expected (50, 40)"
        assert np.isfinite(away).all() and np.isfinite(within).all(), "some distances are not finite"
        assert (away > 0).all() and (away <= 0.55).all(), (
            f"50 cm from the centres of small boxes, the distances are {away.min():.2g} to {away.max():.2g} m"
        )
        assert (within < 0).any(axis=0).all(), "a shape contains none of 500 points of its box"

    def test_log_weights_are_numbers(self) -> None:
        """`log_weight` returns a finite number for each candidate."""
        kind, rng = self.make(), seeded(0)
        half, shape = rng.uniform(0.002, 0.2, (3, 40)), rng.random((kind.n_shape, 40))
        with skips_errors():
            found = np.asarray(kind.log_weight(half.astype(np.float32), shape.astype(np.float32)))
        assert found.shape == (40,), f"the log weights have shape {found.shape}, expected (40,)"
        assert np.isfinite(found).all(), "some log weights are not finite: use -1e4 for what cannot be"


class RegistrationContract(StageContract):
    """The contract of every `Registration`."""

    def test_motion_is_from_source_to_target(self) -> None:
        """Two surfaces of a box before and after a known motion are not farther apart after the registration."""
        for known in known_motions():
            track = dict(_known_tracks(known))[1]
            points = track.points
            source, target = prepare(points), prepare(known.motions[1].apply(points))
            assert source is not None and target is not None
            with skips_errors(), _quiet():
                found = self.make().register(source, target, np.eye(4), 2 * known.clip.grid.voxel_size)
            if found is None:
                continue
            true = known.motions[1].apply(points)
            error, rest = (_distance(x, true) for x in (move_points(found.T, points), points))
            assert error <= 1.1 * rest, (
                f"the source is {100 * rest:.1f} cm from its place before the registration, and {100 * error:.1f} cm "
                "after it: T moves the source to the target, in metres"
            )


class MaskTrackerContract(StageContract):
    """The contract of every `MaskTracker`."""

    def test_masks_follow_the_objects(self) -> None:
        """In two clips with known motions, a tracked mask covers its object no worse than the mask at the start."""
        for known in known_motions():
            first, last = _images(known)
            labels = list(known.motions)
            with skips_errors(), _quiet():
                found = self.make().track(known.clip, [first == label for label in labels])
            for label, mask in zip(labels, found, strict=True):
                if mask.any():  # an empty one says that the object is lost
                    covered, rest = (_overlap(one, last == label) for one in (mask, first == label))
                    assert covered >= 0.6 * rest, (
                        f"a mask covers its object by {covered:.2f} (Jaccard index), and by {rest:.2f} if it stays"
                    )


class BoundaryModelContract(StageContract):
    """The contract of every `BoundaryModel`."""

    def test_boundaries_are_between_objects(self) -> None:
        """Boundaries of objects are not weaker than the inside of objects."""
        known = known_motions()[0]
        first, _ = _images(known)
        edge = ndimage.maximum_filter(first, 3) != ndimage.minimum_filter(first, 3)
        inside = ndimage.minimum_filter(first, 9) == ndimage.maximum_filter(first, 9)
        with skips_errors(), _quiet():
            found = np.asarray(self.make().boundary(known.clip.before))
        strong, weak = float(found[edge].mean()), float(found[inside & (first > 0)].mean())
        assert strong >= weak, (
            f"pixels between objects have a mean strength of {strong:.2f}, pixels inside objects {weak:.2f}: 1 is a "
            "boundary, 0 is none"
        )


class ProjectionContract(StageContract):
    """The contract of every `Projection`."""

    def test_right_hypotheses_stay(self) -> None:
        """A hypothesis that agrees with the image keeps most of its voxels, hidden ones too."""
        known = known_motions()[0]
        with skips_errors(), _quiet():
            found, _ = self.make().project(known.before, known.clip.before)
        kept = float((found.labels > 0).sum() / (known.before.labels > 0).sum())
        assert kept >= 0.5, f"a right hypothesis keeps {kept:.2f} of its voxels: voxels behind a surface are not free"


def _known_tracks(known: KnownMotion) -> list[tuple[int, Track]]:
    """Label and track of the boxes of a clip with known motions."""
    flow = DenseFlow().track(known.clip)
    segments = segments_of(known.before, known.clip.before)
    return [(label, Track(segments[label], known.clip, flow)) for label in known.motions]


def _images(known: KnownMotion) -> tuple[np.ndarray, np.ndarray]:
    """Label images of the first and the last frame of a clip with known motions."""
    first, last = (render_hypothesis(one, known.clip.before.camera)[0] for one in (known.before, known.after))
    return first, last


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square distance of points (N, 3) from other points."""
    return float(np.sqrt(((a - b) ** 2).sum(axis=1).mean()))


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Jaccard index of two masks."""
    return float((a & b).sum() / max(1, (a | b).sum()))


def _tracks(inputs: dict[str, Any]) -> list[tuple[int, Track]]:
    """Label and track of each visible object of a hypothesis in the clip."""
    clip = inputs["observation"]
    flow = DenseFlow().track(clip)
    segments = segments_of(_correct(inputs), clip.before)
    return [(label, Track(one, clip, flow)) for label, one in segments.items() if len(one.support)]
