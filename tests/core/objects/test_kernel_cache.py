"""Where compiled kernels are kept: in the data directory, else in a temporary folder that goes, with one sentence."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
from osfcore.objects.kernel_cache import kept_kernel

@kept_kernel()
def double(x):
    return 2 * x

print(double(21), double.stats.cache_path)
"""


def kept(tmp_path, **environment):
    """What a program with a kernel prints, where it keeps the kernel, and what it complains of."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    inherited = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment = {**inherited, "PYTHONPATH": str(Path(__file__).parents[3]), **environment}
    done = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True, check=True)
    answer, place = done.stdout.split()
    assert answer == "42"
    assert not (tmp_path / "__pycache__").exists()
    return Path(place), done.stderr


@pytest.fixture
def no_folder(tmp_path):
    """A path that no user can make a folder at, not even root."""
    (tmp_path / "file").touch()
    return tmp_path / "file" / "data"


def test_kernels_are_kept_in_the_data_directory(tmp_path):
    place, complaint = kept(tmp_path, OSF_DATA_DIR=str(tmp_path / "data"))
    assert place.is_relative_to(tmp_path / "data")
    assert list(place.glob("*.nbi"))
    assert complaint == ""


def test_a_folder_that_was_chosen_comes_first(tmp_path, no_folder):
    place, _ = kept(tmp_path, OSF_DATA_DIR=str(no_folder), NUMBA_CACHE_DIR=str(tmp_path / "chosen"))
    assert place.is_relative_to(tmp_path / "chosen")


@pytest.mark.parametrize("variable", ["OSF_DATA_DIR", "NUMBA_CACHE_DIR"])
def test_without_a_folder_kernels_last_as_long_as_the_process(tmp_path, no_folder, variable):
    place, complaint = kept(tmp_path, **{variable: str(no_folder)})
    assert not place.exists()
    (sentence,) = complaint.splitlines()
    assert str(no_folder) in sentence
