"""Whether a goal suits a table: what is asked of the process that looks, and what people are told."""

from dataclasses import replace

import numpy as np
import pytest

from app.processes.client import ProcessUnavailable
from app.processes.messages.neural_messages import CheckPhoto
from app.services.fields import MissingFields
from app.services.goals import GoalChecks, GoalRefused, NoTable
from app.storage.photos import PhotoCrop
from app.storage.records import GoalRecord, GoalStore, PhotoRecord
from osfcore.errors import UnknownName
from osfcore.estimation.steps import ContentCheck
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from tests.app.storage.test_database import record
from tests.app.storage.test_records import PNG
from tests.support.errors import about

LABELS = {"x": "Cracker box", "y": "Mug", "z": "Bowl"}


def scene(key, *names):
    poses = Pose(np.zeros((len(names), 3)), np.tile([1.0, 0, 0, 0], (len(names), 1)))
    return replace(record(), id=key, state=SceneState(names, poses, Light(np.array([0, 0, 1.0])), None))


SCENES = {"s": scene("s", "x", "y"), "t": scene("t", "z")}


class Scenes:
    current = "s"

    def get(self, key):
        if key not in SCENES:
            raise UnknownName("scene", key, SCENES)
        return SCENES[key]


class Link:
    """Answers what it is told to, and remembers what it was asked."""

    def __init__(self):
        self.asked, self.verdict, self.error = [], "shown", None

    def call(self, order):
        self.asked.append(order)
        if self.error is not None:
            raise self.error
        return ContentCheck(self.verdict)


class Fields:
    def __init__(self):
        self.trained = {}

    def names(self):
        return ("x", "y")

    def stamp(self, name):
        return self.trained.get(name)


@pytest.fixture
def link():
    return Link()


@pytest.fixture
def goals(tmp_path):
    goals = GoalStore(tmp_path / "goals", 10)
    photo = PhotoRecord(100, 80, PhotoCrop(0, 0, 80))
    uploaded = GoalRecord("photo", "Mine", "2026", "upload", None, goal_camera(64), None, photo=photo)
    goals.keep(uploaded, PNG)
    for key, names, home in (("made", "xy", "s"), ("other", "z", "t"), ("orphan", "z", "gone")):
        poses = tuple((name, Pose(np.zeros(3), np.array([1.0, 0, 0, 0]))) for name in names)
        goals.keep(replace(uploaded, id=key, source="composed", scene=home, poses=poses, photo=None), PNG)
    return goals


@pytest.fixture
def fields():
    return Fields()


@pytest.fixture
def checks(goals, link, fields):
    return GoalChecks(Scenes(), fields, goals, link, lambda: LABELS)


@pytest.mark.parametrize(
    ("verdict", "is_refused", "words"),
    [
        ("shown", False, ""),
        ("doubtful", False, "not certain that this photo shows the cracker box and the mug"),
        ("bare", True, "Nothing can be seen on the table"),
        ("others", True, "does not seem to show the cracker box and the mug"),
        ("elsewhere", True, "does not show the table as the goal camera sees it"),
    ],
)
def test_what_a_photo_shows_is_told_in_words(checks, link, verdict, is_refused, words):
    link.verdict = verdict
    check = checks.check("photo")
    assert (check.verdict, check.is_refused) == (verdict, is_refused)
    assert words in check.text
    assert bool(check.text) == (verdict != "shown")
    if is_refused:
        with pytest.raises(GoalRefused, match=check.text[:20]):
            checks.require("photo", "s")
    else:
        checks.require("photo", "s")


def test_a_photo_is_looked_at_once_until_it_is_cropped(checks, link, goals):
    for _ in range(3):
        checks.check("photo", "s")
    (order,) = link.asked
    assert isinstance(order, CheckPhoto)
    assert (order.photo, order.state.names, order.camera.width) == (PNG, ("x", "y"), 64)
    goals.replace(replace(goals.get("photo"), photo=PhotoRecord(100, 80, PhotoCrop(10, 0, 80))), PNG)
    checks.check("photo")
    assert len(link.asked) == 2


def test_a_photo_is_looked_at_again_with_another_field(checks, link, fields):
    checks.check("photo", "s")
    fields.trained["x"] = 1
    checks.check("photo", "s")
    assert len(link.asked) == 2


def test_where_nothing_can_look_at_photos_the_episode_has_to(checks, link):
    link.error = ProcessUnavailable("neural renderer", "stopped unexpectedly")
    checks.require("photo", "s")


def test_a_goal_made_here_is_known_without_looking(checks, link):
    assert checks.check("made").verdict == "shown"
    assert link.asked == []


@pytest.mark.parametrize(("goal", "home"), [("other", "t"), ("orphan", None)])
def test_a_goal_for_another_table_names_that_table(checks, goal, home):
    check = checks.check(goal, "s")
    assert (check.verdict, check.scene, check.is_refused) == ("other table", home, True)
    assert "another table, with the bowl" in check.text


def test_without_a_table_a_goal_or_a_field_there_is_nothing_to_compare(checks, monkeypatch):
    with pytest.raises(UnknownName, check=about("goal")):
        checks.check("none")
    with pytest.raises(MissingFields, check=about("z")):
        checks.check("photo", "t")
    monkeypatch.setattr(Scenes, "current", None)
    with pytest.raises(NoTable):
        checks.check("photo")
