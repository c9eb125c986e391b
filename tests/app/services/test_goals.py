"""Goals that are kept and the one that is composed; how the table is laid out is tested with the stage."""

import io
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from app.processes.client import ProcessUnavailable
from app.processes.messages.scene_messages import ComposedGoal
from app.processes.server import InternalError
from app.services.event_hub import Hub
from app.services.goals import (
    GOAL_SIDE,
    Draft,
    DraftChanged,
    DraftUnsound,
    Goals,
    GoalsChanged,
    NoDraft,
    NoPhoto,
    NoTable,
)
from app.services.scenes import SceneHeld
from app.storage.database import CannotStore
from app.storage.photos import PhotoCrop, PhotoRefused, read_photo
from app.storage.records import GoalStore, TooManyGoals
from app.storage.usage import StorageMeter
from osfcore.errors import CorruptFile, InvalidInput, OverlappingObjects, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from tests.app.storage.test_database import record
from tests.support.errors import about

OVERLAP = OverlappingObjects("x", "y", 0.003)


def picture(number):
    """A PNG like no other."""
    return encoded(np.full((4, 4, 3), number, np.uint8))


def at(x, y=0.0):
    return Pose(np.array([x, y, 0.05]), np.array([1.0, 0, 0, 0]))


class Runner:
    """A service with a scene of two objects, of which everything that is asked for comes true at once."""

    def __init__(self):
        self.hub, self.told, self.commands = Hub(), [], []
        self.hub.subscribe(self.told.append)
        self.scenes, self.current, self.error = self, "s", None
        self.storage = StorageMeter(Path())
        self.start = (("x", at(0.0)), ("y", at(0.2)))

    def get(self, scene):
        if scene != "s":
            raise UnknownName("scene", scene, ["s"])
        return replace(record(), id=scene)

    def compose(self, command):
        self.get(command.id)
        if self.error is not None:
            raise self.error
        self.commands.append(command)
        poses = dict(self.start) | dict(command.poses)
        return ComposedGoal(picture(len(self.commands)), tuple(poses.items()))

    def drafts(self):
        return [event.draft for event in self.told if isinstance(event, DraftChanged)]


@pytest.fixture
def runner():
    return Runner()


class Photos:
    """Decodes here."""

    read = staticmethod(read_photo)


@pytest.fixture
def goals(runner, tmp_path):
    goals = Goals(runner, tmp_path, max_goals=3, photos=Photos())
    goals.start()
    return goals


def encoded(pixels, kind="PNG"):
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, kind)
    return data.getvalue()


def photo(width=64, height=64, kind="PNG"):
    return encoded(np.full((height, width, 3), (200, 100, 50), np.uint8), kind)


def same(one, other):
    return [(name, pose.position.tolist()) for name, pose in one] == [(n, p.position.tolist()) for n, p in other]


# Photos


@pytest.mark.parametrize(("side", "kept"), [(64, 64), (512, 512), (1500, 512)])
@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_photo_is_kept_as_a_png_with_the_camera_at_its_size(goals, runner, side, kept, kind):
    made = goals.receive(photo(side, side, kind), "Mine")
    assert (made.source, made.name, made.scene, made.poses) == ("upload", "Mine", None, None)
    assert (made.camera.width, made.camera.height, made.camera.name) == (kept, kept, "goal")
    with Image.open(goals.image(made.id)) as image:
        assert (image.format, image.size) == ("PNG", (kept, kept))
        assert np.abs(np.asarray(image, int).mean(axis=(0, 1)) - [200, 100, 50]).max() < 4
    assert [goal.id for goal in goals.all()] == [made.id] == [goals.get(made.id).id]
    assert runner.told == [GoalsChanged()]


def test_a_photo_may_bring_its_camera(goals):
    camera = replace(goal_camera(96), name="mine", height=64)
    made = goals.receive(photo(192, 128), "Mine", camera)
    assert (made.camera.width, made.camera.height, made.camera.name) == (192, 128, "mine")
    np.testing.assert_allclose(made.camera.intrinsics[0], 2 * camera.intrinsics[0], atol=1e-12)


@pytest.mark.parametrize("size", [(96, 64), (64, 96), (640, 66)])
def test_of_a_photo_in_other_proportions_the_middle_counts(goals, size):
    made = goals.receive(photo(*size), "Mine")
    side = min(size)
    assert (made.camera.width, made.camera.height) == (side, side)
    assert (made.photo.width, made.photo.height) == size
    assert made.photo.crop == PhotoCrop((size[0] - side) / 2, (size[1] - side) / 2, side)
    with Image.open(goals.photo(made.id)) as whole:
        assert whole.size == size


