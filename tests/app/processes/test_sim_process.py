import io
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import Pipe
from threading import Thread

import numpy as np
import pytest
from PIL import Image

from app.processes.messages.scene_messages import (
    Act,
    ComposedGoal,
    ComposeGoal,
    CreateScene,
    DropScene,
    EditScene,
    FramesTaken,
    ObserveScene,
    ResetScene,
    SceneChanged,
    ShowScene,
    TakeImage,
    TakeMask,
    TakeView,
    WatchFrames,
)
from app.processes.server import Answer, ProcessServer, Ready, Request
from app.processes.sim_process import Simulation
from osfcore.errors import InvalidInput, OsfError, OverlappingObjects, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import STEP_S
from osfcore.inspection.overlays import MASK_COLOURS, tint_masks

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"


class Director:
    """The other end of a simulation that runs in a thread."""

    def __init__(self, library, max_live_worlds, simulator):
        self._ours, self._theirs = Pipe()
        self._executor = ThreadPoolExecutor(2)
        server = ProcessServer(self._theirs, "simulation")
        self._simulation = Simulation(server.send, library, self._executor, max_live_worlds, simulator)
        serve = {"idle": self._simulation.idle}
        self._thread = Thread(target=server.serve, args=(self._simulation.carry_out,), kwargs=serve)
        self._thread.start()
        assert isinstance(self.next(), Ready)
        self._number = 0
        self.events = []

    def call(self, command):
        self._number += 1
        self._ours.send(Request(self._number, command))
        while True:
            message = self.next()
            if isinstance(message, Answer):
                assert message.number == self._number
                return message.error or message.value
            self.events.append(message)

    def next(self):
        assert self._ours.poll(20)
        return self._ours.recv()

    def close(self):
        self._ours.close()
        self._thread.join()
        self._simulation.close()
        self._executor.shutdown()
        self._theirs.close()


@pytest.fixture(params=["pybullet", "mujoco"])
def director(request, library):
    pytest.importorskip(request.param)
    director = Director(library, max_live_worlds=1, simulator=request.param)
    yield director
    director.close()


def create(director, scene="a", names=(BOX, BOTTLE), seed=1, **fields):
    return director.call(CreateScene(scene, seed, "now", 64, names, 2, fields.get("light"), fields.get("poses")))


def changes(director):
    return [event for event in director.events if isinstance(event, SceneChanged)]


def test_acting_tells_the_way_and_the_end(director):
    made = create(director)
    director.events.clear()
    end = director.call(Act("a", (np.array([0.1, 0, 0]), np.array([0, 0.1, 0]))))
    first, second = changes(director)
    assert (first.record.revision, second.record.revision) == (made.revision + 1, made.revision + 2)
    assert end.revision == second.record.revision
    for change in (first, second):
        assert len(change.states) * change.interval_s == pytest.approx(STEP_S)
        assert 0.01 < change.interval_s < 0.05
        assert np.array_equal(change.states[-1].poses.position, change.record.state.poses.position)
    way = [state.pusher[0] for state in first.states]
    assert way == sorted(way)


def test_a_scene_that_left_memory_comes_back_as_it_was(director):
    create(director, "a")
    before = director.call(Act("a", (np.array([0.1, 0.1, 0]),)))
    create(director, "b", seed=2)  # only one simulation stays
    after = director.call(Act("a", (np.zeros(3),)))
    assert after.time_s == pytest.approx(before.time_s + STEP_S)
    assert np.allclose(after.state.poses.position, before.state.poses.position, atol=2e-3)
    back = director.call(ResetScene("a"))
    assert np.allclose(back.state.poses.position, back.initial.poses.position, atol=1e-9)
    assert back.time_s == 0


def test_what_is_let_go_in_the_air_falls(director):
    create(director)
    up = Pose(np.array([0.0, 0.0, 0.35]), np.array([1.0, 0, 0, 0]))
    held = director.call(EditScene("a", poses=((BOX, up),)))
    assert held.state.pose(BOX).position[2] == pytest.approx(0.35)
    director.events.clear()
    fallen = director.call(EditScene("a", poses=((BOX, up),), settle=True))
    assert fallen.state.pose(BOX).position[2] < 0.3
    heights = [state.pose(BOX).position[2] for change in changes(director) for state in change.states]
    assert heights[0] > heights[-1]
    assert len(changes(director)[0].states) == 0  # the jump


