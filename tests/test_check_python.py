"""The sentence that a wrong Python gets before pip fails in a hundred lines."""

import importlib.util
import sys
from pathlib import Path

import pytest


@pytest.fixture
def check():
    spec = importlib.util.spec_from_file_location("check_python", Path(__file__).parents[1] / ".ci" / "check_python.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def test_this_python_and_later_ones_are_fine(check, monkeypatch):
    assert check() is None
    monkeypatch.setattr(sys, "version_info", (3, 14, 0))
    assert check() is None


def test_an_old_python_is_told(check, monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 9, 2))
    assert "3.11 is needed" in check()
