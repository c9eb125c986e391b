import shutil

import pytest

from tests.core.fields.sets import write_set


@pytest.fixture(scope="session")
def pristine_set(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("sets") / "ellipsoid")


@pytest.fixture
def image_set(pristine_set, tmp_path):
    return shutil.copytree(pristine_set, tmp_path / "ellipsoid")
