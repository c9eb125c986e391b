"""What pip installs of the wheel alone is a library that works, and says what more the rest needs."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


def run(*command, cwd, check=True):
    done = subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0 or not check, done.stderr[-2000:]
    return done


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    place = tmp_path_factory.mktemp("wheel")
    yield place
    shutil.rmtree(place)  # an environment with torch is large


@pytest.fixture(scope="module")
def built(place):
    """The folder with the sdist, and with the wheel that was built of it."""
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", place / "dist", ROOT, cwd=place)
    return place / "dist"


@pytest.fixture(scope="module")
def python(place, built):
    """Python of a clean environment with the wheel and what it cannot do without."""
    run(sys.executable, "-m", "venv", place / "env", cwd=place)
    python = place / "env" / "bin" / "python"
    (wheel,) = built.glob("*.whl")
    run(python, "-m", "pip", "install", "-q", "-c", ROOT / "requirements.lock", wheel, cwd=place)
    return python


def test_both_are_built(built):
    assert sorted(path.name.partition("-")[2] for path in built.iterdir()) == ["0.1.0-py3-none-any.whl", "0.1.0.tar.gz"]


@pytest.mark.parametrize(("name", "words"), [("estimate", "light: 0."), ("plan", "after 12 actions")])
def test_examples_run_without_simulator_and_service(python, place, name, words):
    shutil.copytree(ROOT / "examples", place / "examples", dirs_exist_ok=True)
    for package in ("pybullet", "viser", "fastapi"):
        assert run(python, "-c", f"import {package}", cwd=place, check=False).returncode != 0
    assert words in run(python, f"examples/{name}.py", cwd=place).stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("serve",), "osf: This command needs fastapi, "),
        (("episode", "--out", "pushed"), "osf: The simulated table needs pybullet, embreex, "),
    ],
)
def test_what_is_missing_is_told_in_one_sentence(python, place, arguments, words):
    told = run(python.with_name("osf"), *arguments, "--data-dir", place / "data", cwd=place, check=False)
    assert told.returncode == 1
    (sentence,) = told.stderr.splitlines()
    assert sentence.startswith(words)
    assert "pip install 'osf-manipulation[" in sentence
