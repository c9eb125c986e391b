from dataclasses import replace

import numpy as np
import pytest

import osfcore.experiments.estimation_tasks as module
from osfcore.errors import NoRoom
from osfcore.experiments.harness import MAX_TASKS
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import draw_scene, opened
from tests.support.oracle import Oracle
from tests.support.solids import SOLIDS

CAMERAS = default_cameras(32)[:2]


@pytest.fixture(scope="module")
def draw():
    return draw_scene(SOLIDS, 2, 5, 0)


@pytest.fixture(scope="module")
def start(draw, library):
    return module.first_frame(draw, library, CAMERAS)


def test_a_first_frame_is_the_draw_at_rest(draw, start, library):
    assert start.truth.names == start.observation.names == draw.names
    np.testing.assert_array_equal(start.truth.light.direction, draw.light.direction)
    assert start.observation.masks.shape == (2, 2, 32, 32)
    np.testing.assert_array_equal(start.observation.pusher, start.truth.pusher)
    assert start.absent == ("", "")
    again = module.first_frame(draw, library, CAMERAS)
    np.testing.assert_array_equal(again.truth.poses.position, start.truth.poses.position)
    np.testing.assert_array_equal(again.observation.images, start.observation.images)


def test_pushes_are_drawn_again_until_something_moves_by_five_centimetres(draw, library, start):
    pushes, again = (module.episode(draw, library, CAMERAS[:1], steps=6) for _ in range(2))
    assert pushes.redrawn > 0
    assert max(pushes.moved_m) >= 0.05
    assert len(pushes.frames) == 6
    places = np.stack([frame.truth.poses.position[:, :2] for frame in pushes.frames])
    farthest = np.linalg.norm(places - start.truth.poses.position[:, :2], axis=2).max(axis=0)
    np.testing.assert_allclose(pushes.moved_m, farthest, atol=1e-12)
    assert np.linalg.norm(places[0] - start.truth.poses.position[:, :2], axis=1).max() < 0.1  # it goes on from there
    for frame, other in zip(pushes.frames, again.frames, strict=True):
        assert frame.observation.masks is None
        np.testing.assert_array_equal(frame.observation.pusher, frame.truth.pusher)
        np.testing.assert_array_equal(frame.truth.light.direction, start.truth.light.direction)
        np.testing.assert_array_equal(frame.observation.images, other.observation.images)


def test_goals_move_one_object_more_each_time(draw, library, start):
    found = module.goals(draw, library, goal_camera(32))
    assert [len(goal.moved) for goal in found] == [1, 2]
    for goal in found:
        frame = goal.frame
        assert frame.observation.masks is frame.observation.pusher is frame.truth.pusher is None
        assert [camera.name for camera in frame.observation.cameras] == ["goal"]
        assert np.abs(frame.truth.light.direction - start.truth.light.direction).max() > 0.01
        for name in draw.names:
            before, after = start.truth.pose(name), frame.truth.pose(name)
            shift = np.linalg.norm(after.position - before.position)
            if name in goal.moved:
                assert 0.07 < shift < 0.21
                tilt = [rotate(pose.quaternion, np.eye(3))[:, 2] for pose in (before, after)]
                np.testing.assert_allclose(*tilt, atol=0.02)  # only about the vertical
            else:
                assert shift < 0.002
                assert rotation_angle(before.quaternion, after.quaternion) < 0.02


def test_objects_may_fall_off_or_be_out_of_view(draw, library):
    with opened(draw, library) as world:
        state = world.truth()
        for place, cameras, expected in (
            ((0.9, 0.0, -0.7), CAMERAS, "off the table"),
            ((-0.55, -0.55, 0.1), default_cameras(32)[2:3], "out of view"),
        ):
            position = state.poses.position.copy()
            position[0] = place
            world.restore(replace(state, poses=Pose(position, state.poses.quaternion)))
            assert module.take_frame(world, cameras, masks=False).absent[0] == expected


def test_where_objects_do_not_fit_another_layout_is_tried(draw, library, monkeypatch):
    tried, fits_at = [], 2

    def arrange(_world, seed):
        tried.append(seed - draw.seed)
        if tried[-1] != fits_at:
            raise NoRoom(draw.names, 1)

    monkeypatch.setattr(Tabletop, "arrange", arrange)
    with opened(draw, library):
        assert tried == [0, 1, 2]
    fits_at = -1
    with pytest.raises(NoRoom), opened(draw, library):
        pass


