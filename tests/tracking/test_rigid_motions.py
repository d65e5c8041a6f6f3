"""What moved apart in a clip: one number a rigid motion."""

import numpy as np
import pytest

from mstfilter.scene.clip import Clip
from mstfilter.scene.rendering import project
from mstfilter.scene.voxels import Hypothesis
from mstfilter.tracking.rigid_motions import RigidMotions
from tests.tracking.scenes import standard


@pytest.fixture(scope="module")
def pushed():
    """Six textured solids: 1, 2 and 5 are moved apart, 3, 4 and 6 rest."""
    scene = standard(8)
    clip = scene.clip(0)
    truth = Hypothesis.from_labels(scene.labels(scene.poses[-1]), scene.grid)
    return clip, project(truth, clip.after.camera)


def test_every_motion_has_a_number_of_its_own(pushed):
    clip, objects = pushed
    motions = RigidMotions().divide(clip)
    main = {}
    for k in range(1, 7):
        seen = motions[(objects == k) & (motions >= 0)]
        numbers, counts = np.unique(seen, return_counts=True)
        assert len(seen) >= 40
        assert counts.max() > 0.9 * len(seen)  # an object is not broken
        main[k] = int(numbers[counts.argmax()])
    assert main[3] == main[4] == main[6] == 0
    assert len({main[1], main[2], main[5], 0}) == 4


def test_nothing_moved_or_a_single_frame(pushed):
    clip, _ = pushed
    still = Clip((clip.before,) * 3, clip.grid, 1)
    motions = RigidMotions().divide(still)
    assert motions.max() == 0
    assert RigidMotions().divide(Clip((clip.before,), clip.grid, 0)) is None


def test_the_limit_of_misfit_decides(pushed):
    """A limit larger than any motion joins everything that touches."""
    clip, objects = pushed
    fine = RigidMotions().divide(clip)
    coarse = RigidMotions(misfit=1.0, reach=1.0).divide(clip)
    inside = (objects > 0) & (fine >= 0) & (coarse >= 0)
    assert len(np.unique(coarse[inside])) < len(np.unique(fine[inside]))
