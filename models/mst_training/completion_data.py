"""Samples for the completion network: what a camera sees of an object, and the space that the object fills.

>>> samples = CompletionSamples.of_scene(seed=0, index=3)          # always the same

A scene has 2 to 12 objects, side by side, stacked, leaning and hidden, at rest under physics: shapes of the kinds in
`mst_training.shapes`, and household meshes if there is a folder of them. Some scenes have a wall. In some, several
objects are alike and touch. A scene is seen by three cameras, each with the noise of one of the simulated sensors and
a small error of its pose. The masks are those that a filter meets: the true masks with displaced borders, and the
segments of sampled cuts of the segmentation tree, which also hold parts of objects, and several objects. Half of the
samples also have one to three earlier views of the whole object (`mstfilter.mst.completion.observed.recall`), like an
object that was moved: from other cameras, with a small error of the motion since then, and some of them without some
other objects.

The true shape of a mask: each object with visible pixels in the mask contributes the voxels whose nearest visible
point lies in the mask or within two pixels of it. So a whole object gets all its voxels, also where the border of its
mask is displaced, the masks of two halves share them, and a mask of two objects gets both. Thin walls are defined as
in `mstfilter.lab.simulation.shapes`, for generated shapes and meshes alike.

Objects that do not fit a crop of 32 voxels are cut off. `LargeSamples` has such objects whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from mst_training.scenes import (
    HEIGHT,
    WIDTH,
    Clutter,
    Samples,
    View,
    cast,
    displaced,
    draw_camera,
    on_table,
    put_away,
)
from mst_training.shapes import THIN
from mstfilter.lab.simulation.sensor import SENSORS, DepthSensor
from mstfilter.lab.simulation.shapes import label_voxels
from mstfilter.lab.simulation.world import MESH_GROUP, OBJECT_GROUP, PhysicsWorld
from mstfilter.mst.completion import Completer, Extrude, ObservedBox, Posterior, observed_box
from mstfilter.mst.completion.crops import EDGE, LARGER, LATTICE, crop_box
from mstfilter.mst.completion.observed import decode_signed, encode_box, observed_again
from mstfilter.mst.segmentation import MetropolisHastingsCuts, TreeCutProposal
from mstfilter.scene import Camera, Frame, ObjectView, Seen, VoxelGrid, scene_cache

_GRID = VoxelGrid(np.array([-0.45, -0.45, 0.0]), LATTICE, (90, 90, 40))
_N_VIEWS, _N_MASKS = 3, 14  # cameras of a scene, masks of a view
_SENSORS = ("xtion", "xtion", "xtion", "xtion", *SENSORS)
_EARLIER = 0.5  # share of views with earlier frames
_TAKEN_AWAY = 0.4  # share of earlier frames without some of the objects
_MOTION_ERROR = (0.003, 0.02)  # metres and radians, standard deviations: the error of a tracked motion
_PARENTS = 0.25  # share of the segments of a cut that are replaced by their parents
_LEAST_PIXELS = 20
_LEAST_SHARE = 0.1  # of the pixels of a mask, or of an object's visible pixels, below which an object counts as noise
_WHOLE = 0.8  # of an object's visible pixels that a mask of the whole object has
MASK_KINDS = ("whole", "part", "several")


@dataclass(frozen=True, eq=False)
class CompletionSamples(Samples):
    """Samples of one or of many scenes."""

    bits: np.ndarray  #: (n, e, e, e) uint8, flags of `Seen`; e is `edge`
    signed: np.ndarray  #: (n, e, e, e) int8
    prior: np.ndarray  #: (n, e, e, e) uint8, 255 times the mean occupancy of `Posterior`
    truth: np.ndarray  #: (n, e, e, e) bool
    kind: np.ndarray  #: (n,) str, kind of the shape with most pixels in the mask
    mask: np.ndarray  #: (n,) uint8, index in `MASK_KINDS`
    scene: np.ndarray  #: (n,) int32, number of the scene
    visible: np.ndarray  #: (n,) float32, visible share of the object's silhouette (0 hidden, 1 nothing in front)

    edge: ClassVar[int] = EDGE  #: voxels of a crop
    smallest: ClassVar[int] = 0  #: voxels; masks of which a crop of this size shows all are left out
    clutter = Clutter(sizes=(1.0, 1.8), walls=0.2, alike=0.15)

    @classmethod
    def of_world(cls, rng: np.random.Generator, world: PhysicsWorld, index: int) -> Self | None:
        thin = [k for k, shape in enumerate(world.shapes) if shape.family in THIN]
        truth = label_voxels(world.shapes, world.poses(), _GRID, thin)
        parts = [part for _ in range(_N_VIEWS) if (part := cls._of_view(rng, world, truth, index)) is not None]
        return cls.join(parts) if parts else None

    @classmethod
    def _of_view(cls, rng: np.random.Generator, world: PhysicsWorld, truth: np.ndarray, index: int) -> Self | None:
        """The samples of one camera; None if there are none."""
        poses = world.poses()
        inside = on_table(poses)
        if not inside.any():
            return None
        sensor = SENSORS[str(rng.choice(_SENSORS))]
        camera = _camera(rng, poses[inside], sensor)
        frame, instance = _frame(rng, world, camera, sensor)
        earlier = _earlier_frames(rng, world, sensor)
        alone = _silhouettes(world, camera, instance)
        rows = []
        for mask in draw_masks(rng, frame, instance, _GRID, _N_MASKS):
            found = _sample(rng, frame, instance, mask, truth, earlier, (cls.smallest, cls.edge))
            if found is not None:
                which, (bits, signed, prior, shape), k = found
                rows.append((bits, signed, prior, shape, world.shapes[k - 1].family, which, alone[k]))
        if not rows:
            return None
        columns = [np.array(column) for column in zip(*rows, strict=True)]
        bits, signed, priors, shapes, kinds, masks, visible = columns
        scene = np.full(len(bits), index, np.int32)
        return cls(bits, signed, priors, shapes, kinds, masks.astype(np.uint8), scene, visible.astype(np.float32))

    def box(self, k: int) -> ObservedBox:
        """What sample k shows, as a completer sees it."""
        own, other, free, behind, hidden = (flag.among(self.bits[k]) for flag in Seen)
        height = (np.arange(self.edge) + 0.5) * LATTICE
        return ObservedBox(
            own.astype(np.int32), own, other, free, behind, hidden, decode_signed(self.signed[k]), height
        )


class LargeSamples(CompletionSamples):
    """Samples of objects that are larger than a crop of 32 voxels."""

    edge = LARGER[-1]
    smallest = EDGE
    clutter = replace(CompletionSamples.clutter, sizes=(1.5, 3.0))


def _camera(rng: np.random.Generator, poses: np.ndarray, sensor: DepthSensor) -> Camera:
    """Draw a camera that looks at objects with poses (n, 4, 4). Half of the cameras are lower or farther away."""
    elevation, distance = ((22, 68), (0.55, 1.05)) if rng.random() < 0.5 else ((10, 45), (0.6, 1.6))
    return draw_camera(rng, poses[:, :2, 3].mean(axis=0), elevation, distance, sensor.focal / 525.0)


class _Earlier(NamedTuple):
    """A frame, its true instances (H, W), and the objects that were taken away."""

    frame: Frame
    instance: np.ndarray
    gone: frozenset[int]


def _earlier_frames(rng: np.random.Generator, world: PhysicsWorld, sensor: DepthSensor) -> list[_Earlier]:
    """Up to three frames of other cameras; for some, objects were taken away."""
    state, poses, found = world.save(), world.poses(), []
    inside = np.flatnonzero(on_table(poses))
    for _ in range(int(rng.integers(1, 4)) if rng.random() < _EARLIER else 0):
        camera = _camera(rng, poses[inside], sensor)
        gone = inside[rng.random(len(inside)) < 0.5] if rng.random() < _TAKEN_AWAY else inside[:0]
        for k in gone.tolist():
            put_away(world, k)
        world.forward()
        found.append(_Earlier(*_frame(rng, world, camera, sensor), frozenset((gone + 1).tolist())))
        world.restore(state)
    return found


def _frame(
    rng: np.random.Generator, world: PhysicsWorld, camera: Camera, sensor: DepthSensor
) -> tuple[Frame, np.ndarray]:
    """An image with noise, with a small error of the camera's pose, and the true instances (H, W)."""
    view = View.of(world, camera)
    sensor = replace(sensor, edge_dropout=float(rng.uniform(0.05, 0.2)))
    # One colour an object, with shading: the tree sees edges of colour and of depth.
    albedo = rng.uniform(0.1, 0.9, (256, 3))[view.instance.ravel()]
    reading = sensor.read(rng, view.depth, view.slant, albedo.mean(axis=1).reshape(HEIGHT, WIDTH))
    light = 0.45 + 0.5 * np.clip(view.normal @ np.array([0.3, -0.4, 0.87]), 0, 1)
    rgb = albedo * light[:, None] + rng.normal(0.0, 0.02, (len(light), 3))
    image = np.clip(255 * rgb, 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
    return Frame(image, reading, displaced(rng, camera)), view.instance


def _silhouettes(world: PhysicsWorld, camera: Camera, instance: np.ndarray) -> dict[int, float]:
    """Object -> visible share of its silhouette."""
    seen = np.bincount(instance.ravel(), minlength=world.n_objects + 1)
    state, shares = world.save(), {}
    positions, rotations = world.positions(), world.rotations()
    for k in np.flatnonzero(seen[1:] >= _LEAST_PIXELS).tolist():
        for other in range(world.n_objects):
            if other != k:
                put_away(world, other)
        world.place(k, positions[k], rotations[k])
        world.forward()
        geom, _, _ = cast(world, camera, (OBJECT_GROUP, MESH_GROUP))
        shares[k + 1] = float(seen[k + 1] / max((geom >= 0).sum(), 1))
        world.restore(state)
    return shares


def draw_masks(
    rng: np.random.Generator, frame: Frame, instance: np.ndarray, grid: VoxelGrid, n: int
) -> list[np.ndarray]:
    """At most `n` masks (H, W): a third true ones with displaced borders, the others segments of sampled cuts."""
    import cv2

    true = []
    for k in np.unique(instance[instance > 0]):
        mask = (instance == k).astype(np.uint8)
        change = int(rng.integers(-1, 2))
        if change:
            mask = (cv2.dilate if change > 0 else cv2.erode)(mask, np.ones((3, 3), np.uint8))
        true.append(mask > 0)
    proposal = TreeCutProposal()
    tree, w = proposal.tree_of(frame, grid)
    segments = proposal.objects.segments(tree, frame, grid)
    sampler = MetropolisHastingsCuts(temperature=float(rng.choice([1.0, 4.0])), burn_in=300, thinning=100)
    cuts = sampler.sample(rng, tree, w, 3).cuts
    nodes = np.unique(np.concatenate([cut[segments.is_object[cut]] for cut in cuts]))
    # Some parents, so that there are enough masks of several objects.
    parents = tree.parent[nodes]
    up = (rng.random(len(nodes)) < _PARENTS) & segments.is_object[parents] & (parents != tree.root)
    nodes = np.unique(np.where(up, parents, nodes))
    drawn = [tree.mask(int(node)) & segments.object_pixels for node in rng.permutation(nodes)]
    scene_cache.clear()
    n_true = min(len(true), n // 3)
    chosen = [true[k] for k in rng.permutation(len(true))[:n_true]]
    return chosen + drawn[: n - n_true]


def _sample(
    rng: np.random.Generator,
    frame: Frame,
    instance: np.ndarray,
    mask: np.ndarray,
    truth: np.ndarray,
    earlier: Sequence[_Earlier],
    edges: tuple[int, int] = (0, EDGE),
) -> tuple[int, tuple[np.ndarray, ...], int] | None:
    """Kind of mask; bits, distances, prior and true shape; and main object of one mask.

    None if it shows no object, or none that is larger than the first of `edges`; the second is that of the crop.
    """
    counts = np.bincount(instance[mask & frame.valid], minlength=256)
    whole = np.bincount(instance[frame.valid], minlength=256)
    counts[0] = 0
    found = [k for k in np.flatnonzero(counts).tolist() if counts[k] >= _LEAST_SHARE * max(counts.sum(), whole[k])]
    main = int(counts.argmax())
    if counts[main] < _LEAST_PIXELS or main not in found:
        return None
    smallest, edge = edges
    rule = _Crop(edge=edge)
    whole_mask = all(counts[k] > _WHOLE * whole[k] for k in found)
    views = [_view(rng, rule, one, found) for one in earlier] if whole_mask else []
    known = [view for view in views if view is not None]
    offset, now, seen, _ = observed_again(frame, mask, known, _GRID, rule, refute=False)
    if not now.surface.any() or max(seen.surface.shape) <= smallest:
        return None
    box = tuple(slice(int(o), int(o) + n) for o, n in zip(offset, seen.surface.shape, strict=True))
    shape, near = np.zeros(seen.surface.shape, bool), ndimage.binary_dilation(mask, np.ones((3, 3)), 2)
    for k in found:
        shape |= claimed_voxels(frame, instance == k, near, truth[box] == k, _GRID, offset)
    index = 2 if len(found) > 1 else int(counts[main] < _WHOLE * whole[main])
    prior = np.rint(255 * Posterior().fill(rng, seen)).astype(np.uint8)
    return index, tuple(_padded(one, edge) for one in (*encode_box(seen), prior, shape)), main


@dataclass(frozen=True)
class _Crop(Extrude):
    """The crop of the network, with the rules of a completer."""

    edge: int = EDGE  #: voxels, the largest crop

    def box(self, voxels: np.ndarray, grid: VoxelGrid) -> tuple[np.ndarray, np.ndarray]:
        low, high = crop_box(voxels, grid)
        if (high - low).max() > self.edge:  # a larger object is cut off in training
            middle = (low + high) // 2
            low = np.maximum(np.append(middle[:2] - self.edge // 2, 0), 0)
            high = np.minimum(low + self.edge, grid.shape)
        return low, high


def _padded(values: np.ndarray, edge: int) -> np.ndarray:
    full = np.zeros((edge,) * 3, values.dtype)
    a, b, c = values.shape
    full[:a, :b, :c] = values
    return full


def _view(rng: np.random.Generator, rule: Completer, earlier: _Earlier, found: Sequence[int]) -> ObjectView | None:
    """A view of the objects `found`, with an error of their motion since then; None if not all of them are there."""
    mask = np.isin(earlier.instance, found)
    offset, seen = observed_box(earlier.frame, mask, _GRID, rule)
    few = (mask & earlier.frame.valid).sum() < _LEAST_PIXELS
    if few or not seen.surface.any() or earlier.gone.intersection(found):
        return None
    turn = Rotation.from_rotvec(rng.normal(0.0, _MOTION_ERROR[1], 3))
    centre = _GRID.centre_of(np.argwhere(seen.surface) + offset).mean(axis=0)
    shift = centre - turn.apply(centre) + rng.normal(0.0, _MOTION_ERROR[0], 3)
    return ObjectView(offset, *encode_box(seen), "", RigidTransform.from_components(shift, turn))


def claimed_voxels(
    frame: Frame, visible: np.ndarray, mask: np.ndarray, truth: np.ndarray, grid: VoxelGrid, offset: np.ndarray
) -> np.ndarray:
    """The voxels of an object, (a, b, c) bool in the box at `offset`, whose nearest visible point is in the mask."""
    pixels = np.flatnonzero(visible & frame.valid)
    inside = mask.ravel()[pixels]
    if inside.mean() > 0.95:
        return truth
    points = frame.points.reshape(-1, 3)[pixels]
    voxels = np.argwhere(truth)
    _, nearest = cKDTree(points).query(grid.centre_of(voxels + offset))
    claimed = np.zeros_like(truth)
    claimed[tuple(voxels[inside[nearest]].T)] = True
    return claimed
