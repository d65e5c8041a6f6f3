"""Reuse between frames: the images equal those of casting all rays."""

from dataclasses import replace

import numpy as np
import pytest

from mstfilter.simulation.families import scene_family
from mstfilter.simulation.layers import Stage
from mstfilter.simulation.recorder import POSE_TOLERANCE, SimulatedScene
from mstfilter.simulation.renderer import Renderer
from mstfilter.simulation.solids import may_meet
from mstfilter.simulation.world import advance_push

SMALL = replace(scene_family("s1"), width=160, height=120, frames_per_clip=6, fps=3.0)


def test_images_equal_those_of_full_rendering():
    scene = SimulatedScene(SMALL, 2)
    full = Renderer(scene.world, scene.objects.skins, scene.room, scene.camera, True, POSE_TOLERANCE)
    kept = scene._renderer
    push = scene.choose_push(0)
    for step in range(SMALL.frames_per_clip - 1):
        if step:
            advance_push(scene.world, push, (step - 1) / SMALL.fps, step / SMALL.fps)
        full.forget()
        one, other = kept.render(), full.render()
        for name in ("colour", "depth", "instance", "slant"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=f"{name}, step {step}")
    assert (one.instance == 255).any()


def test_no_ray_is_cast_if_nothing_moved(monkeypatch):
    scene = SimulatedScene(SMALL, 2)
    first = scene._renderer.render()
    monkeypatch.setattr(Stage, "cast", lambda self, eye, rays, groups=(): pytest.fail("a ray") if len(rays) else CAST)
    scene.world.data.qpos[scene.world.pose_index[0, 0]] += 0.4 * POSE_TOLERANCE
    scene.world.forward()
    np.testing.assert_array_equal(scene._renderer.render().colour, first.colour)


CAST = (np.zeros(0, np.int32), np.zeros(0), np.zeros((0, 3)))


def test_rendered_poses_are_within_the_tolerance():
    scene = SimulatedScene(SMALL, 2)
    world, stage = scene.world, Stage(scene.world, POSE_TOLERANCE)
    shape, pose = world.shapes[0], world.poses()[0]
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


def test_rays_that_miss_the_bounds_miss_the_bodies():
    scene = SimulatedScene(SMALL, 2)
    scene.world.move_finger((0.0, 0.1, 0.15))
    stage = scene._renderer.stage
    stage.follow()
    _, capsules = stage.bodies()
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(20):
        eye = rng.normal(size=3) * 0.6 + (0, 0, 0.9)
        rays = rng.uniform((-0.6, -0.6, 0), (0.6, 0.6, 0.3), (3000, 3)) - eye
        meets = may_meet(capsules, eye, rays)
        geom, _, _ = stage.cast(eye, rays, (1, 2))
        assert not (geom[~meets] >= 0).any()
        shares.append((geom >= 0).sum() / max(meets.sum(), 1))
    assert np.mean(shares) > 0.3  # and they are no wider than need be


def test_long_bounds_lie_between_planes():
    rod = np.array([[-1.0, 0, 1, 1.0, 0, 1, 0.01]])
    rays = np.array([[0.9, 0.005, 1], [0.9, 0.05, 1], [1.2, 0, 1], [0, 0, -1]])
    assert may_meet(rod, np.zeros(3), rays).tolist() == [True, False, False, False]
    assert may_meet(rod, np.array([0.0, 0, 1.005]), rays).all()  # from inside the capsule
