"""Samples for the judge of seams: divisions of regions in simulated images, and which of them separate objects.

>>> samples = SeamSamples.of_scene(seed=0, index=3)             # always the same
>>> samples.x.shape, samples.strip.shape, samples.purity

More than half of the scenes ask the question: in `row`, `stack` and `pack`, things that look like several objects are
one as often as not. They have two to four groups each. The others are `s1` to `s3` and, if the clutter names a
folder of meshes, `m1` and `m2`. Cameras and sensors are drawn at random, sizes and textures are those for tuning. The
regions are those that `SeamTree` examines in the tree `border`, and below those of several objects the sides of the
best division. Some of the regions that plainly are one object are left out.

Real images with label images give samples in the same way:

>>> SeamSamples.of_frame(frame, grid, labels).save("my-images/desk.npz")  # `SeamsTraining(extra="my-images")`
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from mst_training.scenes import Clutter, Samples, displaced
from mstfilter.base.errors import InputError
from mstfilter.lab.simulation import scene_family
from mstfilter.lab.simulation.recorder import POSE_TOLERANCE, SimulatedScene
from mstfilter.lab.simulation.renderer import Renderer
from mstfilter.lab.simulation.sensor import SENSORS, colour_reading
from mstfilter.mst.segmentation import BorderTree, ColourDepthBoundary, ObjectRule
from mstfilter.mst.segmentation.divisions import Division, SeamImage, divisions
from mstfilter.mst.segmentation.seam_measures import SeamMeasures
from mstfilter.mst.segmentation.seams import BaseTree, least_examined, within
from mstfilter.scene import Camera, Frame, VoxelGrid, look_at, scene_cache

_FAMILIES = {"row": 0.26, "stack": 0.22, "pack": 0.10, "s1": 0.12, "s2": 0.18, "s3": 0.12}
_MESHES = {"m1": 0.08, "m2": 0.08}  # in place of as large a share of the others
_GROUPED = ("row", "stack", "pack")
_OWN_CAMERA = 0.35  # share of the images that the camera of the family takes
_N_VIEWS = 2
_FIRST_SEED = 1_000_000  # of scenes; the studies use smaller ones
#: An object counts if so many of its pixels are in a region, and such a share of the region or of its own pixels.
_LEAST_PIXELS, _LEAST_SHARE, _LEAST_OWN = 120, 0.15, 0.4
_WHOLE = 0.7  # share of each object that must be on one side of a division that separates objects
_PLAIN = {True: 0.85, False: 0.65}  # share of the regions of one object that are used, in scenes with groups or not
_KNOWN = 0.7  # least share of the pixels of a region that must belong to objects
_MOST_DEPTH = 3
_PURE, _AT_RANDOM = 0.93, 0.15  # divisions of several objects that are followed: pure ones, this share of others


@dataclass(frozen=True, eq=False)
class SeamSamples(Samples):
    """Divisions of many regions, one after the other."""

    x: np.ndarray  #: (k, f) float32, `SeamMeasures.describe`
    strip: np.ndarray  #: (k, c, 64, 24) uint8
    #: (k,) float32, share of the pixels on the right side if each object is given to one side; 0 for a division that
    #: leaves all objects on one side
    purity: np.ndarray
    region: np.ndarray  #: (k,) int64, number of the region
    objects: np.ndarray  #: (k,) int32, number of objects of the region
    depth: np.ndarray  #: (k,) int32, number of divisions above the region
    grouped: np.ndarray  #: (k,) bool, whether the scene has groups

    @classmethod
    def of_scene(cls, seed: int, index: int, clutter: Clutter | None = None) -> Self:
        """The samples of scene number `index`; of `clutter`, only the meshes are used."""
        for attempt in range(20):
            rng = np.random.default_rng([seed, index, attempt])
            try:
                rows = [*_rows(rng, _FIRST_SEED * (1 + seed) + 20 * index + attempt, clutter or Clutter())]
            except InputError:  # the objects do not fit
                continue
            finally:
                scene_cache.clear()
            if rows:
                return cls._of_rows(rows, 1000 * index)
        raise InputError(f"no scene number {index} could be made")

    @classmethod
    def of_frame(
        cls, frame: Frame, grid: VoxelGrid, labels: np.ndarray, index: int = 0, tree: BorderTree | None = None
    ) -> Self:
        """The samples of image number `index` with the true object (H, W) int of each pixel.

        Objects are 1 .. 255; pixels without a known object have a label below 1. The regions are those of `tree`,
        by default of `BorderTree()`. InputError if the image shows no table, or no region that is examined.
        """
        if labels.shape != frame.depth.shape or labels.max() > 255:
            raise InputError(
                f"labels {labels.shape} up to {labels.max()}", f"expected {frame.depth.shape} and at most 255 objects"
            )
        rng = np.random.default_rng(index)
        if not (rows := [*_regions(rng, frame, grid, np.maximum(labels, 0), False, tree or BorderTree())]):
            raise InputError("the image shows no region that is examined")
        return cls._of_rows(rows, 1000 * index)

    @classmethod
    def _of_rows(cls, rows: list[_Row], first: int) -> Self:
        """Samples of regions that are numbered from `first` on."""
        numbered = [
            (*row[:3], np.full(len(row[0]), first + k), *(np.full(len(row[0]), v) for v in row[3:]))
            for k, row in enumerate(rows)
        ]
        return cls(*(np.concatenate(column) for column in zip(*numbered, strict=True)))


_Row = tuple[np.ndarray, np.ndarray, np.ndarray, int, int, bool]


def _rows(rng: np.random.Generator, seed: int, clutter: Clutter) -> Iterator[_Row]:
    """The regions of some images of a scene."""
    shares = _FAMILIES | (_MESHES if clutter.objects else {})
    p = np.array([*shares.values()])
    name = str(rng.choice([*shares], p=p / p.sum()))
    sensor: Any = str(rng.choice(["xtion", "xtion", "xtion", *SENSORS]))
    family = replace(scene_family(name), n_actions=0, catalogue="tuning", sensor=sensor, arm=False, one_share=0.5)
    if name in _GROUPED:
        n = int(rng.integers(2, 5))
        family = replace(family, n_groups=n, n_objects_min=n + 1, n_objects_max=n + 2)
    elif name in _MESHES:
        family = replace(family, objects=clutter.objects, mesh_pool=clutter.pool)
    scene, tree = SimulatedScene(family, seed), BorderTree()
    for _ in range(_N_VIEWS):
        camera = family.camera() if rng.uniform() < _OWN_CAMERA else _camera(rng, scene)
        view = Renderer(scene.world, scene.objects.skins, scene.room, camera, True, POSE_TOLERANCE).render()
        materials = (view.reflectance, view.shine) if scene.sensor.sees_materials else ()
        depth = scene.sensor.read(rng, view.depth, view.slant, *materials)
        rgb = colour_reading(rng, view.colour * scene.room.exposure)
        measured = displaced(rng, camera) if rng.uniform() < 0.6 else camera
        try:
            yield from _regions(rng, Frame(rgb, depth, measured), scene.grid, view.instance, name in _GROUPED, tree)
        except InputError:  # the view shows no table
            continue


def _camera(rng: np.random.Generator, scene: SimulatedScene) -> Camera:
    at = scene.world.poses()[:, :3, 3]
    inside = (np.abs(at[:, :2]) < 0.45).all(axis=1) & (at[:, 2] > 0)
    target = np.append(at[inside, :2].mean(axis=0), 0.05) + rng.normal(0.0, 0.03, 3)
    azimuth, raised, far = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(18, 65)), rng.uniform(0.55, 1.1)
    away = np.array([np.cos(raised) * np.cos(azimuth), np.cos(raised) * np.sin(azimuth), np.sin(raised)])
    focal = scene.sensor.focal
    return Camera.from_intrinsics(focal, focal, 319.5, 239.5, 640, 480, look_at(target + far * away, target))


def _regions(
    rng: np.random.Generator,
    frame: Frame,
    grid: VoxelGrid,
    instance: np.ndarray,
    grouped: bool,
    tree: BorderTree,
) -> Iterator[_Row]:
    """The regions of one image with their divisions."""
    found = ObjectRule().foreground(frame, grid)
    boundary = ColourDepthBoundary().boundary(found.frame)
    seen = tree.look(found.frame)
    regions = tree.regions(boundary, found.frame, found.pixels, seen)
    base = BaseTree(regions.image, len(regions.sums), tree.merges(regions))
    image = SeamImage.of(found.frame, boundary, seen)
    measures = SeamMeasures.of(image, regions.image > 0)
    flat = instance.ravel()
    visible = np.bincount(flat[regions.image.ravel() > 0], minlength=256)
    clear = base.clear()
    for node in [*clear, *base.uncertain()]:
        todo = [(*base.region(node), 0)]
        while todo:
            pixels, parts, depth = todo.pop()
            if len(pixels) < least_examined(flat.size) or not (divided := divisions(image, pixels, parts)):
                continue
            purity, n = _purity(flat[pixels], divided, visible)
            if (flat[pixels] > 0).mean() < _KNOWN:
                continue
            if n == 0 or (n == 1 and depth == 0 and rng.uniform() > _PLAIN[grouped]):
                continue
            yield (*measures.describe(pixels, divided, depth > 0), purity, n, depth, grouped)
            if depth < _MOST_DEPTH and node not in clear:
                best = int(purity.argmax())
                if n > 1 and purity[best] > _PURE:
                    side = divided[best].side
                elif n > 1 and rng.uniform() < _AT_RANDOM:
                    side = divided[int(rng.integers(len(divided)))].side
                else:
                    continue
                todo += [(pixels[one], within(parts, one), depth + 1) for one in (side, ~side)]


def _purity(instance: np.ndarray, divided: list[Division], visible: np.ndarray) -> tuple[np.ndarray, int]:
    """`SeamSamples.purity` (k,) of divisions of a region with these objects (n,), and the number of its objects.

    `visible` has the number of pixels of each object in the image.
    """
    sizes = np.bincount(instance, minlength=256)
    sizes[0] = 0
    enough = (sizes > _LEAST_SHARE * sizes.sum()) | (sizes > _LEAST_OWN * visible)
    large = np.flatnonzero((sizes > _LEAST_PIXELS) & enough)
    purity = np.zeros(len(divided), np.float32)
    for k, division in enumerate(divided):
        first = np.array([division.side[instance == one].mean() for one in large])
        share = np.maximum(first, 1 - first)
        if len(large) > 1 and 0 < (first > 0.5).sum() < len(large) and share.min() > _WHOLE:
            purity[k] = share @ sizes[large] / sizes[large].sum()
    return purity, len(large)
