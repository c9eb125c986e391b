import importlib.util
import sys

import pytest

from osfcore.extras import PACKAGES, MissingExtra, as_missing_extra, missing, need
from tests.support.errors import about


def test_missing_packages_are_named_with_their_extra(monkeypatch):
    for extra in PACKAGES:
        need(extra, "This")
    absent, found = ("viser", "uvicorn", "mujoco"), importlib.util.find_spec
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None if name in absent else found(name))
    assert missing("serve") == ["uvicorn", "viser", "mujoco"]
    with pytest.raises(MissingExtra, check=about("viser")) as error:
        need("serve", "The service")
    assert "pip install 'osf-manipulation[serve]'" in str(error.value)
    failed = as_missing_extra(ModuleNotFoundError("none", name="pybullet.client"), "This command")
    assert (failed.extra, failed.missing) == ("sim", ["pybullet"])
    assert as_missing_extra(ModuleNotFoundError("none", name="teapot"), "This command") is None
    assert "3.11" not in str(failed)
    monkeypatch.setattr(sys, "version_info", (3, 13, 0))  # PyBullet is not promised where it has no wheels
    assert "3.11" in str(MissingExtra("It", "sim", ["pybullet"]))
