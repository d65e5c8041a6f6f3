"""Samples for the border network: images of clutter, the object of every pixel, and the centres of the objects.

>>> samples = BorderSamples.of_scene(seed=0, index=3)           # always the same
>>> border, foreground, offset = targets(samples.instance[0], samples.centre[0])

The scenes are those of the completion samples (`mst_training.scenes`), seen by cameras of many elevations,
distances and focal lengths. Networks of depth transfer from simulated to real images better than networks of colour
(C. Xie, Y. Xiang, A. Mousavian, D. Fox, "Unseen object instance segmentation for robotic environments", 2021). So
colours are random: patterns that turn with the object, random lamps and shadows, images in which all surfaces have
one pattern, and images without colour. Depth has the noise of the simulated sensor with random strength, warped
disparity, flying pixels between foreground and background, and holes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from mst_training.scenes import HEIGHT, WIDTH, Samples, View, displaced, draw_camera, on_table
from mstfilter.base.errors import InputError
from mstfilter.lab.simulation.sensor import DepthSensor, colour_reading
from mstfilter.lab.simulation.world import OBJECT_GROUP, PIECE_GROUP, ROOM_GROUP, PhysicsWorld
from mstfilter.mst.segmentation.border_network import CENTRE_UNIT
from mstfilter.scene import Camera, Frame, fit_support_plane, rigid_from_matrix

_DEPTH_UNIT = 1e-4  # metres, of stored depth
_N_VIEWS = 6
_MOST_OBJECTS = 16
_LEAST_PIXELS = 40  # of an object in an image
_DISPARITY = 8.0 * 525.0 * 0.075  # sensor units (1/8 px) at one metre
_STEP = 0.02  # metres within 3 x 3 pixels from which flying pixels occur

Albedo = Callable[[np.random.Generator, np.ndarray], np.ndarray]  #: see `BorderSamples.albedo`


@dataclass(frozen=True, eq=False)
class BorderSamples(Samples):
    """Images of one or of many scenes."""

    depth: np.ndarray  #: (n, H, W) uint16, z-depth in 0.1 mm, 0 for no reading
    rgb: np.ndarray  #: (n, H, W, 3) uint8
    instance: np.ndarray  #: (n, H, W) uint8, object of every pixel, 0 for none
    centre: np.ndarray  #: (n, 17, 2) float32, column and row of the centre of object k in row k
    intrinsics: np.ndarray  #: (n, 3, 3)
    pose: np.ndarray  #: (n, 4, 4) T_world_camera: measured with a small error, or fitted to the table
    scene: np.ndarray  #: (n,) int32, number of the scene

    @classmethod
    def of_world(cls, rng: np.random.Generator, world: PhysicsWorld, index: int) -> Self | None:
        rows = [row for _ in range(_N_VIEWS) if (row := _view(rng, world, cls.albedo)) is not None]
        columns = [np.stack(column) for column in zip(*rows, strict=True)]
        return cls(*[*columns, np.full(len(rows), index, np.int32)]) if rows else None

    @staticmethod
    def albedo(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
        """Albedo (n, 3) of the points (n, 3) of a surface, in metres and in the axes of the surface's object."""
        return _pattern(rng, points)

    def frame(self, k: int) -> Frame:
        """Image k."""
        depth = np.where(self.depth[k] > 0, self.depth[k] * np.float32(_DEPTH_UNIT), np.nan).astype(np.float32)
        h, w = depth.shape
        return Frame(self.rgb[k], depth, Camera(self.intrinsics[k], w, h, rigid_from_matrix(self.pose[k])))


