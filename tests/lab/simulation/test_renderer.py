"""The renderer against closed forms and open3d; the sensors against measurements of real ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mstfilter.base.errors import InputError, MissingLibraryError
from mstfilter.base.lazy import import_open3d
from mstfilter.lab.simulation.lighting import Stage
from mstfilter.lab.simulation.recorder import POSE_TOLERANCE
from mstfilter.lab.simulation.renderer import Renderer
from mstfilter.lab.simulation.sensor import SENSORS, DepthSensor, colour_reading
from mstfilter.lab.simulation.shapes import Shape, draw_shape
from mstfilter.lab.simulation.solids import ellipsoid
from mstfilter.lab.simulation.textures import Atlas, Skin, draw_room, draw_skin, texture_coordinates
from mstfilter.lab.simulation.world import FLOOR_HEIGHT, PhysicsWorld
from mstfilter.scene import Camera, depth_sigma, look_at

ROOM = draw_room(np.random.default_rng(0), 0.008)


def kinect(width=160, eye=(0.05, -0.72, 0.58), target=(0.02, 0.05, 0.04)):
    whole = Camera.from_intrinsics(525, 525, 319.5, 239.5, 640, 480, look_at(np.array(eye), np.array(target)))
    return whole.scaled(width / 640)


def single(piece):
    return Shape("test", "test", (piece,), 0.2, "box", ((3, 1.0),), ("speckle",))


def rendered(shape, at, camera, rotation=None, supersample=False):
    world = PhysicsWorld([shape])
    world.place(0, at, np.eye(3) if rotation is None else rotation)
    world.forward()
    skin = draw_skin(np.random.default_rng(0), shape)
    return Renderer(world, [skin], ROOM, camera, supersample).render()


def test_depth_of_a_sphere_matches_its_closed_form():
    radius, centre, camera = 0.06, np.array([0.03, 0.02, 0.1]), kinect()
    view = rendered(single(ellipsoid((radius,) * 3)), centre, camera)
    turn = camera.pose.as_matrix()
    d = camera.rays() @ turn[:3, :3].T
    o = turn[:3, 3] - centre
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    root = b * b - a * c
    expected = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.nan)
    np.testing.assert_array_equal(view.instance == 1, root > 0)
    np.testing.assert_allclose(view.depth[root > 0], expected[root > 0], atol=1e-5)


def test_depth_and_instances_agree_with_the_ray_caster_of_open3d():
    """A scene of boxes and hulls, which are exact meshes; open3d computes in single precision."""
    try:
        o3d = import_open3d()
    except MissingLibraryError as error:
        pytest.skip(error.message)
    shapes = [
        draw_shape(np.random.default_rng(k), name) for k, name in enumerate(("carton", "bowl", "angle", "soap"))
    ]
    world, camera = PhysicsWorld(shapes), kinect(320)
    for k, (shape, place) in enumerate(
        zip(shapes, ((-0.1, 0.05), (0.1, 0.0), (-0.05, -0.15), (0.2, 0.2)), strict=True)
    ):
        world.place(k, (*place, shape.half[2]), Rotation.from_euler("z", 0.4 + k).as_matrix())
    world.forward()
    skins = [draw_skin(np.random.default_rng(k), shape) for k, shape in enumerate(shapes)]
    view = Renderer(world, skins, ROOM, camera, False).render()

    scene, owner = o3d.t.geometry.RaycastingScene(), {}
    for k, (shape, pose) in enumerate(zip(shapes, world.poses(), strict=True)):
        for piece in shape.pieces:
            corners = piece.vertices
            if piece.kind == "box":
                corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * piece.size
            points = corners @ piece.rotation.T + piece.centre
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points @ pose[:3, :3].T + pose[:3, 3]))
            mesh = o3d.t.geometry.TriangleMesh.from_legacy(cloud.compute_convex_hull()[0])
            owner[scene.add_triangles(mesh)] = k + 1
    rays = camera.rays().reshape(-1, 3) @ camera.pose.as_matrix()[:3, :3].T
    rays = np.concatenate([np.broadcast_to(camera.position, rays.shape), rays], axis=1).astype(np.float32)
    hits = scene.cast_rays(o3d.core.Tensor(rays))
    depth = hits["t_hit"].numpy().reshape(view.depth.shape)
    expected = np.array([owner.get(i, 0) for i in hits["geometry_ids"].numpy().ravel()]).reshape(view.depth.shape)

    assert (np.bincount(expected.ravel()) > 500).all()
    # Rays that graze an edge within single precision may differ.
    assert (view.instance == expected).mean() > 0.9995
    same = (view.instance == expected) & (expected > 0)
    difference = np.abs(view.depth[same] - depth[same])
    assert np.quantile(difference, 0.999) < 2e-5 and difference.max() < 0.02


def test_floor_and_wall_are_behind_the_table():
    view = rendered(draw_shape(np.random.default_rng(0), "can"), (0, 0, 0.1), kinect())
    points = kinect().unproject(view.depth)
    assert np.isfinite(view.depth).all()
    assert points[..., 2].min() >= FLOOR_HEIGHT - 1e-3


def test_shadows_darken_the_table_and_supersampling_changes_edges_only():
    shape, camera = draw_shape(np.random.default_rng(0), "carton"), kinect()
    plain = rendered(shape, (0, 0, shape.half[2]), camera)
    empty = rendered(shape, (0, 30.0, -5.0), camera)
    smooth = rendered(shape, (0, 0, shape.half[2]), camera, supersample=True)
    table = (plain.instance == 0) & (empty.instance == 0)
    ratio = plain.colour.mean(-1)[table] / empty.colour.mean(-1)[table]
    assert ratio.max() < 1.001
    assert ratio.min() < 0.75
    changed = (plain.colour != smooth.colour).any(-1)
    assert 0 < changed.mean() < 0.06
    np.testing.assert_array_equal(plain.depth, smooth.depth)


def test_textures_are_not_mirrored():
    # Charts that are red left of the middle: seen from outside, red must be on the left of each face.
    shape = draw_shape(np.random.default_rng(0), "carton")
    half = np.zeros((16, 16, 3), np.uint8)
    half[:, :8] = (250, 0, 0)
    half[:, 8:] = (0, 0, 250)
    skin = Skin((half,) * 6 + (half[:2, :2],), 0.0)
    world = PhysicsWorld([shape])
    world.place(0, (0, 0, shape.half[2]), np.eye(3))
    world.forward()
    for eye in ((0, -0.6, 0.1), (0.6, 0.0, 0.1), (-0.6, 0.0, 0.1), (0, 0.6, 0.1), (0.0, -0.01, 0.8)):
        camera = kinect(eye=eye, target=(0, 0, 0.06))
        view = Renderer(world, [skin], ROOM, camera, False).render()
        rows, columns = np.nonzero(view.instance == 1)
        red = view.colour[rows, columns, 0] > view.colour[rows, columns, 2]
        assert columns[red].mean() < columns[~red].mean(), eye


def test_text_on_a_can_runs_to_the_right():
    shape = draw_shape(np.random.default_rng(0), "can")
    angle = np.array([-2.0, -1.8])  # seen from y < 0, x grows to the right as the angle grows
    points = np.stack([shape.half[0] * np.cos(angle), shape.half[0] * np.sin(angle), [0, 0]], axis=1)
    chart, place = texture_coordinates(shape, points, points / shape.half[0], np.zeros(2, bool))
    assert points[1, 0] > points[0, 0] and place[1, 0] > place[0, 0]
    assert (chart == 0).all()
    assert place[0, 1] == pytest.approx(0.5)


def test_atlas_interpolates_between_texels():
    chart = np.zeros((2, 2, 3), np.uint8)
    chart[:, 1] = 255
    atlas = Atlas([Skin((chart,), 0.0)], 1.0)
    place = np.array([[0.25, 0.5], [0.5, 0.5], [0.75, 0.5]], np.float32)
    colours = atlas.colour(0, np.zeros(3, int), place)
    np.testing.assert_allclose(colours[:, 0], [0.0, 0.5, 1.0], atol=2e-3)


def test_depth_noise_is_unbiased_and_has_the_modelled_deviation():
    for z in (0.7, 1.0):
        flat = np.full((200, 200), z, np.float32)
        noisy = DepthSensor(lateral=0.0).read(np.random.default_rng(0), flat, np.ones_like(flat))
        assert np.nanmean(noisy) == pytest.approx(z, abs=2e-4)
        assert np.nanstd(noisy) == pytest.approx(float(depth_sigma(z)), rel=0.12)


def test_depth_is_lost_at_edges_at_grazing_angles_and_out_of_range():
    depth = np.full((100, 100), 1.0, np.float32)
    depth[:, 50:] = 1.5
    depth[:10] = 0.2
    slant = np.ones_like(depth)
    slant[90:] = 0.05
    reading = DepthSensor(lateral=0.0, edge_dropout=1.0).read(np.random.default_rng(0), depth, slant)
    lost = np.isnan(reading)
    assert lost[:10].all() and lost[90:].all() and lost[20:80, 49:51].all()
    assert not lost[20:80, :48].any() and not lost[20:80, 52:].any()
    with pytest.raises(InputError, match="edge_dropout is 1.5"):
        DepthSensor(edge_dropout=1.5)


@pytest.mark.parametrize("width", [640, 320])
def test_the_projector_s_shadow_lies_to_the_left_and_has_the_width_of_the_parallax(width):
    near, far, scale = 0.7, 1.0, width / 640
    depth = np.full((60, width), far, np.float32)
    left, right = round(300 * scale), round(400 * scale)
    depth[20:40, left:right] = near
    sensor = DepthSensor(lateral=0.0, edge_dropout=0.0, fill=0.0)
    lost = np.isnan(sensor.read(np.random.default_rng(0), depth, np.ones_like(depth)))
    # The projector sees what is `near` farther left of what is `far` by f b (1 / near - 1 / far) pixels.
    expected = 525 * scale * 0.075 * (1 / near - 1 / far)
    assert not lost[:20].any() and not lost[40:].any() and not lost[:, left:].any()
    assert (abs(lost[20:40].sum(axis=1) - expected) <= 1).all()
    assert lost[20:40, left - int(expected - 1) : left].all()
    filled = DepthSensor(lateral=0.0, edge_dropout=0.0, fill=40.0)
    assert np.isfinite(filled.read(np.random.default_rng(0), depth, np.ones_like(depth))).all()


def test_readings_are_missing_to_each_side_of_objects_as_on_real_frames():
    # Share of missing readings 1, 4 and 7 pixels from the border of objects with readings, on 45 real frames.
    real = {(0, -1): (0.64, 0.40, 0.25), (0, 1): (0.65, 0.29, 0.13), (-1, 0): (0.44, 0.22, 0.14)}
    real[1, 0] = (0.36, 0.22, 0.16)
    counts = {side: np.zeros((3, 2)) for side in real}
    for seed, family in enumerate(("carton", "can", "mug", "bottle")):
        shape = draw_shape(np.random.default_rng(seed), family)
        view = rendered(shape, (0, 0, shape.half[2]), kinect(640))
        reading = DepthSensor().read(np.random.default_rng(seed), view.depth, view.slant)
        lost, thing = np.isnan(reading), (view.instance == 1) & np.isfinite(reading)
        for side, found in counts.items():
            border = thing & ~np.roll(thing, (-side[0], -side[1]), (0, 1))
            for k, step in enumerate((1, 4, 7)):
                there = np.roll(lost, (-side[0] * step, -side[1] * step), (0, 1))
                found[k] += there[border].sum(), border.sum()
    shares = {side: found[:, 0] / found[:, 1] for side, found in counts.items()}
    # Lone objects on a table: as many at the border (in clutter, farther off too), and the left is the wider side.
    at_border = [np.mean([values[0] for values in found.values()]) for found in (shares, real)]
    assert abs(at_border[0] - at_border[1]) < 0.08
    assert shares[0, -1][1] > shares[0, 1][1] + 0.1


@pytest.mark.parametrize(
    ("name", "at_1_m", "power"), [("d415", 1.5, 2), ("d435", 3.6, 2), ("azure", 1.5, 1), ("l515", 2.5, 1)]
)
def test_noise_of_other_cameras_grows_with_the_distance_as_published(name, at_1_m, power):
    sensor = replace(SENSORS[name], darkest=0.0)
    for z in (0.7, 1.4):
        flat = np.full((200, 200), z, np.float32)
        noisy = sensor.read(np.random.default_rng(0), flat, np.ones_like(flat))
        assert np.nanmean(noisy) == pytest.approx(z, abs=1e-3)
        # Rounding of the disparity adds to the noise of stereo cameras.
        assert 1000 * np.nanstd(noisy) == pytest.approx(at_1_m * z**power, rel=0.15), z


def test_noise_of_stereo_is_alike_in_neighbouring_pixels():
    flat = np.full((200, 640), 1.0, np.float32)
    alike = []
    for name in ("xtion", "d435"):
        noise = SENSORS[name].read(np.random.default_rng(0), flat, np.ones_like(flat)) - 1.0
        noise = noise[:, 60:]  # the projector's raster ends at the left border
        alike.append(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1])
    assert abs(alike[0]) < 0.05 and alike[1] > 0.7


def test_flying_pixels_lie_between_both_surfaces():
    depth = np.full((100, 100), 0.8, np.float32)
    depth[:, 50:] = 1.2
    sensor = replace(SENSORS["azure"], lateral=0.0, edge_dropout=0.0, flying=1.0, axial=0.0)
    reading = sensor.read(np.random.default_rng(0), depth, np.ones_like(depth))
    edge = reading[:, 49:51]
    assert (edge > 0.8).all() and (edge < 1.2).all() and 0.05 < edge.std() < 0.2
    assert (reading[:, :48] == np.float32(0.8)).all()


def test_dark_and_shiny_surfaces_are_not_read():
    flat = np.full((60, 60), 1.0, np.float32)
    ones = np.ones_like(flat)
    sensor = SENSORS["l515"]
    dark = np.where(np.arange(60) < 30, 0.02, 0.6).astype(np.float32) * ones
    lost = np.isnan(sensor.read(np.random.default_rng(0), flat, ones, dark, 0 * ones))
    assert lost[:, :30].all() and not lost[:, 30:].any()
    near = np.isnan(sensor.read(np.random.default_rng(0), 0.4 * flat, ones, dark, 0 * ones))
    assert not near.any()  # enough light comes back from nearby
    shiny = np.isnan(sensor.read(np.random.default_rng(0), flat, ones, 0.6 * ones, ones))
    assert shiny.mean() == pytest.approx(sensor.shiny, abs=0.15)
    assert not DepthSensor().sees_materials and sensor.sees_materials


def test_the_renderer_reports_reflectance_and_shine():
    shape, camera = draw_shape(np.random.default_rng(0), "can"), kinect()
    view = rendered(shape, (0, 0, shape.half[2]), camera)
    on = view.instance == 1
    assert view.reflectance[on].min() > 0 and view.reflectance[on].max() <= 1
    assert (view.shine[~on] == 0).all() and view.shine[on].max() <= 1


def test_the_colour_sensor_keeps_grey_and_order():
    steps = np.repeat(np.linspace(0, 1.5, 12)[None, :, None], 50, axis=0)
    steps = np.repeat(np.repeat(steps, 8, axis=1), 3, axis=2).astype(np.float32)
    image = colour_reading(np.random.default_rng(0), steps)
    levels = image.astype(float).mean(axis=(0, 2)).reshape(12, 8).mean(axis=1)
    assert image.dtype == np.uint8
    assert (np.diff(levels) > 0).all() and levels[0] < 12 and levels[-1] > 240
    assert np.abs(image.mean(axis=(0, 1)) - image.mean()).max() < 1


def test_rendered_poses_are_within_the_tolerance():
    shape = draw_shape(np.random.default_rng(0), "carton")
    world = PhysicsWorld([shape])
    stage, pose = Stage(world, POSE_TOLERANCE), world.poses()[0]
    rng = np.random.default_rng(0)
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * shape.half
    moved = 0
    for _ in range(60):
        pose[:3, 3] += rng.normal(0, 3e-5, 3)
        world.place(0, pose[:3, 3], pose[:3, :3])
        before = stage.poses[0]
        stage.follow()
        moved += (stage.poses[0] != before).any()
        shown, true = (p[:3, :3] @ corners.T + p[:3, 3:] for p in (stage.poses[0], world.poses()[0]))
        assert np.linalg.norm(shown - true, axis=0).max() <= POSE_TOLERANCE
    assert 2 < moved < 40
