import subprocess
import sys

import pytest

import osfcore


def test_every_public_name_is_there():
    for name in osfcore.__all__:
        assert getattr(osfcore, name).__name__ == name
    assert set(dir(osfcore)) == set(osfcore.__all__)
    with pytest.raises(AttributeError, match="Teapot"):
        getattr(osfcore, "Teapot")  # noqa: B009


def test_the_library_is_imported_at_once():
    code = "import sys, osfcore; print(*(m for m in ('torch', 'numba', 'pybullet', 'cma') if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
