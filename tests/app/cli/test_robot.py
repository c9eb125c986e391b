import contextlib
import json
import os
import re
import shlex
import termios
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.cli.main import main
from app.cli.robot import stop_on_key
from osfcore.contrib.robots.connect import connect
from osfcore.contrib.robots.robot import RobotRefused
from osfcore.control import estimators
from osfcore.io.image_file import write_png
from tests.live import free_port
from tests.support.robots import NAMES, example, know_truth, serving, simulated, toward_middle, until
from tests.support.ros_robots import StandIn

GUIDE = Path(__file__).parents[3] / "docs" / "how-to" / "robots.md"
SMALL = ("--samples", "16", "--horizon", "6", "--steps", "2")


@pytest.fixture(scope="module")
def server(library):
    with contextlib.closing(simulated(library)) as table, serving(example().robot(table)) as url:
        yield url, table


@pytest.fixture
def robot(server, tmp_path, monkeypatch):
    """The robot, its scene as at the beginning, a goal beside it, and estimators that are told the truth."""
    url, table = server
    start = table.truth()
    wanted = toward_middle(start)
    write_png(tmp_path / "0.png", np.zeros((64, 64, 3), np.uint8))

    know_truth(monkeypatch, table, wanted)
    yield url, table
    table.restore(start)


def drive(url, place, *more):
    arguments = ["robot", "drive", url, "--goal", str(place / "0.png"), "--out", str(place / "out"), *SMALL, *more]
    return main([*arguments, "--data-dir", str(place / "data"), "--names", *NAMES])


def report(place):
    return json.loads((place / "out" / "report.json").read_text())


def answering(monkeypatch, answer):
    asked = []

    def ask(question):
        asked.append(question)
        if answer is None:
            raise EOFError
        return answer

    monkeypatch.setattr("builtins.input", ask)
    return asked


def test_check_shows_where_the_cameras_are(server, tmp_path, capsys):
    assert main(["robot", "check", server[0], "--out", str(tmp_path / "seen")]) == 0
    assert {path.name for path in (tmp_path / "seen").iterdir()} == {"overlay.png", "0.png", "1.png", "2.png", "3.png"}
    said = capsys.readouterr().out
    assert "4 cameras (0, 1, 2, 3; 64 x 64)" in said
    assert "without a command it halts after 0.2 s" in said
    assert main(["robot", "check", server[0], "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["limits"] == {"box": [-0.35, -0.35, 0.35, 0.35], "top_speed_m_s": 0.43}
    assert (len(told["look_s"]), told["doubts"]) == (3, [])


def test_check_speaks_to_ros(capsys):
    with StandIn().running() as url:
        assert main(["robot", "check", url]) == 0
    assert "2 cameras (left, right; 64 x 64)" in capsys.readouterr().out


def test_nobody_there_is_told(capsys):
    assert main(["robot", "check", f"http://127.0.0.1:{free_port()}"]) == 1
    assert capsys.readouterr().err.startswith("osf: The robot at http://127.0.0.1:")


@pytest.mark.slow
def test_it_drives_within_its_limits_and_tells_what_it_knows(robot, tmp_path, capsys):
    before = robot[1].truth()
    assert drive(robot[0], tmp_path, "--yes", "--top-speed", "0.42", "--json") == 0
    told, kept = json.loads(capsys.readouterr().out), report(tmp_path)
    assert kept["outcome"] == told["outcome"] == "out of steps"
    assert (kept["steps_done"], len(kept["actions"]), len(kept["steps"])) == (2, 2, 3)
    assert kept["limits"] == {"box": [-0.35, -0.35, 0.35, 0.35], "top_speed_m_s": 0.42}
    assert set(kept["steps"][0]["to_goal_mm"]) == set(NAMES)
    assert not any("truth" in key or "truly" in key for key in kept["steps"][0])
    way = 0.2 * np.sum(kept["actions"], axis=0)
    np.testing.assert_allclose(robot[1].truth().pusher - before.pusher, way, atol=2e-3)
    assert len(list((tmp_path / "out" / "frames").iterdir())) == 3
    for file in ("goal.png", "video.mp4"):
        assert (tmp_path / "out" / file).stat().st_size > 100


@pytest.mark.parametrize("answer", ["", "n", "what?", None])
def test_it_asks_before_the_first_motion_and_stays_unless_somebody_says_yes(
    robot, tmp_path, monkeypatch, capsys, answer
):
    asked, before = answering(monkeypatch, answer), robot[1].truth()
    assert drive(robot[0], tmp_path) == 1
    assert asked == [f"Move the robot at {robot[0]}? [y/N] "]
    said = capsys.readouterr()
    assert said.err.endswith("osf: The robot was stopped: nobody allowed it to move.\n")
    assert "no faster than 0.1 m/s" in said.out
    np.testing.assert_array_equal(robot[1].truth().pusher, before.pusher)
    assert (report(tmp_path)["outcome"], report(tmp_path)["steps_done"]) == ("stopped", 0)


def test_it_moves_once_somebody_said_yes(robot, tmp_path, monkeypatch):
    asked = answering(monkeypatch, "y")
    assert drive(robot[0], tmp_path, "--box", "-0.3", "-0.3", "0.3", "0.3") == 0
    assert len(asked) == 1
    assert report(tmp_path)["limits"] == {"box": [-0.3, -0.3, 0.3, 0.3], "top_speed_m_s": 0.1}


def test_a_key_stops_it_and_what_was_done_is_kept(robot, tmp_path, monkeypatch, capsys):
    before = robot[1].truth().pusher

    @contextlib.contextmanager
    def pressed(stop):
        other = threading.Thread(
            target=lambda: (until(lambda: np.any(robot[1].truth().pusher != before)), stop("a key was pressed"))
        )
        other.start()
        yield True
        other.join()

    monkeypatch.setattr("app.cli.robot.stop_on_key", pressed)
    assert drive(robot[0], tmp_path, "--yes") == 1
    assert capsys.readouterr().err == "osf: The robot was stopped: a key was pressed.\n"
    assert report(tmp_path)["outcome"] == "stopped"
    assert report(tmp_path)["text"] == "The robot was stopped: a key was pressed."


def test_an_interruption_stops_it(robot, tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(estimators, "estimate_next", lambda *_, usual: interrupted())
    assert drive(robot[0], tmp_path, "--yes") == 130
    assert report(tmp_path)["outcome"] == "stopped"
    with contextlib.closing(connect(robot[0])) as again, pytest.raises(RobotRefused):
        again.act(np.zeros(3))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--goal-camera", "above"), "no camera of the robot for --goal-camera named 'above'"),
        (("--boxes", "left:025_mug"), "box is left:025_mug, but it must be CAMERA:NAME"),
        (("--box", "0.1", "0", "-0.1", "0.2"), "safety box"),
        (("--top-speed", "0"), "top speed"),
        (("--box", "0.4", "0.4", "0.5", "0.5"), "partly inside"),
    ],
)
def test_what_cannot_be_is_told_before_anything_moves(robot, tmp_path, capsys, more, words):
    before = robot[1].truth().pusher
    assert drive(robot[0], tmp_path, "--yes", *more) == 2
    assert words in capsys.readouterr().err
    np.testing.assert_array_equal(robot[1].truth().pusher, before)


def test_a_goal_of_another_shape_is_told(robot, tmp_path, capsys):
    write_png(tmp_path / "0.png", np.zeros((64, 80, 3), np.uint8))
    assert drive(robot[0], tmp_path, "--yes") == 2
    assert "size of 0.png [px] is 80 x 64, but it must be in proportion 64:64" in capsys.readouterr().err


def test_the_program_of_the_guide_works(server):
    (program,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), flags=re.DOTALL)
    before = server[1].truth()
    exec(program.replace("http://127.0.0.1:8080", server[0]), {})
    np.testing.assert_allclose(server[1].truth().pusher - before.pusher, [0.02, 0, 0], atol=2e-3)