def targets(instance: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Border (H, W) bool, foreground (H, W) bool, offset (2, H, W) to the object's centre in `CENTRE_UNIT`.

    A pixel is at a border if one of its four neighbours is of another object. The offset is zero where there is no
    object.
    """
    border = np.zeros(instance.shape, bool)
    for here, there in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        differs = instance[here] != instance[there]
        border[here] |= differs
        border[there] |= differs
    rows, columns = np.indices(instance.shape, dtype=np.float32)
    offset = (centre[instance].transpose(2, 0, 1) - np.stack([columns, rows])) / CENTRE_UNIT
    return border, instance > 0, np.where(instance > 0, offset, 0).astype(np.float32)


def _view(rng: np.random.Generator, world: PhysicsWorld, albedo: Albedo) -> tuple[np.ndarray, ...] | None:
    """The arrays of one image; None if it shows no object."""
    poses = world.poses()
    inside = on_table(poses)
    if not inside.any():
        return None
    zoom = float(np.exp(rng.uniform(np.log(0.8), np.log(1.5))))
    camera = draw_camera(rng, poses[inside, :2, 3].mean(axis=0), (15, 80), (0.5, 1.3), zoom)
    view = View.of(world, camera)
    if np.bincount(view.instance.ravel())[1:].max(initial=0) < _LEAST_PIXELS:
        return None
    depth = _depth(rng, view)
    rgb = _colours(rng, world, poses, view, albedo)
    centre = np.zeros((_MOST_OBJECTS + 1, 2), np.float32)
    projected, _ = camera.project(poses[:, :3, 3])
    centre[1 : 1 + len(poses)] = np.nan_to_num(projected)
    measured = displaced(rng, camera)
    if rng.uniform() < 0.5:
        try:
            plane = fit_support_plane(Frame(rgb, depth, Camera(camera.K, WIDTH, HEIGHT)))
            measured = camera.at(plane.T_world_camera)
        except InputError:
            pass  # too little of the table is visible: the measured pose
    stored = np.rint(np.nan_to_num(depth) / _DEPTH_UNIT).astype(np.uint16)
    return stored, rgb, view.instance, centre, np.array(camera.K), measured.pose.as_matrix()


def _depth(rng: np.random.Generator, view: View) -> np.ndarray:
    """What a sensor of random quality reads (H, W), NaN for nothing."""
    sensor = DepthSensor(
        lateral=rng.uniform(0.2, 1.2), edge_dropout=rng.uniform(0.02, 0.35), fill=rng.uniform(0.0, 5.0)
    )
    if rng.uniform() < 0.5:  # the projector is on the other side
        reading = sensor.read(rng, view.depth[:, ::-1], view.slant[:, ::-1])[:, ::-1]
    else:
        reading = sensor.read(rng, view.depth, view.slant)
    reading = _flying(rng, reading)
    D = _DISPARITY / reading
    warp = cv2.resize(rng.normal(0.0, rng.uniform(0.0, 0.8), (6, 8)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    D = D + warp + rng.normal(0.0, rng.uniform(0.0, 0.6), D.shape)
    lost = np.zeros(D.shape, np.uint8)
    for _ in range(rng.poisson(3)):
        axes = rng.integers(2, 15, 2)
        at = int(rng.integers(WIDTH)), int(rng.integers(HEIGHT))
        cv2.ellipse(lost, (at, (int(axes[0]), int(axes[1])), float(rng.uniform(0, 180))), 1, -1)
    # Some objects are dark or shiny and lose readings in patches.
    dark = (rng.random(256) < 0.08) & (np.arange(256) > 0)
    coarse = cv2.resize(rng.random((60, 80)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    gone = (lost > 0) | (dark[view.instance] & (coarse < rng.uniform(0.2, 0.7)))
    return np.where(gone, np.nan, _DISPARITY / np.maximum(D, 1.0)).astype(np.float32)


def _flying(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Some readings at steps in depth are moved to between foreground and background."""
    square = np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(np.isfinite(depth), depth, np.float32(1e3)), square)
    far = cv2.dilate(np.where(np.isfinite(depth), depth, np.float32(0)), square)
    share = rng.uniform(0.0, 0.3)
    moved = np.isfinite(depth) & (far - near > _STEP) & (rng.random(depth.shape) < share)
    mix = rng.random(depth.shape)
    with np.errstate(divide="ignore"):
        between = 1 / (mix / near + (1 - mix) / far)
    return np.where(moved, between, depth).astype(np.float32)


