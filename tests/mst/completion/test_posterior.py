"""The posterior over whole shapes: shapes that are in the prior are found, and what is known is respected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mstfilter.base.errors import InputError
from mstfilter.mst.completion import (
    BoxKind,
    ConeKind,
    CylinderKind,
    DrawnShape,
    EllipsoidKind,
    Extrude,
    Pooled,
    Posterior,
    ShapeKind,
    SuperquadricKind,
    SurfaceOnly,
    TrayKind,
    TurnedKind,
    VesselKind,
)
from mstfilter.mst.completion.candidates import ShapeEvidence, shape_groups
from mstfilter.mst.completion.observed import ObservedBox, observed_box
from mstfilter.mst.completion.posterior import SHAPE_KINDS
from mstfilter.mst.testing.stages import ShapeKindContract
from mstfilter.scene import Frame, VoxelGrid
from tests.mst.completion.test_completion import masks_of
from tests.mst.segmentation.scenes import GRID, TWO, boxes, frame_of

ALL_KINDS = (
    *(BoxKind(), CylinderKind(), ConeKind(), TurnedKind()),
    *(EllipsoidKind(), SuperquadricKind(), VesselKind(), TrayKind()),
)
RNG = np.random.default_rng(0)
QUICK = Posterior(n=64)


@pytest.mark.parametrize("kind", ALL_KINDS, ids=lambda kind: type(kind).__name__)
def test_kinds_keep_their_contract(kind):
    contract = type("Contract", (ShapeKindContract,), {"make": staticmethod(lambda: kind)})
    contract().test_distance_is_metric()
    contract().test_log_weights_are_numbers()


def inside_of(kind: ShapeKind, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Whether points x (3, m) are inside one shape, by its equation."""
    a, b, c = np.abs(x) / half[:, None]
    r, z = np.hypot(x[0], x[1]) / half[0], x[2] / half[2]
    name = type(kind).__name__
    if name == "BoxKind":
        return (a < 1) & (b < 1) & (c < 1)
    if name == "CylinderKind":
        return (r < 1) & (c < 1)
    if name == "ConeKind":  # shape .25: the lower end has half of the radius
        return (r < 0.75 + 0.25 * z) & (c < 1)
    if name == "EllipsoidKind":
        return a**2 + b**2 + c**2 < 1
    if name == "SuperquadricKind":  # exponents 2 * 4 ** .5, and 8 below the middle
        return np.where(x[2] < 0, (a**4 + b**4) ** 2 + c**8, a**4 + b**4 + c**4) < 1
    raise AssertionError(name)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        (BoxKind(), [0.2]),
        (CylinderKind(), []),
        (ConeKind(), [0.25]),
        (EllipsoidKind(), []),
        (SuperquadricKind(), [0.5, 0.5]),
    ],
    ids=lambda one: type(one).__name__,
)
def test_distances_have_the_sign_of_the_equation(kind, shape):
    half = np.array([0.04, 0.04, 0.07], np.float32)
    x = RNG.uniform(-0.09, 0.09, (3, 4000)).astype(np.float32)
    found = kind.distance(half[:, None], np.array(shape, np.float32)[:, None], x[..., None])[:, 0]
    clear = np.abs(found) > 1e-4
    assert np.array_equal((found < 0)[clear], inside_of(kind, half, np.array(shape), x)[clear])


def test_far_points_are_far_from_a_small_superquadric():
    """Powers of up to 8 of single-precision numbers do not overflow."""
    half, shape = np.full((3, 1), 0.004, np.float32), np.ones((2, 1), np.float32)  # nearly a cube
    x = np.array([[0.8, 0.1, 0.05], [-0.7, 0.7, -0.6], [0, 0, 1]], np.float32).T
    with np.errstate(all="raise", under="ignore"):
        found = SuperquadricKind().distance(half, shape, x[..., None])[:, 0]
    assert (found > 0.5).all() and (found < 1.5).all()