@pytest.mark.slow
def test_the_commands_of_the_guide_work(library, tmp_path, monkeypatch, capsys):
    """With a real first look, at a table that has changed since the goal was photographed."""
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"```console\n(.*?)```", GUIDE.read_text(), flags=re.DOTALL)
    server, *commands = block.splitlines()
    assert server == "python examples/robot_server.py"
    with contextlib.closing(simulated(library, 256)) as table, serving(example().robot(table)) as url:
        start = table.truth()
        table.load(replace(toward_middle(start), pusher=np.array([-0.35, -0.35, start.pusher[2]])))
        for command in commands:
            assert main([*shlex.split(command.replace("http://127.0.0.1:8080", url))[1:]]) == 0
            table.restore(start)
    kept = json.loads((tmp_path / "driven" / "report.json").read_text())
    assert kept["steps_done"] == 2
    assert kept["steps"][0]["to_goal_mm"][NAMES[1]] == pytest.approx(60, abs=10)
    assert kept["steps"][0]["to_goal_mm"][NAMES[0]] < 10


@pytest.fixture
def terminal():
    keyboard, terminal = os.openpty()
    yield keyboard, terminal
    os.close(keyboard)
    os.close(terminal)


def test_a_key_stops_once_without_a_line_end(terminal):
    keyboard, screen = terminal
    reasons, told = [], threading.Event()
    with stop_on_key(lambda reason: (reasons.append(reason), told.set()), screen) as listens:
        assert listens
        os.write(keyboard, b"q")
        assert told.wait(10)
    assert reasons == ["a key was pressed"]


def test_without_a_key_nothing_stops_and_the_terminal_is_as_before(terminal):
    before, reasons = termios.tcgetattr(terminal[1]), []
    with stop_on_key(reasons.append, terminal[1]):
        assert termios.tcgetattr(terminal[1]) != before
    assert termios.tcgetattr(terminal[1]) == before
    assert reasons == []


def test_without_a_terminal_no_key_is_waited_for(tmp_path):
    with (tmp_path / "input").open("w+b") as file, stop_on_key(pytest.fail, file.fileno()) as listens:
        assert not listens
