import pytest

from osfcore.estimation.objective import ObjectModels
from osfcore.geometry.cameras import default_cameras
from tests.support.posed_scenes import BOTTLE, BOX, lying, observe, scene, shipped_models
from tests.support.rendered_scenes import ball, block, wooden_table


@pytest.fixture(scope="session")
def plain():
    """A block and a ball of one colour each."""
    return ObjectModels({"block": block(), "ball": ball()}, wooden_table())


@pytest.fixture(scope="session")
def models():
    """Two real objects."""
    return shipped_models()


@pytest.fixture(scope="session")
def truth(models):
    """The box on a narrow side, the bottle on its back."""
    return scene({BOX: lying(models, BOX, 30, 0.05, -0.08), BOTTLE: lying(models, BOTTLE, 50, -0.06, 0.09)})


@pytest.fixture(scope="session")
def seen(models, truth):
    """What three cameras see of it."""
    return observe(models, truth, default_cameras(96)[:3])