# Spoiled inputs


@pytest.fixture(scope="module")
def cases(library):
    """One of each kind, with the frame that it was made of."""
    found = {}
    for number, kind in enumerate(module.KINDS):
        case = module.bad_case(SOLIDS, 2, 4, number, library, 48)
        draw = draw_scene(SOLIDS, 2, 4, module.FIRST_SCENE + number)
        assert case.kind == kind
        found[kind] = case, module.first_frame(draw, library, default_cameras(48))
    return found


@pytest.mark.slow
def test_masks_change_places_or_remain_in_one_view(cases):
    case, sound = cases["swapped masks"]
    np.testing.assert_array_equal(case.observation.masks, sound.observation.masks[:, ::-1])
    np.testing.assert_array_equal(case.observation.images, sound.observation.images)
    assert case.start is None
    case, sound = cases["mask in one view"]
    areas, before = (one.observation.masks.sum(axis=(2, 3)) for one in (case, sound))
    (n,) = np.flatnonzero((areas != before).any(axis=0))
    assert sorted(areas[:, n])[:-1] == [0, 0, 0]
    assert 0 < areas[:, n].max() <= 6
    changed = (case.observation.images != sound.observation.images).any(axis=-1)
    assert changed.sum() == before[:, n].max() - areas[:, n].max()


@pytest.mark.slow
def test_names_images_and_lights_are_spoiled(cases):
    case, sound = cases["wrong name"]
    assert len(set(case.observation.names) & set(sound.truth.names)) == 1
    assert case.truth.names == sound.truth.names
    assert cases["black images"][0].observation.images.max() == 0
    case, sound = cases["saturated images"]
    np.testing.assert_allclose(case.observation.images, np.clip(8 * sound.observation.images, 0, 1), atol=1e-12)
    case, _ = cases["one view, low light"]
    assert len(case.observation.cameras) == 1
    assert 10 <= np.rad2deg(np.arcsin(case.truth.light.direction[2])) <= 13


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["moved camera", "image of another scene"])
def test_one_view_does_not_fit_the_others(cases, kind):
    case, sound = cases[kind]
    pairs = zip(case.observation.images, sound.observation.images, strict=True)
    assert sum(np.abs(a - b).max() > 0.05 for a, b in pairs) == 1
    for mine, claimed in zip(case.observation.cameras, sound.observation.cameras, strict=True):
        np.testing.assert_array_equal(mine.T_world_camera.position, claimed.T_world_camera.position)


@pytest.mark.slow
def test_goals_show_other_objects_or_come_from_another_camera(cases):
    other, sound = cases["goal of other objects"]
    assert not set(other.truth.names) & set(other.observation.names)
    assert other.observation.names == sound.truth.names
    for case in (other, cases["goal from another camera"][0]):
        assert [camera.name for camera in case.observation.cameras] == ["goal"]
        assert case.observation.masks is case.observation.pusher is None
        assert case.start.masks is not None


@pytest.mark.slow
def test_the_same_number_is_the_same_case(cases, library):
    again = module.bad_case(SOLIDS, 2, 4, 5, library, 48)
    np.testing.assert_array_equal(again.observation.images, cases[module.KINDS[5]][0].observation.images)
    later = module.bad_case(SOLIDS, 2, 4, 5 + len(module.KINDS), library, 48)
    assert later.kind == again.kind
    assert (later.observation.images != again.observation.images).any()


# Warm-up


def test_every_kind_of_estimate_is_made_once_but_goals_only_where_they_are_measured(solids, library, monkeypatch):
    oracle = Oracle()
    oracle.install(monkeypatch, module)
    draw = draw_scene(SOLIDS[:1], 1, 0, module.WARM_SCENE)
    module.warm_models(SOLIDS[:1], solids, library, draw, 32, goal=False)
    models = module.warm_models(SOLIDS[:2], solids, library, draw, 32)
    assert [what for what, _ in oracle.asked] == [*["first search 4", "next"] * 2, "goal"]
    assert models.together.names == SOLIDS[:2]
    assert module.WARM_SCENE > MAX_TASKS  # nothing is measured on it
