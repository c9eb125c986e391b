import json
import os
import subprocess
import sys
from importlib.metadata import version

import pytest

from app.cli.main import main


def osf(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "app.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize(
    "command",
    [
        (),
        ("assets",),
        ("collect",),
        ("collect", "pushes"),
        ("check",),
        ("serve",),
        ("train", "field"),
        ("estimate",),
        ("backup",),
        ("restore",),
    ],
)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    assert "usage: osf" in capsys.readouterr().out


def test_threads_do_not_spin_for_long_while_they_wait_unless_told_to(monkeypatch, capsys):
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "GOMP_SPINCOUNT" not in os.environ
    monkeypatch.delenv("OMP_WAIT_POLICY")
    with pytest.raises(SystemExit):
        main(["--help"])
    assert os.environ["GOMP_SPINCOUNT"] == "1000"
    monkeypatch.setenv("GOMP_SPINCOUNT", "5")
    with pytest.raises(SystemExit):
        main(["--help"])
    assert os.environ["GOMP_SPINCOUNT"] == "5"
    assert "usage" in capsys.readouterr().out


def test_it_tells_its_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"osf {version('osf-manipulation')}\n"


@pytest.mark.slow
def test_the_simulator_is_loaded_without_a_word():
    done = subprocess.run([sys.executable, "-c", "import osfcore.world.tabletop"], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")
    closed = subprocess.run(["sh", "-c", f"{sys.executable} -c 'import osfcore.world.tabletop' 2>&-"], check=False)
    assert closed.returncode == 0  # also where there is no stderr
    closed = subprocess.run(["sh", "-c", f"{sys.executable} -c 'import osfcore.world.tabletop' 2>&-"], check=False)
    assert closed.returncode == 0  # also where there is no stderr


def test_json_is_the_last_line_and_keys_are_stable(data_dir):
    done = osf("assets", "list", "--data-dir", str(data_dir), "--json")
    assert done.returncode == 0
    result = json.loads(done.stdout.splitlines()[-1])
    assert len(result["objects"]) == 20
    keys = {"name", "label", "size_m", "mass_kg", "symmetry", "available", "licence", "attribution"}
    assert keys <= set(result["objects"][0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("collect", "object", "teapot", "--out", "{tmp}/a"), "no object named 'teapot'"),
        (("collect", "object", "024_bowl", "--out", "{tmp}/a"), "osf assets fetch"),
        (("collect", "object", "006_mustard_bottle", "--out", "{tmp}/a", "--size", "2000"), "between 16 and 1024"),
        (("collect", "pushes", "--out", "{tmp}/a", "--objects", "9"), "between 1 and 8"),
        (("collect", "pushes", "--out", "/proc/pushes.h5", "--episodes", "1"), "/proc"),
        (("train", "field", "--data", "{tmp}", "--out", "{tmp}/a.safetensors"), "anno.json"),
        (("collect", "observation", "--out", "{tmp}/a", "--names", "teapot"), "no object named 'teapot'"),
        (("estimate", "--observation", "{tmp}", "--out", "{tmp}/a.json"), "no folder with an observation.json"),
        (("check", "{tmp}/nothing"), "no such file"),
        (("assets", "fetch", "teapot"), "teapot"),
        (("assets", "fetch", "--source", "{tmp}/nowhere"), "nowhere"),
        (("assets", "add", "{tmp}/nothing.obj", "--name", "x", "--mass", "1"), "nothing.obj"),
    ],
)
def test_a_mistake_is_one_sentence_and_exit_code_1(data_dir, tmp_path, arguments, words):
    filled = [argument.format(tmp=tmp_path) for argument in arguments]
    data = [] if filled[0] in ("check", "train") else ["--data-dir", str(data_dir)]
    done = osf(*filled, *data)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("osf: ")
    assert words in last
    assert "Traceback" not in done.stderr


def test_a_wrong_call_is_exit_code_2():
    assert osf("fly").returncode == 2
    assert osf("collect", "pushes", "--out", "a.h5", "--episodes", "many").returncode == 2