def test_another_part_of_a_photo_becomes_the_goal(goals, runner):
    pixels = np.zeros((100, 300, 3), np.uint8)
    pixels[:, 200:] = 255
    made = goals.receive(encoded(pixels), "Mine")
    cropped = goals.crop(made.id, PhotoCrop(200, 0, 100))
    assert goals.get(made.id).photo == cropped.photo == replace(made.photo, crop=PhotoCrop(200, 0, 100))
    with Image.open(goals.image(made.id)) as image:
        assert image.size == (100, 100) == (cropped.camera.width, cropped.camera.height)
        assert np.asarray(image).mean() > 250
    np.testing.assert_allclose(cropped.camera.intrinsics, made.camera.intrinsics, atol=1e-12)
    assert runner.told == [GoalsChanged(), GoalsChanged()]


def test_what_cannot_be_cropped_stays(goals):
    made = goals.receive(photo(96, 64), "Mine")
    before = goals.image(made.id).read_bytes()
    with pytest.raises(InvalidInput):
        goals.crop(made.id, PhotoCrop(50, 0, 64))
    assert goals.image(made.id).read_bytes() == before
    drawn = goals.draw("s", 0, None, "Random")
    with pytest.raises(NoPhoto):
        goals.crop(drawn.id, PhotoCrop(0, 0, 64))


def test_a_goal_whose_photo_is_damaged_stays_and_cannot_be_cropped(goals):
    made = goals.receive(photo(96, 64), "Mine")
    path = goals.photo(made.id)
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(CorruptFile, check=about("photo.jpg")):
        goals.crop(made.id, PhotoCrop(0, 0, 64))
    assert goals.get(made.id).photo == made.photo


def test_what_is_no_photo_leaves_nothing(goals, runner, tmp_path):
    with pytest.raises(PhotoRefused):
        goals.receive(b"%PDF", "Mine")
    assert not (tmp_path / "goals").exists()
    assert runner.told == []


# Made here


def test_a_layout_by_hand_is_of_the_scene_that_is_shown_unless_it_says_otherwise(goals, runner):
    light = Light(np.array([0.0, 0.6, 0.8]))
    made = goals.compose(None, (("x", at(0.1)),), "By hand", light)
    (command,) = runner.commands
    assert (command.id, command.size, command.seed) == ("s", GOAL_SIDE, None)
    assert command.light is light
    assert (made.source, made.scene, made.name) == ("composed", "s", "By hand")
    assert same(made.poses, (("x", at(0.1)), ("y", at(0.2))))
    assert goals.image(made.id).read_bytes() == picture(1)
    assert runner.told == [GoalsChanged()]


def test_a_random_layout_is_asked_for_by_seed(goals, runner):
    made = goals.draw("s", 7, 2, "Random")
    (command,) = runner.commands
    assert (command.seed, command.moved, command.poses, made.source) == (7, 2, (), "drawn")


@pytest.mark.parametrize("error", [OVERLAP, SceneHeld("episode"), ProcessUnavailable("simulation", "died")])
def test_a_goal_that_cannot_be_made_is_told_and_not_kept(goals, runner, error):
    runner.error = error
    for call in (
        lambda: goals.compose(None, (("x", at(0.1)),), "A"),
        lambda: goals.draw(None, 0, None, "A"),
        goals.begin_draft,
    ):
        with pytest.raises(type(error), match=str(error)[:20]):
            call()
    assert goals.all() == ()
    assert goals.draft is None
    assert runner.told == []


def test_without_a_scene_there_is_nothing_to_make_a_goal_of(goals, runner):
    for scene, kind in (("t", UnknownName), (None, NoTable)):
        runner.scenes.current = None
        for call in (
            lambda scene=scene: goals.compose(scene, (("x", at(0.1)),), "A"),
            lambda scene=scene: goals.draw(scene, 0, None, "A"),
            lambda scene=scene: goals.begin_draft(scene),
        ):
            with pytest.raises(kind):
                call()


def test_a_removed_goal_is_gone_for_everybody(goals, runner):
    made = goals.receive(photo(), "Mine")
    runner.told.clear()
    goals.remove(made.id)
    assert runner.told == [GoalsChanged()]
    with pytest.raises(UnknownName):
        goals.remove(made.id)
    assert runner.told == [GoalsChanged()]


# The draft


