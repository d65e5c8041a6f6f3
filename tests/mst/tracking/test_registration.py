"""Registration of clouds that move by a known motion."""

import numpy as np
import pytest

from mstfilter.mst.tracking.registration import SmallGicp, centroid_shift, prepare
from mstfilter.mst.tracking.rigid import move_points
from tests.mst.tracking.scenes import at, errors


def corner(rng, n=1500):
    """Points on three faces of a box: every motion is observable."""
    p = rng.uniform(0, 0.1, (n, 3))
    p[np.arange(n), np.arange(n) % 3] = 0.0
    return p + 0.0005 * rng.normal(size=p.shape)


@pytest.mark.parametrize("method", ["GICP", "PLANE_ICP", "ICP"])
def test_a_small_motion_is_found(method):
    rng = np.random.default_rng(0)
    T = at(0.01, -0.006, 0.004, 6)
    source, target = prepare(corner(rng)), prepare(move_points(T, corner(rng)))
    result = SmallGicp(method).register(source, target, np.eye(4), 0.03)
    mm, deg = errors(result.T, T, np.full(3, 0.03))
    assert mm < 0.8 and deg < 0.8
    assert result.overlap > 0.95 and result.rms < 0.004
    first = SmallGicp(method, iterations=1).register(source, target, np.eye(4), 0.03)
    assert first.rms > result.rms, "one iteration is not enough"
    again = SmallGicp(method).register(source, target, np.eye(4), 0.03)
    np.testing.assert_array_equal(result.T, again.T)


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
