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


def test_a_python_without_pybullet_is_told_what_it_can_do(check, monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 13, 1))
    assert "this is Python 3.13" in check()
    assert "python3.11" in check()
    assert check().endswith("pip install .")


def test_without_wheels_and_compiler_a_compiler_is_named(check, monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 11, 7))
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert check().endswith("install a compiler")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert check() is None


def test_an_old_python_is_told(check, monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 9, 2))
    assert "3.11 is needed" in check()