def test_a_draft_begins_where_things_are_and_follows_the_hand(goals, runner):
    assert goals.draft is None
    begun = goals.begin_draft()
    assert same(begun.poses, runner.start)
    assert (begun.scene, begun.problem, begun.revision) == ("s", "", 1)
    moved = goals.move_draft((("y", at(0.3)),))
    assert same(moved.poses, (("x", at(0.0)), ("y", at(0.3))))
    again = goals.move_draft((("x", at(-0.1)),))
    assert same(again.poses, (("x", at(-0.1)), ("y", at(0.3))))
    assert (moved.revision, again.revision) == (2, 3)
    assert goals.draft is again
    assert runner.drafts() == [begun, moved, again]
    assert goals.draft_image() == picture(3)


def test_a_problem_is_told_and_goes_with_its_cause(goals, runner):
    goals.begin_draft()
    for error in (OVERLAP, InvalidInput("x", "away", "over the table")):
        runner.error = error
        bad = goals.move_draft((("x", at(0.2)),))
        assert (bad.problem, goals.draft) == (str(error), bad)
        assert same(bad.poses, (("x", at(0.2)), ("y", at(0.2))))
        assert goals.draft_image() == picture(1)
        with pytest.raises(DraftUnsound):
            goals.keep_draft("A")
    assert goals.all() == ()
    runner.error = None
    good = goals.move_draft((("x", at(0.1)),))
    assert (good.problem, good.revision) == ("", 4)
    assert same(good.poses, (("x", at(0.1)), ("y", at(0.2))))
    assert goals.draft_image() == picture(2)


@pytest.mark.parametrize(
    "error", [SceneHeld("episode"), ProcessUnavailable("simulation", "x"), InternalError("simulation", ValueError())]
)
def test_what_is_not_the_hands_fault_is_raised_and_changes_nothing(goals, runner, error):
    begun = goals.begin_draft()
    runner.error = error
    with pytest.raises(type(error)):
        goals.move_draft((("x", at(0.1)),))
    assert goals.draft is begun
    assert runner.drafts() == [begun]


def test_objects_that_are_not_in_the_draft_cannot_be_moved(goals, runner):
    begun = goals.begin_draft()
    with pytest.raises(UnknownName, check=about("teapot")):
        goals.move_draft((("x", at(0.1)), ("teapot", at(0.1))))
    assert goals.draft is begun


def test_a_draft_that_is_kept_becomes_a_goal_and_ends(goals, runner):
    goals.begin_draft()
    draft = goals.move_draft((("x", at(0.1)),))
    made = goals.keep_draft("By hand")
    assert (made.source, made.scene, made.name) == ("composed", "s", "By hand")
    assert same(made.poses, draft.poses)
    assert (made.camera.width, made.camera.height) == (GOAL_SIDE, GOAL_SIDE)
    assert goals.image(made.id).read_bytes() == picture(2)
    assert goals.draft is None
    assert runner.told[-2:] == [GoalsChanged(), runner.told[-1]]
    assert runner.drafts()[-1] is None


def test_a_draft_outlives_a_disk_that_is_full(goals, runner, monkeypatch):
    begun = goals.begin_draft()
    for number in range(3):
        goals.draw(None, number, None, "A")
    with pytest.raises(TooManyGoals):
        goals.keep_draft("One too many")
    goals.remove(goals.all()[0].id)

    def full(*_):
        raise CannotStore("goals", "No space left on device")

    monkeypatch.setattr(GoalStore, "keep", full)
    with pytest.raises(CannotStore):
        goals.keep_draft("A")
    assert goals.draft is begun


def test_dropping_ends_it_once_and_without_a_draft_nothing_can_be_done(goals, runner):
    goals.begin_draft()
    goals.drop_draft()
    goals.drop_draft()
    assert [draft is None for draft in runner.drafts()] == [False, True]
    for call in (lambda: goals.move_draft(()), goals.draft_image, lambda: goals.keep_draft("A")):
        with pytest.raises(NoDraft):
            call()


def test_beginning_again_starts_from_the_table_and_pages_see_a_later_revision(goals, runner):
    goals.begin_draft()
    goals.move_draft((("x", at(0.1)),))
    again = goals.begin_draft()
    assert same(again.poses, runner.start)
    assert again.revision == 3


def test_many_hands_at_once_lose_no_change(goals, runner):
    goals.begin_draft()
    threads = [
        threading.Thread(target=goals.move_draft, args=(((name, at(place)),),))
        for name, place in (("x", 0.3), ("y", -0.3))
        for _ in range(10)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    draft = goals.draft
    assert isinstance(draft, Draft)
    assert same(draft.poses, (("x", at(0.3)), ("y", at(-0.3))))
    assert [one.revision for one in runner.drafts()] == list(range(1, 22))
