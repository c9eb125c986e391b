"""What the program does on systems without Linux's limits, Embree and PyBullet: see tests/elsewhere."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = (
    "tests/app/processes/test_child_process.py",
    "tests/app/storage/test_database.py",
    "tests/core/io/test_push_file.py",
    "tests/core/world/test_imaging.py",
)
pytestmark = pytest.mark.slow


def run(*arguments, **environment):
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )


def test_every_module_can_be_imported():
    program = """
import importlib, pathlib
lacking = set()
for path in sorted(path for package in ("osfcore", "app") for path in pathlib.Path(package).rglob("*.py")):
    try:
        importlib.import_module(".".join(path.with_suffix("").parts).removesuffix(".__init__"))
    except ModuleNotFoundError as error:
        lacking.add(error.name.partition(".")[0])
print(sorted(lacking))
"""
    told = run("-c", program, PYTHONPATH=os.pathsep.join((str(ROOT / "tests" / "elsewhere"), str(ROOT))))
    assert told.stdout.splitlines()[-1:] == ["['embreex', 'pybullet']"], told.stderr[-2000:]


def test_what_runs_here_runs_there():
    options = ("-p", "tests.elsewhere", "-p", "no:cacheprovider", "-m", "not e2e and not soak")
    limits = "tests/app/processes/test_child_process.py::test_memory_beyond_the_limit_is_refused"
    told = run("-m", "pytest", *options, f"--deselect={limits}", *FILES)
    assert told.returncode == 0, told.stdout[-4000:]
