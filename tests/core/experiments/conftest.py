import pytest

from osfcore.fields.field_library import FieldLibrary
from tests.core.experiments.solids import write_fields


@pytest.fixture(scope="session")
def solids(library, tmp_path_factory) -> FieldLibrary:
    """Three objects with a field and a mesh, and the table."""
    data_dir = tmp_path_factory.mktemp("solids")
    write_fields(data_dir, library)
    return FieldLibrary(data_dir, shipped=data_dir / "none")
