import shutil

import numba
import pytest
import torch

from osfcore.io.image_set import read_image_set
from tests.support.ellipsoid_sets import write_set


@pytest.fixture(scope="session")
def pristine_set(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("sets") / "ellipsoid")


@pytest.fixture
def image_set(pristine_set, tmp_path):
    return shutil.copytree(pristine_set, tmp_path / "ellipsoid")


@pytest.fixture(scope="session")
def images(pristine_set):
    return read_image_set(pristine_set, "train")


@pytest.fixture(scope="module")
def one_thread():
    """Two threads that wait for each other on a busy machine take a hundred times as long for such small work."""
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])