def _colours(
    rng: np.random.Generator, world: PhysicsWorld, poses: np.ndarray, view: View, albedo_of: Albedo
) -> np.ndarray:
    """A colour image (H, W, 3) uint8 with random patterns, lamp and exposure."""
    kind = rng.uniform()
    if kind < 0.12:
        return np.full((HEIGHT, WIDTH, 3), rng.integers(30, 220), np.uint8)
    # The surfaces are the table, the floor, the walls and the objects.
    instance = view.instance.ravel().astype(int)
    surface = np.where(instance > 0, instance + 3, np.clip(view.geom, -1, 2) + 1)
    albedo = np.zeros((len(surface), 3))
    one_pattern = kind < 0.22
    state = rng.bit_generator.state
    for k in np.unique(surface):
        if one_pattern:
            rng.bit_generator.state = state
        pixels = surface == k
        local = view.points[pixels]
        if k > 3:
            turn, at = poses[k - 4, :3, :3], poses[k - 4, :3, 3]
            local = (local - at) @ turn
        albedo[pixels] = albedo_of(rng, local)
    direction = rng.normal(size=3) + np.array([0, 0, 1.5])
    direction /= np.linalg.norm(direction)
    direction[2] = abs(direction[2])
    ambient, strength = rng.uniform(0.15, 0.8), rng.uniform(0.2, 0.9)
    light = np.clip(view.normal @ direction, 0, 1)
    if rng.uniform() < 0.6 and direction[2] > 0.25:
        # One cast from the lamp: a point is lit if the ray to it meets nothing before.
        lamp = 3.0 * direction
        _, reach, _ = world.cast(lamp, view.points - lamp, (ROOM_GROUP, OBJECT_GROUP, PIECE_GROUP))
        light = light * ((reach < 0) | (reach > 0.995))
    tint = rng.uniform(0.7, 1.0, 3)
    linear = albedo * (ambient + strength * light[:, None] * tint) * np.exp(rng.normal(0.0, 0.35))
    return colour_reading(rng, linear.reshape(HEIGHT, WIDTH, 3).astype(np.float32))


def _pattern(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Albedo (n, 3) of points (n, 3) in metres: two or three random colours mixed by a random solid pattern."""
    first, second, third = rng.uniform(0.02, 0.95, (3, 3)) ** 1.5
    if rng.uniform() < 0.4:  # print and grain have related colours
        second = np.clip(first * rng.uniform(0.6, 1.4), 0, 1)
    wave = np.exp(rng.uniform(np.log(0.006), np.log(0.12)))  # metres
    axis = rng.normal(size=(3, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    along = points @ axis.T
    shift = rng.uniform(0, 1, 3)
    kind = int(rng.integers(6))
    noise = _solid_noise(rng, points / wave) if kind in (3, 4) or rng.uniform() < 0.3 else np.zeros(len(points))
    if kind == 0:
        mix = np.zeros(len(points))
    elif kind == 1:  # gradient
        mix = np.clip(0.5 + along[:, 0] / 0.15, 0, 1)
    elif kind == 2:  # stripes
        mix = (np.mod(along[:, 0] / wave + shift[0], 1) < rng.uniform(0.2, 0.8)).astype(np.float64)
    elif kind == 3:  # clouds
        mix = np.clip(0.5 + noise, 0, 1)
    elif kind == 4:  # blots with sharp edges, as of print
        mix = (noise > rng.uniform(-0.3, 0.3)).astype(np.float64)
    else:  # checks
        mix = np.mod(np.floor(along / wave + shift).sum(axis=1), 2)
    colour = first + mix[:, None] * (second - first)
    if rng.uniform() < 0.3:  # a patch of a third colour, as of a label
        colour = np.where((np.abs(along[:, 1] + shift[1] * 0.04) < rng.uniform(0.005, 0.04))[:, None], third, colour)
    return np.clip(colour * (1 + 0.3 * noise[:, None]), 0, 1)


def _solid_noise(rng: np.random.Generator, at: np.ndarray) -> np.ndarray:
    """Smooth noise (n,) of about -1 .. 1 at points (n, 3), with detail at distance 1."""
    from scipy.ndimage import map_coordinates

    lattice = rng.uniform(-1, 1, (16, 16, 16))
    total = np.zeros(len(at))
    for octave, weight in ((1.0, 0.7), (2.1, 0.4)):
        total += weight * map_coordinates(lattice, (at * octave).T, order=1, mode="grid-wrap")
    return total
