import importlib.util
import sys

import pytest

from osfcore.extras import PACKAGES, MissingExtra, missing, need, told_of


def without(monkeypatch, *packages):
    """As if packages were not installed."""
    found = importlib.util.find_spec
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None if name in packages else found(name))


@pytest.mark.parametrize("extra", PACKAGES)
def test_what_is_installed_is_not_missed(extra):
    need(extra, "This")
    assert missing(extra) == []


def test_what_is_missing_is_told_with_how_to_get_it(monkeypatch):
    without(monkeypatch, "viser", "uvicorn")
    with pytest.raises(MissingExtra) as told:
        need("serve", "The service")
    get = "which are not installed; get them with: pip install 'osf-manipulation[serve]'."
    assert str(told.value) == f"The service needs uvicorn, viser, {get}"


def test_an_import_that_failed_is_told_if_an_extra_brings_it(monkeypatch):
    without(monkeypatch, "pybullet")
    told = told_of(ModuleNotFoundError("none", name="pybullet.client"), "This command")
    assert str(told).startswith("This command needs pybullet, which is not installed; get it with: pip install")
    assert told_of(ModuleNotFoundError("none", name="teapot"), "This command") is None


def test_pybullet_is_not_promised_where_it_has_no_wheels(monkeypatch):
    without(monkeypatch, "pybullet")
    with pytest.raises(MissingExtra, match=r"sim\]'\.$"):
        need("sim", "The simulated table")
    monkeypatch.setattr(sys, "version_info", (3, 13, 0))
    with pytest.raises(MissingExtra, match=r"sim\]' under Python 3\.11, the last one that PyBullet has wheels for\.$"):
        need("sim", "The simulated table")
