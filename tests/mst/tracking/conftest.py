import pytest

from tests.mst.tracking.scenes import standard


@pytest.fixture(scope="session")
def textured():
    scene = standard(9)
    return scene, scene.clip(0)


@pytest.fixture(scope="session")
def plain():
    scene = standard(9, texture=0.0)
    return scene, scene.clip(0)
