import pytest

from osfcore.dynamics.rollout import load_shapes
from osfcore.dynamics.shapes import ShapeTable
from osfcore.fields.field_library import FieldLibrary
from tests.core.dynamics.scenes import NAMES


@pytest.fixture(scope="session")
def shapes():
    """Four real objects."""
    return load_shapes(None, FieldLibrary(None), NAMES)


@pytest.fixture(scope="session")
def table(shapes):
    """The same side by side, in order of name."""
    return ShapeTable(tuple(shapes[name] for name in sorted(shapes)))
