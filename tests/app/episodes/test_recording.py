import socket
import threading

import msgspec
import numpy as np
import pytest
import viser
import zstandard

from app.episodes.recording import write_recording
from osfcore.errors import CannotWrite
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, STEP_S
from tests.app.conftest import until
from tests.support.errors import about

NAMES = ("009_gelatin_box", "005_tomato_soup_can")


def state(step: int) -> SceneState:
    """The box goes and turns, the can stays, the pusher comes."""
    places = np.array([[0.05 * step, 0, 0.015], [0, 0.15, 0.05]])
    turns = quaternion_exp(np.array([[0, 0, 0.2 * step], [0, 0, 0]]))
    pusher = np.array([0.05 * step - 0.1, 0, PUSHER_CENTRE_Z_M])
    return SceneState(NAMES, Pose(places, turns), Light(np.array([0.6, 0, 0.8])), pusher)


def opened(path) -> dict:
    """A recording as viser's player reads it: two lengths, and msgpack within zstd."""
    content = path.read_bytes()
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(content[8:])
    assert len(inner) == int.from_bytes(content[:8], "little")
    return msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])


def told(content, node, what):
    """When and how a property of a node is set."""
    kind = {"position": "SetPositionMessage", "wxyz": "SetOrientationMessage"}[what]
    return [(t, m[what]) for t, m in content["messages"] if m["type"] == kind and m["name"] == node]


@pytest.fixture
def servers(monkeypatch):
    made, build = [], viser.ViserServer

    def noted(*args, **more):
        made.append(build(*args, **more))
        return made[-1]

    monkeypatch.setattr(viser, "ViserServer", noted)
    return made


def is_silent(server) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", server.get_port())) != 0


@pytest.mark.parametrize("count", [1, 3])
def test_every_state_is_there_for_its_time(library, tmp_path, count):
    path = tmp_path / "new" / "episode.viser"
    states = [state(step) for step in range(count)]
    write_recording(path, library, iter(states))
    content = opened(path)
    assert content["durationSeconds"] == pytest.approx(count * STEP_S)
    for node, poses in (
        ("/objects/009_gelatin_box", [s.poses[0] for s in states]),
        ("/pusher", [Pose(s.pusher, np.array([1.0, 0, 0, 0])) for s in states]),
    ):
        times, places = zip(*told(content, node, "position")[-count:], strict=True)
        np.testing.assert_allclose(times, STEP_S * np.arange(count), atol=1e-12)
        np.testing.assert_allclose(places, [pose.position for pose in poses], atol=1e-9)
    turns = [turn for t, turn in told(content, "/objects/009_gelatin_box", "wxyz") if t > 0]
    assert len(turns) == count - 1
    for turn, later in zip(turns, states[1:], strict=True):
        np.testing.assert_allclose(turn, later.poses.quaternion[0], atol=1e-9)
    assert [place for _, place in told(content, "/lamp", "position")][-1] == pytest.approx([0.6, 0, 0.8])


def test_meshes_are_within_and_come_first(library, tmp_path):
    write_recording(tmp_path / "a.viser", library, [state(0), state(1)])
    meshes = {m["name"]: t for t, m in opened(tmp_path / "a.viser")["messages"] if m["type"] == "GlbMessage"}
    assert meshes == {f"/objects/{name}": 0.0 for name in NAMES}
    assert (tmp_path / "a.viser").stat().st_size > 100_000
    assert [path.name for path in tmp_path.iterdir()] == ["a.viser"]


def test_nothing_is_said_and_no_server_is_left(library, tmp_path, servers, capfd):
    before = set(threading.enumerate())
    write_recording(tmp_path / "a.viser", library, [state(0)])
    assert [is_silent(server) for server in servers] == [True]
    until(lambda: set(threading.enumerate()) <= before)
    assert capfd.readouterr() == ("", "")


def test_neither_is_one_left_where_nothing_can_be_written(library, tmp_path, servers):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, check=about("file")):
        write_recording(tmp_path / "file" / "a.viser", library, [state(0)])
    assert [is_silent(server) for server in servers] == [True]