def test_a_vessel_is_hollow_and_open_at_the_top():
    half, wall = np.array([[0.04], [0.04], [0.05]], np.float32), 0.006
    shape = np.array([[0.7 / 0.75], [0.0], [0.5], [0.0]], np.float32)  # straight, with a wall of 6 mm
    x = np.array([[0, 0, 0], [0, 0, -0.047], [0.037, 0, 0], [0, 0, 0.06], [0.045, 0, 0]], np.float32).T
    kind = VesselKind()
    assert kind.thickness(half, shape) == pytest.approx(wall, abs=1e-6)
    found = kind.distance(half, shape, x[..., None])[:, 0]
    assert list(np.sign(found)) == [1, -1, -1, 1, 1]
    assert found[0] == pytest.approx(0.04 - wall, abs=1e-3)  # to the inner wall


def cast(half: float, height: float, grid: VoxelGrid = GRID) -> tuple[np.ndarray, np.ndarray]:
    """Scenes of one upright cylinder and of one turned box, as labels of the grid."""
    x, y, z = (grid.centre_of(np.indices(grid.shape).reshape(3, -1).T)).T.reshape(3, *grid.shape)
    x, y = x - grid.centre_of(np.array(grid.shape) // 2)[0], y - grid.centre_of(np.array(grid.shape) // 2)[1]
    cylinder = (np.hypot(x, y) < half) & (z < height)
    u, v = 0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x
    box = (np.abs(u) < half) & (np.abs(v) < 0.6 * half) & (z < height)
    return cylinder.astype(int), box.astype(int)


def seen_of(scene: np.ndarray, noise: float = 0.3) -> tuple[np.ndarray, ObservedBox]:
    frame = frame_of(scene, width=320, noise=noise)
    return observed_box(frame, masks_of(scene, frame)[0], GRID, Posterior())


def iou_of(p: np.ndarray, offset: np.ndarray, scene: np.ndarray, seen: ObservedBox) -> float:
    box = tuple(slice(o, o + n) for o, n in zip(offset, p.shape, strict=True))
    truth, found = scene[box] == 1, (p >= 0.5) & ~seen.free
    return float((found & truth).sum() / (found | truth).sum())


@pytest.mark.parametrize("which", [0, 1])
def test_it_knows_the_hidden_side_of_shapes_in_its_prior(which):
    """A cylinder and a turned box, of which one side is seen: better than what is below the visible surface."""
    scene = cast(0.055, 0.12)[which]
    offset, seen = seen_of(scene)
    found = iou_of(Posterior().fill(RNG, seen), offset, scene, seen)
    assert found > 0.75
    assert found > iou_of(Extrude().fill(RNG, seen), offset, scene, seen) - 0.02


def test_the_frame_of_a_turned_box_is_found():
    _, seen = seen_of(cast(0.055, 0.12)[1])
    groups = shape_groups(ShapeEvidence.of(seen), (BoxKind(),))
    assert groups.prior.sum() == pytest.approx(1)
    turned = np.rad2deg(np.arctan2(groups.axes[:, 1, 0], groups.axes[:, 0, 0]))
    assert min(abs((turned - np.rad2deg(np.arctan2(0.6, 0.8)) + 45) % 90 - 45)) < 8
    np.testing.assert_allclose(
        groups.axes @ groups.axes.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (len(turned), 3, 3)), atol=1e-5
    )
    assert set(groups.support.tolist()) == {0.0}


