"""The threads that draw: nothing stays undrawn, nothing is drawn too often, and changes keep their pace."""

import threading
import time

import numpy as np
import pytest

from app.processes.messages.scene_messages import SceneChanged, SceneRecord
from app.services.event_hub import CurrentScene
from app.viewer.drawing import DrawingThread, Playback
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from tests.app.conftest import until


class Counted:
    """A thread that counts its drawings, and what had been noted when each began."""

    def __init__(self, interval_s=0.0, draw=lambda: None):
        self.noted, self.drawn, self.at = 0, [], []
        self._also = draw
        self.thread = DrawingThread("counted", self._draw, interval_s)

    def _draw(self):
        with self.thread.changed:
            self.drawn.append(self.noted)
        self.at.append(time.monotonic())
        self._also()

    def note(self, after_s=0.0):
        with self.thread.changed:
            self.noted += 1
            self.thread.wake(after_s)


@pytest.fixture
def make():
    made = []

    def make(*args, **kwargs):
        made.append(Counted(*args, **kwargs))
        made[-1].thread.start()
        return made[-1]

    yield make
    for counted in made:
        counted.thread.stop()


def test_nothing_is_drawn_before_something_is_noted(make):
    counted = make()
    assert counted.thread.is_idle
    time.sleep(0.05)
    assert counted.drawn == []


def test_what_is_noted_while_it_draws_is_drawn_afterwards(make):
    begun, go_on = threading.Event(), threading.Event()

    def wait():
        begun.set()
        go_on.wait(5)

    counted = make(draw=wait)
    counted.note()
    assert begun.wait(5)
    counted.note()
    counted.note()
    assert not counted.thread.is_idle
    go_on.set()
    until(lambda: counted.thread.is_idle)
    assert counted.drawn == [1, 3]


def test_many_notes_are_drawn_no_more_often_than_asked_for_and_the_last_one_is(make):
    counted = make(interval_s=0.05)
    for _ in range(60):
        counted.note()
        time.sleep(0.003)
    until(lambda: counted.thread.is_idle)
    assert counted.drawn[-1] == 60
    assert all(after - before >= 0.045 for before, after in zip(counted.at, counted.at[1:], strict=False))


def test_it_can_be_woken_later_and_sooner_than_that(make):
    counted = make()
    start = time.monotonic()
    counted.note(after_s=1.0)
    assert counted.thread.is_idle  # nothing is due yet
    until(lambda: counted.drawn)
    assert counted.at[0] - start >= 0.995
    counted.note(after_s=1000)
    counted.note()
    until(lambda: counted.drawn == [1, 3])


def test_a_defect_is_logged_and_what_is_noted_next_is_drawn(make, caplog):
    counted = make(draw=lambda: 1 / 0)
    counted.note()
    until(lambda: counted.thread.is_idle)
    counted.note()
    until(lambda: counted.thread.is_idle)
    assert counted.drawn == [1, 2]
    assert "counted could not draw" in caplog.text
    assert "ZeroDivisionError" in caplog.text


def test_after_it_was_stopped_nothing_is_drawn(make):
    counted = make(interval_s=10)
    counted.note()
    until(lambda: counted.thread.is_idle)
    counted.note()
    counted.thread.stop()  # at once, although the next drawing is due much later
    counted.thread.stop()
    counted.note()
    assert counted.drawn == [1]


def test_one_that_never_began_can_be_stopped():
    DrawingThread("never", lambda: None).stop()


class Sketch:
    """A drawing that remembers what was drawn, and when."""

    def __init__(self):
        self.shown, self.places = [], []

    def show(self, state):
        self.shown.append(state)

    def place(self, state):
        self.places.append((time.monotonic(), state.pusher[0]))


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
    playback.note(CurrentScene(None))
    until(lambda: len(sketch.shown) == 2)
    assert sketch.places == []
    assert sketch.shown[-1] is None
