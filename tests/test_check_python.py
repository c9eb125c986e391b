"""The sentence that a wrong Python gets before pip fails in a hundred lines."""

import importlib.util
import platform
import shutil
import sys
from pathlib import Path

import pytest


@pytest.fixture
def check():
    spec = importlib.util.spec_from_file_location("check_python", Path(__file__).parents[1] / ".ci" / "check_python.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def test_this_python_is_fine(check):
    assert check() is None


@pytest.mark.parametrize(("version", "machine"), [((3, 13, 1), "x86_64"), ((3, 11, 7), "aarch64")])
def test_without_wheels_and_compiler_3_11_is_named(check, monkeypatch, version, machine):
    monkeypatch.setattr(sys, "version_info", version)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "Python 3.11" in check()
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert check() is None


def test_an_old_python_is_told(check, monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 9, 2))
    assert "3.11 is needed" in check()
