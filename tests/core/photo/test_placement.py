"""Cameras of several photographs, found from what each alone shows of the objects that they share."""

import numpy as np
import pytest

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from osfcore.photo.board import camera_matrix
from osfcore.photo.placement import Shape, Sight, place_cameras
from osfcore.photo.poses import seen_through

NAMES = ("box", "bottle", "drill", "mug")
PLACES = ((0.1, 0.0, 0.05), (-0.12, 0.05, 0.1), (0.0, 0.15, 0.06), (0.05, -0.14, 0.04))
SHAPES = {name: Shape(0.08, Pose.identity(1)) for name in NAMES}
HALF_TURN = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def objects(rng):
    turns = quaternion_exp(rng.uniform(-1.5, 1.5, (len(NAMES), 3)))
    return {name: Pose(np.array(place), turn) for name, place, turn in zip(NAMES, PLACES, turns, strict=True)}


def camera_at(*place):
    return Camera.look_at("photo", np.array(place), np.array([0.0, 0.02, 0.04])).T_world_camera


CAMERAS = (camera_at(0.1, -0.6, 0.5), camera_at(0.6, -0.2, 0.4), camera_at(-0.5, 0.3, 0.6))
RELATIVE = [CAMERAS[0].inverse() @ camera for camera in CAMERAS]


def blurred(pose, rng, turn_deg=3.0, depth=0.04):
    """As one photograph shows it: its distance is uncertain, its direction is not."""
    turn = quaternion_exp(np.deg2rad(turn_deg) * rng.standard_normal(3))
    return Pose(pose.position * (1 + depth * rng.standard_normal()), quaternion_multiply(turn, pose.quaternion))


def sight(*poses):
    return Sight(Pose.stacked(poses), 0.1 * np.arange(len(poses)))


def off(placement, number):
    camera, true = placement.cameras[number], RELATIVE[number]
    turn = np.rad2deg(rotation_angle(camera.quaternion, true.quaternion))
    return float(np.linalg.norm(camera.position - true.position)), float(turn)


def test_exact_poses_give_exact_cameras_and_objects(objects):
    sights = [{name: sight(T.inverse() @ pose) for name, pose in objects.items()} for T in CAMERAS]
    placement = place_cameras(sights, SHAPES)
    for number in range(3):
        assert off(placement, number) == pytest.approx((0, 0), abs=1e-4)
    for name, pose in objects.items():
        np.testing.assert_allclose(placement.poses[name].matrix(), (CAMERAS[0].inverse() @ pose).matrix(), atol=1e-5)
    assert len(placement.agreeing) == 3 * len(NAMES)


def test_several_photographs_show_distances_better_than_each_alone(objects, rng):
    seen = [{name: blurred(T.inverse() @ pose, rng) for name, pose in objects.items()} for T in CAMERAS]
    placement = place_cameras([{name: sight(pose) for name, pose in its.items()} for its in seen], SHAPES)
    true = {name: CAMERAS[0].inverse() @ pose for name, pose in objects.items()}
    alone = [np.linalg.norm(seen[0][name].position - pose.position) for name, pose in true.items()]
    together = [np.linalg.norm(placement.poses[name].position - pose.position) for name, pose in true.items()]
    assert np.mean(together) < 0.6 * np.mean(alone)


def test_a_wrong_first_choice_gives_way_to_the_rival_that_others_confirm(objects, rng):
    sights = [{name: sight(blurred(T.inverse() @ pose, rng)) for name, pose in objects.items()} for T in CAMERAS]
    for number, name in ((0, "box"), (1, "mug"), (2, "box")):
        right = sights[number][name].poses[0]
        sights[number][name] = sight(right @ HALF_TURN, right)
    placement = place_cameras(sights, SHAPES)
    for name, pose in objects.items():
        true = CAMERAS[0].inverse() @ pose
        assert np.rad2deg(rotation_angle(placement.poses[name].quaternion, true.quaternion)) < 10


def test_a_symmetric_shape_shows_where_a_camera_is_though_its_print_was_misread(objects):
    shapes = {**SHAPES, "box": Shape(0.08, Pose.stacked([Pose.identity(), HALF_TURN]))}
    names = ("box", "mug")
    sights = [{name: sight(T.inverse() @ objects[name]) for name in names} for T in CAMERAS[:2]]
    sights[1]["box"] = sight(sights[1]["box"].poses[0] @ HALF_TURN)
    placement = place_cameras(sights, shapes)
    assert off(placement, 1) == pytest.approx((0, 0), abs=1e-3)


def test_a_photograph_of_another_table_is_left_out(objects, rng):
    sights = [{name: sight(T.inverse() @ pose) for name, pose in objects.items()} for T in CAMERAS]
    moved = {
        n: Pose(p.position + rng.uniform(-0.2, 0.2, 3), quaternion_exp(rng.uniform(-2, 2, 3)))
        for n, p in objects.items()
    }
    sights[1] = {name: sight(CAMERAS[1].inverse() @ pose) for name, pose in moved.items()}
    placement = place_cameras(sights, SHAPES)
    assert placement.cameras[1] is None
    assert off(placement, 2) == pytest.approx((0, 0), abs=1e-4)


def test_known_cameras_stay(objects):
    sights = [{name: sight(T.inverse() @ pose) for name, pose in objects.items()} for T in CAMERAS]
    placement = place_cameras(sights, SHAPES, [None, CAMERAS[1], None])
    for found, true in zip(placement.cameras, CAMERAS, strict=True):
        np.testing.assert_allclose(found.matrix(), true.matrix(), atol=1e-5)


def test_the_focal_length_that_was_assumed_wrongly_is_found(objects):
    true, assumed = camera_matrix(900.0, 400.0, 300.0), camera_matrix(750.0, 400.0, 300.0)
    sights = [
        {name: sight(seen_through(T.inverse() @ pose, true, assumed)) for name, pose in objects.items()}
        for T in CAMERAS
    ]
    assert place_cameras(sights, SHAPES, focal_known=False).focal_factor == pytest.approx(1.2, rel=0.04)
