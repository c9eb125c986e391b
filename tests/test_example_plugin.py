"""The example of a plugin, installed as pip installs it."""

import contextlib
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from app.cli.main import main
from app.episodes.record import PartNames
from app.episodes.request import EpisodeOrder, given, parts_of
from osfcore.control.estimators import ESTIMATOR
from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.io.image_file import to_uint8, write_png
from osfcore.planning.parts import COST, PLANNER
from osfcore.plugins import part_names
from osfcore.world import tabletop as worlds
from osfcore.world.tabletop import WORLD, WORLDS, Tabletop
from tests.support.errors import about

ROOT = Path(__file__).parents[1]
SOURCE, GUIDE = ROOT / "examples" / "plugin", ROOT / "docs" / "how-to" / "extending.md"
NAME = "009_gelatin_box"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder in which pip has installed it."""
    place = tmp_path_factory.mktemp("plugin")
    shutil.copytree(SOURCE, place / "source")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps")
    subprocess.run([*pip, "--no-build-isolation", "--target", place / "site", place / "source"], check=True)
    return place / "site"


@pytest.fixture
def installed(built, monkeypatch):
    monkeypatch.syspath_prepend(built)


def test_its_parts_are_listed_beside_ours(installed):
    assert set(part_names(WORLD, WORLDS)) >= {"simulated", "slippery"}
    assert [part_names(kind, {}) for kind in (COST, PLANNER, ESTIMATOR)] == [("last",), ("shooting",), ("daylight",)]


def test_an_unknown_part_is_told_before_anything_begins(tmp_path, data_dir, capsys):
    assert main(["episode", "--out", str(tmp_path / "out"), "--planner", "luck", "--data-dir", str(data_dir)]) == 2
    assert capsys.readouterr().err.endswith("osf: There is no planner named 'luck'; known: mppi.\n")
    with pytest.raises(UnknownName, check=about("world")):
        given(EpisodeOrder(tmp_path, data_dir, (NAME,), parts=PartNames(world="real")))


def test_its_world_is_pushed(installed, data_dir, tmp_path):
    """On half the friction, a push leads elsewhere."""
    ends = []
    for world in ("simulated", "slippery"):
        with contextlib.closing(
            given(EpisodeOrder(tmp_path, data_dir, (NAME,), parts=PartNames(world))).world
        ) as table:
            start = table.truth()
            way = start.poses.position[0] - start.pusher
            for _ in range(12):
                table.act(np.array([*(0.3 * way[:2] / np.abs(way[:2]).max()), 0.0]))
            ends.append(table.truth().poses.position[0] - start.poses.position[0])
    assert np.linalg.norm(ends[0]) > 0.01
    assert np.linalg.norm(ends[0] - ends[1]) > 1e-4


class Elsewhere:
    """A world that does only what it must."""

    def __init__(self, asked):
        self._table = Tabletop(asked.library, request=asked.request)
        for name in ("reset", "observe", "act", "close", "truth", "render"):
            setattr(self, name, getattr(self._table, name))


def test_a_world_without_our_table_takes_a_goal_image(data_dir, tmp_path, monkeypatch):
    monkeypatch.setitem(worlds.WORLDS, "elsewhere", Elsewhere)
    order = EpisodeOrder(tmp_path, data_dir, (NAME,), parts=PartNames("elsewhere"))
    with pytest.raises(InvalidInput, check=about("world")):
        given(order)
    camera = goal_camera(64)
    with contextlib.closing(Tabletop(worlds.AssetLibrary(data_dir / "objects"))) as table:
        table.arrange(0)
        write_png(tmp_path / "goal.png", to_uint8(table.render((camera,), with_pusher=False).images[0]))
    begin = given(EpisodeOrder(tmp_path, data_dir, (NAME,), goal=tmp_path / "goal.png", parts=PartNames("elsewhere")))
    with contextlib.closing(begin.world):
        assert begin.world.truth().names == (NAME,)
        assert begin.goal.image.shape == (64, 64, 3)
        assert (begin.truth, begin.moved) == (None, ())


@pytest.mark.slow
def test_the_command_of_the_docs_makes_an_episode_of_its_parts(installed, data_dir, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (command,) = re.findall(r"```console\n(.*?)\n```", GUIDE.read_text(), flags=re.DOTALL)
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(io.StringIO()):
        code = main([*shlex.split(command)[1:], "--json", "--data-dir", str(data_dir)])
    report = json.loads(said.getvalue().splitlines()[-1])
    assert code == 0
    named = {"world": "slippery", "cost": "last", "planner": "shooting", "estimator": "daylight"}
    assert report["parts"] == named
    renewed = max((one["step"] for one in report["noticed"]), default=0)  # a lamp that is not overhead may be noticed
    assert report["outcome"] == "reached" or 2 <= report["steps_done"] <= renewed + 2


def test_its_estimators_hold_the_light(installed, data_dir):
    parts = parts_of(PartNames(estimator="daylight", planner="shooting", cost="last"), data_dir)
    np.testing.assert_allclose(parts.estimators.first.held_light, (0, 0, 1), atol=1e-12)