def test_light_is_given_or_drawn_from_the_seed(director):
    light = Light(np.array([0.0, 0.6, 0.8]))
    assert np.allclose(create(director, light=light).state.light.position, light.position)
    first, second = create(director, "b", seed=5), create(director, "c", seed=5)
    assert np.array_equal(first.state.light.position, second.state.light.position)


def test_refusals_change_nothing(director):
    made = create(director)
    for command in (
        EditScene("a", poses=(("teapot", Pose.identity()),)),
        EditScene("a", poses=(("teapot", Pose.identity()), (BOX, Pose.identity()))),
        EditScene("a", poses=((BOX, made.state.pose(BOTTLE)),)),
        Act("a", (np.array([1.0, 0, 0]),)),
        TakeImage("a", "9", 64),
        TakeImage("a", "0", 4),
        TakeMask("a", "0", "teapot", 64),
        ResetScene("z"),
    ):
        assert isinstance(director.call(command), OsfError)
    assert director.call(DropScene("a")) is None
    assert isinstance(director.call(ResetScene("a")), OsfError)


def test_live_images_come_when_watched_and_only_after_changes(director):
    create(director)
    director.call(ShowScene("a"))
    director.call(WatchFrames(True))
    taken = director.next()
    assert isinstance(taken, FramesTaken)
    assert taken.images.shape == (4, 64, 64, 3)
    assert len(taken.jpegs) == 4
    moved = director.call(Act("a", (np.array([0.1, 0, 0]),)))
    while not (isinstance(taken, FramesTaken) and taken.revision == moved.revision):
        taken = director.events.pop() if director.events else director.next()
    director.call(WatchFrames(False))
    director.events.clear()
    director.call(Act("a", (np.array([0.1, 0, 0]),)))
    assert not any(isinstance(event, FramesTaken) for event in director.events)


def test_pictures_and_masks_belong_together(director):
    create(director)
    mask = np.array(Image.open(io.BytesIO(director.call(TakeMask("a", "0", BOX, 64)))))
    plain = np.array(Image.open(io.BytesIO(director.call(TakeImage("a", "0", 64)))))
    drawn = np.array(Image.open(io.BytesIO(director.call(TakeImage("a", "0", 64, masks=True)))))
    expected = (plain[mask > 0].astype(int) + MASK_COLOURS[0]) // 2
    assert np.array_equal(drawn[mask > 0], expected)


