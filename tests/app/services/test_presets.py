import contextlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from app.services.examples import PRESETS, preset, set_up
from app.services.scenes import TooManyScenes
from app.storage.database import CannotStore
from osfcore.errors import UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.states import SceneState, shifted_poses
from osfcore.objects.catalogue import DEFAULT_NAMES
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import arranged_goal
from tests.app.storage.test_database import record
from tests.support.errors import about

STAYS_M, STAYS_RAD = 0.003, 0.05  # putting everything back to rest may shift it this much

each = pytest.mark.parametrize("one", PRESETS, ids=lambda one: one.id)


@each
def test_a_first_visit_can_choose_any_of_them(one):
    assert set(one.objects) <= set(DEFAULT_NAMES)


def test_there_are_six_of_different_names():
    assert len({one.id for one in PRESETS}) == len({one.title for one in PRESETS}) == len(PRESETS) == 6
    assert all(preset(one.id) is one for one in PRESETS)
    with pytest.raises(UnknownName, check=about("preset")):
        preset("seventh")


@each
def test_every_object_can_be_recognised_as_shipped(one):
    fields = FieldLibrary(None)
    assert [name for name in one.objects if not fields.has(name)] == []
    assert len(set(one.objects)) == len(one.objects)
    assert one.shifts_m
    assert set(one.shifts_m) <= set(one.objects)


@each
def test_light_comes_from_where_the_preset_says(one):
    for light, angles in ((one.light, (one.azimuth_deg, one.elevation_deg)), (one.goal_light, one.goal_angles_deg)):
        if angles is None:
            assert light is None
            continue
        x, y, z = light.direction
        assert np.rad2deg(np.arcsin(z)) == pytest.approx(angles[1])
        assert np.rad2deg(np.arctan2(y, x)) % 360 == pytest.approx(angles[0])


@each
def test_the_goal_differs_from_the_table_for_as_many_objects_as_it_says(one, library):
    if missing := set(one.objects) - set(library.names()):
        pytest.skip(f"without meshes here: {', '.join(sorted(missing))}")
    with contextlib.closing(Tabletop(library, request=SceneRequest(names=one.objects, light=one.light))) as world:
        world.arrange(one.seed)
        start = world.truth()
        goal = arranged_goal(world, shifted_poses(start, one.shifts_m))
    shift_m = np.linalg.norm(goal.poses.position - start.poses.position, axis=1)
    turn_rad = rotation_angle(goal.poses.quaternion, start.poses.quaternion)
    elsewhere = {n for n, m, rad in zip(start.names, shift_m, turn_rad, strict=True) if m > STAYS_M or rad > STAYS_RAD}
    assert elsewhere == set(one.shifts_m)


class Service:
    """A runner and goals in one, of which one thing may fail."""

    def __init__(self, error=None):
        self.error, self.made, self.goals, self.shown = error, [], [], None
        self.all = tuple  # nothing is there already
        self.scenes = SimpleNamespace(all=tuple, create=self.create_scene, activate=self.activate)

    def create_scene(self, **asked):
        self.made.append(asked)
        count = len(asked["names"])
        poses = Pose(np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)))
        return replace(record("s"), state=SceneState(asked["names"], poses, asked["light"], None))

    def activate(self, scene):
        assert self.goals, "pages would ask for images while the goal is still being drawn"
        self.shown = scene
        return record(scene)

    def delete_scene(self, scene):
        assert scene == "s"
        self.made.pop()

    def compose(self, *asked):
        if self.error is not None:
            raise self.error
        self.goals.append(asked)
        return "goal"


@each
def test_a_preset_is_asked_for_as_it_is_described(one):
    service = Service()
    scene, goal = set_up(one, service, service)
    assert (scene.id, goal) == ("s", "goal")
    assert service.shown == "s"
    (asked,) = service.made
    assert not asked["is_shown"]
    assert (asked["names"], asked["seed"]) == (one.objects, one.seed)
    np.testing.assert_array_equal(asked["light"].direction, one.light.direction)
    ((asked_of, poses, title, light, example),) = service.goals
    assert (asked_of, title, example) == ("s", one.title, one.id)
    assert (light is None) == (one.goal_light is None)
    assert [name for name, _ in poses] == list(one.shifts_m)


@pytest.mark.parametrize(
    "error",
    [
        CannotStore(Path("goals"), "No space left on device"),
        TooManyScenes(3),
        RuntimeError("defect"),
        KeyboardInterrupt(),
    ],
)
def test_without_its_goal_no_table_is_left(error):
    service = Service(error)
    with pytest.raises(type(error)):
        set_up(PRESETS[0], service, service)
    assert service.made == []
    assert service.shown is None
