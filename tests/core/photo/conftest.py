import pytest

from osfcore.fields.field_library import FieldLibrary
from tests.support.photographs import NAME, take


@pytest.fixture(scope="session")
def fields():
    library = FieldLibrary(None)
    return {name: library.load(name) for name in (NAME, "006_mustard_bottle")}


@pytest.fixture(scope="session")
def taken(fields):
    """A photograph of a box, and the truth."""
    return take(fields)
