import pytest

from osfcore.dynamics.shapes import ShapeTable, object_shape
from osfcore.fields.library import FieldLibrary
from tests.core.dynamics.scenes import NAMES


@pytest.fixture(scope="session")
def shapes():
    """Four real objects."""
    library = FieldLibrary(None)
    return {name: object_shape(library.load(name)) for name in NAMES}


@pytest.fixture(scope="session")
def table(shapes):
    """The same side by side, in order of name."""
    return ShapeTable(tuple(shapes[name] for name in sorted(shapes)))