def test_masks_are_drawn_over_where_they_are():
    image = np.full((4, 4, 3), 100, np.uint8)
    masks = np.zeros((10, 4, 4), bool)
    masks[9, 1, 2] = True
    drawn = tint_masks(image, masks)
    assert np.array_equal(drawn[1, 2], (100 + MASK_COLOURS[1].astype(int)) // 2)
    assert np.array_equal(image, np.full((4, 4, 3), 100))
    assert (drawn != image).any(axis=-1).sum() == 1


def test_a_scene_is_observed_as_the_robot_sees_it_and_nothing_tells_the_truth(director):
    made = create(director)
    seen = director.call(ObserveScene("a", goal=False, masks=True))
    assert np.array_equal(seen.record.state.poses.position, made.state.poses.position)
    first = seen.observation
    assert [camera.name for camera in first.cameras] == ["0", "1", "2", "3"]
    assert first.names == (BOX, BOTTLE)
    assert first.images.shape == (4, 64, 64, 3)
    assert first.masks.any(axis=(0, 2, 3)).all()
    np.testing.assert_allclose(first.pusher, made.state.pusher, atol=1e-12)
    np.testing.assert_allclose(first.images * 255, np.round(first.images * 255), atol=1e-4)  # as of a camera's 8 bits
    goal = director.call(ObserveScene("a", goal=True, masks=False)).observation
    assert [camera.name for camera in goal.cameras] == ["goal"]
    assert goal.masks is None
    assert goal.pusher is None
    assert isinstance(director.call(ObserveScene("b", goal=False, masks=True)), UnknownName)


def pixels(png):
    return np.array(Image.open(io.BytesIO(png)), int)


@pytest.fixture
def used(director):
    """A scene in which something was pushed already."""
    create(director, light=Light(np.array([0.0, 0.6, 0.8])))
    record = director.call(Act("a", (np.array([0.1, 0.1, 0]),) * 2))
    director.events.clear()
    return record


def is_as_it_was(director, record):
    """Whether a scene is where and when it was, to the next command too, and nobody was told of anything."""
    assert changes(director) == []
    now = director.call(Act("a", ()))
    assert now.time_s == pytest.approx(record.time_s)
    np.testing.assert_allclose(now.state.pusher, record.state.pusher, atol=1e-6)
    np.testing.assert_allclose(now.state.poses.position, record.state.poses.position, atol=1e-6)
    np.testing.assert_allclose(now.state.light.position, record.state.light.position, atol=1e-12)
    later = director.call(Act("a", (np.zeros(3),)))
    return later.time_s == pytest.approx(record.time_s + STEP_S)


@pytest.mark.parametrize(
    ("asked", "moved"),
    [({}, 0), ({"poses": (BOX,)}, 1), ({"seed": 3, "moved": 2}, 2), ({"light": Light(np.array([1.0, 0, 1]))}, 0)],
)
def test_a_goal_is_composed_and_the_scene_and_its_time_stay(director, used, asked, moved):
    start = used.state
    up = {name: Pose(start.pose(name).position + [0, 0.08, 0], start.pose(name).quaternion) for name in (BOX,)}
    asked = {**asked, "poses": tuple((name, up[name]) for name in asked.get("poses", ()))}
    made = director.call(ComposeGoal("a", **asked, size=64))
    assert isinstance(made, ComposedGoal)
    assert [name for name, _ in made.poses] == list(start.names)
    assert pixels(made.png).shape == (64, 64, 3)
    far = [np.linalg.norm(pose.position - start.pose(name).position) > 0.02 for name, pose in made.poses]
    assert sum(far) == moved
    assert is_as_it_was(director, used)


@pytest.mark.parametrize(
    ("asked", "kind"),
    [
        ({"poses": (("teapot", Pose.identity()),)}, UnknownName),
        ({"poses": ((BOX, Pose(np.array([9.0, 0, 0.1]), np.array([1.0, 0, 0, 0]))),)}, InvalidInput),
        ({"seed": 0, "moved": 3}, InvalidInput),
        ({"size": 4}, InvalidInput),
        ({"poses": BOTTLE}, OverlappingObjects),
    ],
)
def test_a_goal_that_cannot_be_leaves_the_scene_and_its_time_too(director, used, asked, kind):
    if asked.get("poses") == BOTTLE:
        asked = {"poses": ((BOX, used.state.pose(BOTTLE)),)}
    assert type(director.call(ComposeGoal("a", **asked))) is kind
    assert is_as_it_was(director, used)


def test_a_goal_of_a_scene_that_left_memory_or_never_was(director, used):
    create(director, "b", seed=2)  # only one simulation stays
    director.events.clear()
    made = director.call(ComposeGoal("a", size=64))
    np.testing.assert_allclose(dict(made.poses)[BOX].position, used.state.pose(BOX).position, atol=2e-3)
    assert is_as_it_was(director, used)
    assert isinstance(director.call(ComposeGoal("z")), UnknownName)


def test_a_goal_shows_what_the_goal_camera_would_see_without_the_pusher(director, used):
    made = director.call(ComposeGoal("a", size=64))
    plain = director.call(TakeView("a", goal_camera(64), pusher=False)).astype(int)
    assert np.abs(pixels(made.png) - plain).mean() < 1  # what was pushed may settle a little
    lit = director.call(ComposeGoal("a", light=Light(np.array([1.0, 0, 0.3])), size=64))
    assert np.abs(pixels(lit.png) - plain).mean() > 2


def test_any_camera_may_look(director, used):
    camera = replace(goal_camera(96), name="mine", height=64)
    command = pickle.loads(pickle.dumps(TakeView("a", camera)))  # as it comes over
    seen = director.call(command)
    assert seen.shape == (64, 96, 3)
    square = director.call(TakeView("a", goal_camera(64)))
    without = director.call(TakeView("a", goal_camera(64), pusher=False)).astype(int)
    assert (square != without).any()
    np.testing.assert_array_equal(square, pixels(director.call(TakeImage("a", "goal", 64))))
    assert isinstance(director.call(TakeView("z", camera)), UnknownName)
    assert is_as_it_was(director, used)
