import os
import signal
from concurrent.futures import Future

import numpy as np
import pytest

from app.processes.client import MAX_PENDING, ProcessBusy, ProcessClient, ProcessFrozen, ProcessUnavailable
from app.processes.messages.scene_messages import Act, AdoptScene, CreateScene, ResetScene, SceneChanged, TakeImage
from app.processes.sim_process import simulation_main
from osfcore.errors import OverlappingObjects, UnknownName
from osfcore.geometry.poses import Pose
from osfcore.world.simulators import default_simulator
from tests.app.conftest import until
from tests.support.errors import about


class Desk:
    """What the web process would keep: the latest record of each scene."""

    def __init__(self):
        self.records, self.lost = {}, 0

    def greeting(self):
        return [AdoptScene(record) for record in self.records.values()]

    def take(self, event):
        if isinstance(event, SceneChanged):
            self.records[event.record.id] = event.record

    def lose(self):
        self.lost += 1


@pytest.fixture
def desk():
    return Desk()


def simulation(library, desk, answer_s=30.0):
    return ProcessClient(
        simulation_main,
        (library.root, 2, default_simulator()),
        "simulation",
        answer_s=answer_s,
        keeps_running=True,
        greeting=desk.greeting,
        on_event=desk.take,
        on_lost=desk.lose,
    )


@pytest.fixture
def link(library, desk):
    link = simulation(library, desk)
    link.start()
    yield link
    link.stop()
    link.stop()


def create(link, scene="a", names=("003_cracker_box",), poses=None):
    return link.call(CreateScene(scene, 1, "", 64, names, 1, None, poses))


def test_commands_are_answered_and_refusals_told(link):
    made = create(link)
    assert made.state.names == ("003_cracker_box",)
    with pytest.raises(UnknownName, check=about("teapot")):
        create(link, "b", ("teapot",))
    with pytest.raises(UnknownName, check=about("scene")):
        link.call(ResetScene("b"))
    assert link.status == "ready"


@pytest.mark.slow
def test_a_killed_simulation_comes_back_with_its_scenes(link, desk):
    create(link)
    moved = link.call(Act("a", (np.array([0.1, 0.1, 0.0]),)))
    process = link.process
    os.kill(process.pid, signal.SIGKILL)
    until(lambda: link.process is not process and link.status == "ready")
    assert desk.lost == 1
    after = link.call(Act("a", (np.zeros(3),)))
    assert after.time_s == pytest.approx(moved.time_s + 0.2)
    assert np.allclose(after.state.pusher, moved.state.pusher, atol=1e-6)
    assert after.revision > moved.revision


def test_waiting_commands_fail_clearly_when_it_dies(link):
    create(link)
    pending = [link.submit(TakeImage("a", "0", 1024)) for _ in range(5)]
    os.kill(link.process.pid, signal.SIGKILL)
    for future in pending[1:]:
        with pytest.raises(ProcessUnavailable):
            future.result(20)


@pytest.mark.slow
def test_a_frozen_simulation_comes_back_with_its_scenes(link, desk):
    create(link)
    frozen = link.process
    os.kill(frozen.pid, signal.SIGSTOP)
    with pytest.raises(ProcessFrozen):
        link.call(ResetScene("a"))
    until(lambda: link.process is not frozen and link.status == "ready")
    assert link.call(ResetScene("a")).state.names == ("003_cracker_box",)


@pytest.mark.slow
def test_too_much_at_once_is_refused(link):
    create(link)
    futures: list[Future] = [link.submit(TakeImage("a", "0", 48)) for _ in range(3 * MAX_PENDING)]
    outcomes = [future.exception(60) for future in futures]
    assert {type(outcome) for outcome in outcomes} == {type(None), ProcessBusy}


def test_after_stopping_nothing_is_taken(library, desk):
    link = simulation(library, desk, 5.0)
    link.start()
    link.stop()
    with pytest.raises(ProcessUnavailable):
        create(link)
    assert not link.process.is_alive()
    assert desk.lost == 0


def test_poses_overlapping_leave_no_scene(link, desk):
    poses = Pose(np.array([[0, 0, 0.2], [0, 0, 0.2]]), np.array([[1.0, 0, 0, 0]] * 2))
    with pytest.raises(OverlappingObjects):
        create(link, "c", ("003_cracker_box", "006_mustard_bottle"), poses)
    assert desk.records == {}
