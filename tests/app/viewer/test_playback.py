import time

import numpy as np
import pytest

from app.processes.messages.scene_messages import FramesTaken, SceneChanged, SceneRecord
from app.services.event_hub import CurrentScene
from app.viewer.playback import Playback
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from tests.app.conftest import until


class Sketch:
    """A drawing that remembers what was drawn, and when."""

    def __init__(self):
        self.shown, self.places, self.frames = [], [], 0

    def show(self, record):
        self.shown.append(record and record.id)

    def place(self, state):
        self.places.append((time.monotonic(), state.pusher[0]))

    def show_frames(self, names, images):
        self.frames += 1


def state(x):
    nothing = Pose(np.zeros((0, 3)), np.zeros((0, 4)))
    return SceneState((), nothing, Light(np.array([0, 0, 1.0])), np.array([x, 0, 0]))


def record(x, scene="a"):
    return SceneRecord(scene, 0, "", 128, state(0), state(x), 0.0, 1)


@pytest.fixture
def sketch():
    return Sketch()


@pytest.fixture
def playback(sketch):
    playback = Playback(sketch)
    playback.start()
    playback.note(CurrentScene(record(0)))
    yield playback
    playback.stop()
    playback.stop()


def test_states_are_played_in_order_at_their_pace(sketch, playback):
    playback.note(SceneChanged(record(9), tuple(state(x) for x in range(10)), 0.02))
    until(lambda: len(sketch.places) == 11)
    assert [x for _, x in sketch.places] == [*range(10), 9]
    assert sketch.places[-1][0] - sketch.places[0][0] >= 0.15


def test_a_jump_overtakes_what_waits(sketch, playback):
    playback.note(SceneChanged(record(1), tuple(state(0.001 * x) for x in range(1000)), 0.05))
    until(lambda: len(sketch.places) > 2)
    playback.note(SceneChanged(record(7)))
    until(lambda: sketch.places[-1][1] == 7)
    assert len(sketch.places) < 100


def test_far_behind_it_hurries(sketch, playback):
    start = time.monotonic()
    for _ in range(10):
        playback.note(SceneChanged(record(3), tuple(state(1) for _ in range(20)), 0.5))  # 100 s in all
    until(lambda: len(sketch.places) == 210)
    assert time.monotonic() - start < 60


def test_other_scenes_are_not_drawn(sketch, playback):
    playback.note(SceneChanged(record(5, "b"), (state(5),), 0.01))
    playback.note(FramesTaken("b", 1, (), np.zeros((0, 1, 1, 3), np.uint8), ()))
    playback.note(FramesTaken("a", 1, (), np.zeros((0, 1, 1, 3), np.uint8), ()))
    until(lambda: sketch.frames == 1)
    assert sketch.places == []
    playback.note(CurrentScene(None))
    until(lambda: sketch.shown == ["a", None])
    assert playback.shown is None
