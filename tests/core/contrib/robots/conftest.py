import contextlib

import pytest

from tests.support.robots import example, serving, simulated


@pytest.fixture(scope="package")
def server(library):
    """Address and table of the example's robot."""
    with contextlib.closing(simulated(library)) as table, serving(example().robot(table)) as url:
        yield url, table
