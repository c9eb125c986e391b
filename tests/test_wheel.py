"""What pip installs of the wheel alone is a library that works, and says what more the rest needs."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


def run(*command, cwd, check=True, **environment):
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env={**os.environ, **environment}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
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


def test_weights_of_rivals_stay_in_the_repository(built, python, place):
    (wheel,) = built.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert any(name.startswith("osfcore/fields/shipped/") for name in names)
    assert not any(name.startswith("osfcore/experiments/rivals/shipped/") for name in names)
    program = "from osfcore.experiments.rivals.fitvid import fitvid_path; fitvid_path(None)"
    told = run(python, "-c", program, cwd=place, check=False).stderr
    assert "OsfError" in told
    assert "DATA_DIR/fitvid.safetensors" in told


def test_a_package_called_app_of_somebody_else_does_not_matter(built, python, place):
    (wheel,) = built.glob("*.whl")
    assert {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()} <= {
        "osfcore", "osf_app", "osf_manipulation-0.1.0.dist-info",
    }  # fmt: skip
    (place / "theirs" / "app").mkdir(parents=True)
    (place / "theirs" / "app" / "__init__.py").write_text("raise RuntimeError")
    told = run(python.with_name("osf"), "assets", "--help", cwd=place, PYTHONPATH=str(place / "theirs"))
    assert "fetch" in told.stdout


@pytest.mark.parametrize(("name", "words"), [("estimate", "light: 0."), ("plan", "after 12 actions")])
def test_examples_run_without_simulator_and_service(python, place, name, words):
    shutil.copytree(ROOT / "examples", place / "examples", dirs_exist_ok=True)
    for package in ("pybullet", "mujoco", "viser", "fastapi"):
        assert run(python, "-c", f"import {package}", cwd=place, check=False).returncode != 0
    assert words in run(python, f"examples/{name}.py", cwd=place).stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("serve",), "osf: This command needs fastapi, "),
        (("episode", "--out", "pushed"), "osf: The simulated table needs mujoco, "),
    ],
)
def test_what_is_missing_is_told_in_one_sentence(python, place, arguments, words):
    told = run(python.with_name("osf"), *arguments, "--data-dir", place / "data", cwd=place, check=False)
    assert told.returncode == 1
    (sentence,) = told.stderr.splitlines()
    assert sentence.startswith(words)
    assert "pip install 'osf-manipulation[" in sentence


@pytest.fixture
def locked(python, tmp_path):
    """What runs a command as a user to whom the installed package and the home belong, but who cannot write there."""
    unprivileged = ()
    if os.geteuid() == 0:  # who writes everywhere
        if shutil.which("setpriv") is None:
            pytest.skip("root without setpriv")
        unprivileged = ("setpriv", "--bounding-set=-dac_override", "--inh-caps=-all")
    (site,) = python.parents[1].glob("lib/*/site-packages")
    folders = [tmp_path / "locked", *(place for part in ("osfcore", "osf_app") for place in (site / part).rglob("*/"))]
    folders[0].mkdir()
    folders += [site / "osfcore", site / "osf_app"]
    modes = [(folder, folder.stat().st_mode) for folder in folders]
    for folder in folders:
        folder.chmod(0o555)

    def run_locked(*arguments, **environment):
        lacking = {"HOME": str(folders[0] / "home"), "XDG_DATA_HOME": "", "NUMBA_CACHE_DIR": "", **environment}
        return run(*unprivileged, python.with_name("osf"), *arguments, cwd=tmp_path, **lacking)

    yield run_locked
    for folder, mode in modes:
        folder.chmod(mode)


def test_who_cannot_write_beside_the_package_keeps_kernels_in_the_data_directory(locked, pushed, tmp_path):
    drawn = ("render", "--scene", pushed[0], "--camera", "0", "--out", tmp_path / "seen.png")
    assert locked(*drawn, "--data-dir", tmp_path / "data").stderr == ""
    assert list((tmp_path / "data").rglob("*.nbi"))
    (sentence,) = locked(*drawn).stderr.splitlines()
    assert str(tmp_path / "locked") in sentence


@pytest.fixture(scope="module", params=["3.12", "3.13"])
def later(request, place, built):
    """Python for which there is no PyBullet, with the wheel and all else that its extras bring."""
    packages = ROOT / ".cache" / f"python{request.param}"
    if not (packages / ".installed").exists():
        pytest.skip(f"the packages for Python {request.param} are not here; 'make test-pythons' installs them")
    home = place / request.param
    run(packages / "bin" / "python", "-m", "venv", home, cwd=place)
    (site,) = home.glob("lib/*/site-packages")
    (site / "shared.pth").write_text(str(packages / site.relative_to(home)))
    (wheel,) = built.glob("*.whl")
    run(home / "bin" / "pip", "install", "-q", "--no-index", f"{wheel}[serve,gym,mcap,lerobot,ros,usd]", cwd=place)
    return home / "bin" / "python"


@pytest.fixture(scope="module")
def pushed(place):
    """Options that tell a scene and pushes in it."""
    at = {"009_gelatin_box": [0.05, 0.02, 0.0145], "005_tomato_soup_can": [-0.08, 0.05, 0.0505]}
    objects = [{"name": name, "position": position, "quaternion": [1, 0, 0, 0]} for name, position in at.items()]
    scene = {"objects": objects, "light": {"position": [0.5, 0.3, 0.8]}, "pusher": {"position": [0.05, -0.1, 0.062]}}
    (place / "scene.json").write_text(json.dumps({**scene, "cameras": []}))
    (place / "actions.json").write_text(json.dumps({"actions": [[[0, 0.2, 0]] * 3], "step_s": 0.2}))
    return place / "scene.json", place / "actions.json"


def test_a_later_python_estimates(later, place):
    shutil.copytree(ROOT / "examples", place / "examples", dirs_exist_ok=True)
    run(later, "-W", "error", "-c", "import osfcore; osfcore.SceneRenderer, osfcore.Episode", cwd=place)
    assert "light: 0." in run(later, "examples/estimate.py", cwd=place, PYTHONWARNINGS="error").stdout


def test_a_later_python_predicts_draws_and_exports(later, place, pushed):
    out = place / f"out{later.parts[-3]}"
    commands = (
        ("--help",),
        ("check", pushed[0]),
        ("predict", "--state", pushed[0], "--actions", pushed[1], "--out", out / "rollouts.json", "--images", out),
        ("export", "scene", "--scene", pushed[0], "--out", out / "scene.usdz"),
        ("export", "field", "009_gelatin_box", "--out", out / "gelatin.glb"),
    )
    told = [run(later.with_name("osf"), *c, cwd=place, PYTHONWARNINGS="error", OSF_DATA_DIR=str(out)) for c in commands]
    assert "009_gelatin_box: goes up to" in told[2].stdout
    assert {"000.png", "rollouts.json", "scene.usdz", "gelatin.glb"} <= {path.name for path in out.iterdir()}


def test_a_later_python_simulates_with_mujoco_and_tells_where_pybullet_is_to_be_had(later, place, data_dir):
    program = (
        "import sys; from osfcore.objects.asset_library import AssetLibrary; "
        "from osfcore.world.scenes import Conditions; from osfcore.world.tabletop import Tabletop; "
        "simulator = {'simulator': sys.argv[2]} if sys.argv[2:] else {}; "
        "world = Tabletop(AssetLibrary(sys.argv[1]), conditions=Conditions(**simulator)); world.arrange(0); "
        "print(len(world.names))"
    )
    assert run(later, "-c", program, data_dir / "objects", cwd=place).stdout.strip() == "3"
    told = run(later, "-c", program, data_dir / "objects", "pybullet", cwd=place, check=False).stderr
    assert "needs pybullet, which is not installed" in told
    assert told.strip().endswith("under Python 3.11, the last one that PyBullet has wheels for.")
