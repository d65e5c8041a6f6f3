"""Registration of clouds that move by a known motion."""

import json

import numpy as np
import pytest

from mstfilter import preset
from mstfilter.errors import InputError, MissingLibraryError
from mstfilter.open3d_import import import_open3d
from mstfilter.smc import Population
from mstfilter.tracking import registration
from mstfilter.tracking.registration import ColouredIcp, PointToPlaneIcp, SmallGicp, centroid_shift, prepare
from mstfilter.tracking.rigid import move_points
from tests.tracking.scenes import at, errors, iou


def corner(rng, n=1500):
    """Points on three faces of a box: every motion is observable."""
    p = rng.uniform(0, 0.1, (n, 3))
    p[np.arange(n), np.arange(n) % 3] = 0.0
    return p + 0.0005 * rng.normal(size=p.shape)


def print_of(p):
    """Grey values of a pattern with a period of about 5 cm."""
    return np.repeat(128 + 100 * np.sin(p @ [[80.0], [60.0], [70.0]]), 3, axis=1)


def open3d_icp(component):
    try:
        import_open3d()
    except MissingLibraryError as error:
        pytest.skip(error.message)
    return component


METHODS = [SmallGicp(), SmallGicp("PLANE_ICP"), SmallGicp("ICP"), PointToPlaneIcp(), ColouredIcp()]


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_small_motion_is_found(method):
    if not isinstance(method, SmallGicp):
        open3d_icp(method)
    rng = np.random.default_rng(0)
    T = at(0.01, -0.006, 0.004, 6)
    before, after = corner(rng), corner(rng)
    source = prepare(before, print_of(before))
    target = prepare(move_points(T, after), print_of(after))
    result = method.register(source, target, np.eye(4), 0.03)
    mm, deg = errors(result.T, T, np.full(3, 0.03))
    assert mm < 0.8 and deg < 0.8
    assert result.overlap > 0.95 and result.inliers > 0.9 * len(source.points) and result.error > 0
    again = method.register(source, target, np.eye(4), 0.03)
    np.testing.assert_array_equal(result.T, again.T)


def test_colour_finds_the_motion_within_a_plane():
    """A plane that moves within itself: point-to-plane distances do not change, colours do."""
    open3d_icp(ColouredIcp())
    rng = np.random.default_rng(1)
    T = at(0.006, -0.004, 0)
    before, after = (rng.uniform(-0.1, 0.1, (6000, 3)) * [1, 1, 0] for _ in range(2))
    source, target = prepare(before, print_of(before)), prepare(move_points(T, after), print_of(after))
    by_colour, by_plane = (m.register(source, target, np.eye(4), 0.02) for m in (ColouredIcp(), PointToPlaneIcp()))
    assert errors(by_colour.T, T, np.zeros(3))[0] < 1.0
    assert errors(by_plane.T, T, np.zeros(3))[0] > 5.0


def test_the_result_of_small_gicp_is_returned():
    rng = np.random.default_rng(0)
    result = SmallGicp().register(prepare(corner(rng)), prepare(corner(rng)), np.eye(4), 0.03)
    assert result.converged and 0 <= result.iterations < 30
    assert result.H.shape == (6, 6) and (np.linalg.eigvalsh(result.H) > 0).all()


@pytest.mark.parametrize("method", [PointToPlaneIcp(), ColouredIcp()], ids=str)
def test_both_use_open3d(method, monkeypatch):
    def missing():
        raise MissingLibraryError("open3d cannot be imported")

    monkeypatch.setattr(registration, "import_open3d", missing)
    p = corner(np.random.default_rng(0))
    surface = prepare(p, print_of(p))
    with pytest.raises(MissingLibraryError):
        method.register(surface, surface, np.eye(4), 0.03)


@pytest.mark.parametrize("name", ["colored_icp", "point_to_plane"])
def test_a_preset_runs_with_it(name, textured):
    """Selected by an override; the notes of the transition contain its statistics."""
    component = preset("mst", f"transition.rule.registration={name}").transition
    open3d_icp(component)
    scene, clip = textured
    population = Population((scene.hypothesis(),), np.zeros(1))
    moved = component.predict(np.random.default_rng(0), population, clip)
    assert moved.notes["registrations"]["number"] > 0
    truth = scene.labels(scene.poses[-1])
    assert iou(moved.particles[0].labels == 1, truth == 1) > 0.6
    assert json.loads(json.dumps(moved.notes)) == moved.notes


def test_registration_from_the_centroid_reaches_far_motions():
    rng = np.random.default_rng(1)
    T = at(0.2, 0.1, 0.0, 12)
    a, b = corner(rng), move_points(T, corner(rng))
    result = SmallGicp().register(prepare(a), prepare(b), centroid_shift(a, b), 0.03)
    assert errors(result.T, T, np.full(3, 0.03))[0] < 1.0
    assert (prepare(b).distances(prepare(a).points) <= 0.03).mean() < 0.5


@pytest.mark.parametrize("n", [0, 1, 11])
def test_too_few_points_cannot_be_registered(n):
    assert prepare(np.random.default_rng(0).normal(size=(n, 3))) is None


def test_invalid_fields_are_reported():
    with pytest.raises(InputError, match="method is 'icp', expected GICP, PLANE_ICP or ICP"):
        SmallGicp("icp")
    with pytest.raises(InputError, match="colour_scale is 0"):
        ColouredIcp(colour_scale=0)
    p = corner(np.random.default_rng(0))
    with pytest.raises(InputError, match="needs the colours"):
        ColouredIcp().register(prepare(p), prepare(p), np.eye(4), 0.03)
