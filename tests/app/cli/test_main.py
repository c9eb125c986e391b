import contextlib
import json
import os
import signal
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
    ("code", "arguments", "words"),
    [
        (2, ("collect", "object", "teapot", "--out", "{tmp}/a"), "no object named 'teapot'"),
        (1, ("collect", "object", "024_bowl", "--out", "{tmp}/a"), "osf assets fetch"),
        (2, ("collect", "object", "006_mustard_bottle", "--out", "{tmp}/a", "--size", "2000"), "between 16 and 1024"),
        (2, ("collect", "pushes", "--out", "{tmp}/a", "--objects", "9"), "between 1 and 8"),
        (1, ("collect", "pushes", "--out", "/proc/pushes.h5", "--episodes", "1"), "/proc"),
        (1, ("train", "field", "--data", "{tmp}", "--out", "{tmp}/a.safetensors"), "anno.json"),
        (2, ("collect", "observation", "--out", "{tmp}/a", "--names", "teapot"), "no object named 'teapot'"),
        (1, ("estimate", "--observation", "{tmp}", "--out", "{tmp}/a.json"), "no folder with an observation.json"),
        (1, ("check", "{tmp}/nothing"), "no such file"),
        (2, ("assets", "fetch", "teapot"), "teapot"),
        (2, ("assets", "fetch", "--source", "{tmp}/nowhere"), "nowhere"),
        (2, ("assets", "add", "{tmp}/nothing.obj", "--name", "x", "--mass", "1"), "nothing.obj"),
    ],
)
def test_failures_exit_with_1_and_mistakes_in_the_call_with_2_in_one_sentence(
    data_dir, tmp_path, code, arguments, words
):
    filled = [argument.format(tmp=tmp_path) for argument in arguments]
    data = [] if filled[0] in ("check", "train") else ["--data-dir", str(data_dir)]
    done = osf(*filled, *data)
    assert done.returncode == code
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("osf: ")
    assert words in last
    assert "Traceback" not in done.stderr


def test_a_wrong_call_is_exit_code_2():
    assert osf("fly").returncode == 2
    assert osf("collect", "pushes", "--out", "a.h5", "--episodes", "many").returncode == 2


@pytest.mark.parametrize("more", [(), ("--json",)])
def test_output_that_nobody_reads_is_no_traceback(tmp_path, more):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "app.cli", "assets", "list", "--data-dir", str(tmp_path), *more]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False, timeout=120)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.parametrize("more", [(), ("--json",)])
def test_output_onto_a_full_disk_is_one_sentence(tmp_path, more):
    command = [sys.executable, "-m", "app.cli", "assets", "list", "--data-dir", str(tmp_path), *more]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=120)
    assert done.returncode == 1
    assert done.stderr == "osf: No space left on device.\n"


INTERRUPTED = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
from app.cli.main import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.parametrize("module", ["tyro", "numpy", "osfcore.objects.catalogue"])
def test_an_interruption_while_it_starts_is_one_line(tmp_path, module):
    command = [sys.executable, "-c", INTERRUPTED, module, "assets", "list", "--data-dir", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "osf: interrupted\n")


@pytest.mark.slow
def test_an_interrupted_command_leaves_nothing_half_written(tmp_path):
    out = tmp_path / "table"
    command = [sys.executable, "-m", "app.cli", "collect", "table", "--out", str(out), "--images", "2000"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        first = process.stderr.readline()
        assert "of 2000 of table" in first
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
    assert process.returncode == 130
    assert rest.splitlines()[-1] == "osf: interrupted"
    assert "Traceback" not in rest
    assert list(tmp_path.iterdir()) == []


def help_on_a_terminal(**environment: str) -> bytes:
    """What `osf --help` writes to a terminal."""
    screen, terminal = os.openpty()
    env = {**os.environ, "TERM": "xterm-256color", **environment}
    subprocess.run([sys.executable, "-m", "app.cli", "--help"], stdout=terminal, env=env, check=True, timeout=120)
    os.close(terminal)
    text = b""
    with contextlib.suppress(OSError):  # how the end of a terminal is seen
        while part := os.read(screen, 65536):
            text += part
    os.close(screen)
    return text


def test_colours_can_be_turned_off():
    assert b"\x1b[" in help_on_a_terminal(NO_COLOR="")
    assert b"\x1b[" not in help_on_a_terminal(NO_COLOR="1")


def test_the_list_of_commands_needs_no_heavy_package():
    heavy = ("numpy", "torch", "cv2", "pydantic", "rich")
    code = (
        "import sys; from app.cli.main import main\n"
        "try: main(['--help'])\n"
        f"except SystemExit: print([name for name in {heavy} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stderr == "[]\n"