def test_readings_are_on_the_true_surface():
    """The points that stand for the readings, on a cylinder without noise, with normals that point outwards."""
    scene = cast(0.055, 0.12)[0]
    offset, seen = seen_of(scene, noise=0)
    evidence = ShapeEvidence.of(seen)
    voxel = GRID.voxel_size
    axis = GRID.centre_of(np.array(GRID.shape) // 2)[:2] - (np.asarray(GRID.origin)[:2] + offset[:2] * voxel)
    away = evidence.own[:, :2] - axis
    radius = np.linalg.norm(away, axis=1)
    side = (evidence.own[:, 2] < 0.1) & (evidence.own[:, 2] > 0.02)
    assert abs(np.median(radius[side]) - 0.055) < 0.006  # the scene is made of voxels
    outwards = (evidence.normal[side, :2] * away[side]).sum(axis=1)
    assert (outwards > 0).mean() > 0.9
    assert evidence.to_camera @ evidence.normal.mean(axis=0) > 0


def test_promises():
    """Free space stays free, an object has one answer, and draws differ but respect free space."""
    _, seen = seen_of(cast(0.055, 0.12)[0])
    first, again = QUICK.fill(RNG, seen), QUICK.fill(np.random.default_rng(5), seen)
    assert np.array_equal(first, again) and not first[seen.free].any()
    assert first.dtype == np.float32 and first.min() >= 0 and first.max() <= 1
    drawn = [QUICK.draw(np.random.default_rng(k), seen) for k in (0, 0, 1)]
    assert np.array_equal(drawn[0], drawn[1]) and not np.array_equal(drawn[0], drawn[2])
    assert not drawn[2][seen.free].any()
    frame = frame_of(TWO)
    with_seed = [
        DrawnShape(n=64).complete(np.random.default_rng(k), frame, masks_of(TWO, frame), GRID) for k in (0, 0, 1)
    ]
    for a, b, c in zip(*with_seed, strict=True):
        assert np.array_equal(a.probability, b.probability) and not np.array_equal(a.probability, c.probability)


@dataclass(frozen=True)
class _Nowhere(ShapeKind):
    """A shape that fits nothing: a tiny ball in the middle of the box."""

    def distance(self, half: np.ndarray, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.sqrt((x**2).sum(axis=0)) - 0.001


@dataclass(frozen=True)
class _KnownBoxes(BoxKind):
    """Boxes whose edges are known."""

    edges: tuple[float, ...] = ()

    def log_weight(self, half: np.ndarray, shape: np.ndarray) -> np.ndarray:
        off = 2 * np.sort(half, axis=0) - np.sort(self.edges)[:, None]
        return -0.5 * ((off / 0.004) ** 2).sum(axis=0)


def test_known_sizes_decide_what_is_not_seen():
    """The far side of a box is hardly seen, so how deep it is follows from what is said to be known."""
    _, seen = seen_of(boxes(((20, 20, 0), (32, 32, 8))))
    volumes = []
    for deep in (0.12, 0.16):
        known = Posterior(kinds=(_KnownBoxes(edges=(deep, 0.12, 0.08)),), misfit=0.0)
        drawn = known.sample(np.random.default_rng(0), seen)
        np.testing.assert_allclose(2 * np.sort(drawn.boxes.half, axis=0).mean(axis=1), (0.08, 0.12, deep), atol=0.008)
        volumes.append(drawn.occupancy().sum())
    assert volumes[1] > 1.15 * volumes[0]


def test_what_no_kind_fits_is_extruded():
    _, seen = seen_of(cast(0.055, 0.12)[1])
    rule = Posterior(kinds=(_Nowhere(),), n=32)
    np.testing.assert_allclose(rule.fill(RNG, seen), Extrude().fill(RNG, seen), atol=0.01)
    assert rule.sample(np.random.default_rng(0), seen).other_shape > 0.99
    assert replace(rule, other_shape=0.0).sample(np.random.default_rng(0), seen).other_shape == 0


def test_without_evidence_the_samples_are_those_of_the_prior():
    """With no weight on readings and penalties, kinds occur by their shares."""
    _, seen = seen_of(cast(0.055, 0.12)[0])
    kinds = BoxKind(share=3.0), SuperquadricKind(share=1.0)  # with feet of the same width
    free = Posterior(kinds=kinds, n=1000, most_readings=1e-9, penalty=0.0)
    share = (free.sample(np.random.default_rng(0), seen).kind == 0).mean()
    assert abs(share - 0.75) < 5 * np.sqrt(0.75 * 0.25 / 1000)


def test_views_count_if_they_show_much_that_the_latest_frame_does_not():
    """A view that adds little, with the errors of its motion, changes nothing; one of a hidden object is used."""
    _, seen = seen_of(cast(0.055, 0.12)[0])
    off = replace(
        seen, surface=seen.surface | np.roll(seen.surface, 1, axis=0), signed=seen.signed - 0.4, latest=seen
    )
    assert off.surface.sum() < seen.surface.sum() / 0.6
    assert np.array_equal(QUICK.fill(RNG, off), QUICK.fill(RNG, seen))
    nothing = np.zeros_like(seen.surface)
    hidden = replace(seen, latest=replace(seen, surface=nothing, points=nothing * 0))
    assert np.array_equal(QUICK.fill(RNG, hidden), QUICK.fill(RNG, seen))


def test_a_surface_in_small_pieces_is_an_object():
    """As of a grating, or of what is seen through a net: no piece is large."""
    _, seen = seen_of(cast(0.055, 0.12)[0])
    apart = [
        (np.indices(seen.surface.shape) % 2 == np.reshape(k, (3, 1, 1, 1))).all(axis=0) for k in np.ndindex(2, 2, 2)
    ]
    pieces = replace(seen, surface=seen.surface & max(apart, key=lambda one: (one & seen.surface).sum()))
    assert pieces.surface.sum() > 10
    assert (QUICK.fill(RNG, pieces) >= 0.5).any()


def test_tiny_and_empty_boxes():
    nothing = np.zeros((3, 3, 3), bool)
    empty = ObservedBox(nothing * 0, *[nothing] * 5, nothing * 0.0, np.arange(3) * 0.01 + 0.005)
    assert not QUICK.fill(RNG, empty).any() and not QUICK.draw(RNG, empty).any()
    one = nothing.copy()
    one[1, 1, 1] = True
    seen = ObservedBox(one * 1, one, *[nothing] * 4, np.where(one, 0.0, np.nan), np.arange(3) * 0.01 + 0.005)
    assert np.isfinite(QUICK.fill(RNG, seen)).all()


def test_a_pool_is_the_mean_of_its_members():
    frame = frame_of(TWO)
    members = Extrude(), SurfaceOnly()
    pool = Pooled(completers=members, weights=(3.0, 1.0))
    masks = masks_of(TWO, frame)
    _, seen = observed_box(frame, masks[0], GRID, pool)
    a, b = (one.fill(RNG, seen) for one in members)
    np.testing.assert_allclose(pool.fill(RNG, seen), 0.75 * a + 0.25 * b, rtol=1e-6)
    again = Pooled(completers=members[::-1], weights=(1.0, 3.0)).fill(RNG, seen)
    np.testing.assert_allclose(pool.fill(RNG, seen), again, rtol=1e-6)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"weights": (1.0,)}, "2 completers have 1 weights"),
        ({"weights": (0.0, 0.0)}, "cannot be normalised"),
        ({"weights": (1.0, -1.0)}, "cannot be normalised"),
        ({"completers": (), "weights": ()}, "0 completers"),
        ({"completers": (DrawnShape(), Extrude())}, "DrawnShape cannot be pooled"),
    ],
)
def test_wrong_pools(fields, message):
    with pytest.raises(InputError, match=message):
        Pooled(**fields)


def test_other_voxel_sizes():
    """The object is completed in voxels of 1 cm and interpolated."""
    fine = VoxelGrid(GRID.origin, GRID.voxel_size / 2, tuple(2 * n for n in GRID.shape))
    frame: Frame = frame_of(TWO, width=320)
    one = QUICK.complete(RNG, frame, masks_of(TWO, frame)[:1], fine)[0]
    assert 0.4 < (one.probability >= 0.5).sum() / 8 / (TWO == 1).sum() < 1.6


def test_default_kinds_have_names():
    from mstfilter.runs.presets import REGISTRY

    known = {location.split(":")[1] for location in REGISTRY.known("shape_kind").values()}
    assert {type(kind).__name__ for kind in SHAPE_KINDS} < known
