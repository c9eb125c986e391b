import contextlib
import threading

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.contrib.robots.connect import connect
from osfcore.contrib.robots.guarded_world import GuardedWorld
from osfcore.contrib.robots.robot import ConnectionLost, RobotRefused, RobotStopped, SafetyLimits
from osfcore.contrib.robots.ros_robot import RosNames, RosRobot, TransformTree
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.estimation.camera_response import linear_of_srgb
from osfcore.geometry.poses import Pose, quaternion_exp
from tests.live import free_port
from tests.support.errors import about
from tests.support.robots import until
from tests.support.ros_robots import CAMERAS, SIDE, StandIn, jpeg, transform
from tests.support.same import assert_same

FAST = SafetyLimits(top_speed_m_s=0.42)
LEFT = np.array([-0.3, 0.1, 0.0])


@pytest.fixture
def stand_in():
    robot = StandIn()
    with robot.running() as url:
        robot.url = url
        yield robot


@pytest.fixture
def robot(stand_in):
    with contextlib.closing(connect(stand_in.url, ("025_mug",), FAST)) as robot:
        yield robot


def short(stand_in, cameras=("left", "right"), timeout_s=0.4):
    address = stand_in.url.replace("ros://", "ws://").partition("?")[0]
    return RosRobot(address, RosNames(cameras), (), FAST, timeout_s)


def test_cameras_are_where_the_transforms_put_them_and_send_pictures_beside_the_pusher(robot, stand_in):
    assert_same(robot.description.cameras, tuple(CAMERAS.values()), atol=1e-9)
    assert robot.description.limits == FAST
    stand_in.pusher = np.array([0.05, -0.1, 0.06])
    seen = robot.observe(masks=True)
    np.testing.assert_allclose(seen.images, linear_of_srgb(np.array(100 / 255)), atol=0.01)
    np.testing.assert_allclose(seen.pusher, [0.05, -0.1, 0.06], atol=1e-12)
    assert (seen.masks, seen.names) == (None, ("025_mug",))


def test_pictures_are_newer_than_the_question(robot, stand_in):
    topic = "/left/image_raw/compressed"
    stand_in.silent.add(topic)
    old = threading.Timer(0.1, stand_in.silent.clear)
    old.start()
    assert robot.observe().images.shape[0] == 2  # it waited
    old.join()
    assert not stand_in.silent


def test_a_pusher_whose_place_is_no_longer_published_is_not_taken_to_stand_still(stand_in):
    with contextlib.closing(short(stand_in)) as robot:
        robot.observe()
        stand_in.silent.add("/tf")
        with pytest.raises(RobotRefused, check=about("/tf")):
            robot.observe()


def test_velocities_are_sent_in_the_frame_of_the_table_once_it_is_started_until_they_are_over(robot, stand_in):
    with pytest.raises(RobotRefused):
        robot.act(LEFT)
    assert stand_in.twists == []
    robot.start()
    robot.act(LEFT)
    until(lambda: stand_in.twists and not stand_in.twists[-1].any())
    assert set(stand_in.frames) == {"table"}
    assert len(stand_in.twists) >= 3
    np.testing.assert_allclose(stand_in.twists[0], LEFT[:2], atol=1e-12)
    until(lambda: stand_in.pusher[0] < -0.02)


def test_nothing_follows_the_zero_of_a_stop_from_another_thread(robot, stand_in):
    guard = GuardedWorld(robot, FAST)
    guard.observe()
    other = threading.Thread(target=lambda: (until(lambda: stand_in.twists), guard.stop("a key was pressed")))
    other.start()
    with pytest.raises(RobotStopped, check=about("a key was pressed")):
        guard.act(LEFT)
    other.join()
    until(lambda: not stand_in.twists[-1].any())
    with pytest.raises(RobotStopped):
        guard.act(LEFT)
    moving = [bool(twist.any()) for twist in stand_in.twists]
    assert moving == sorted(moving, reverse=True)


def test_a_robot_whose_place_never_changes_is_stopped(robot, stand_in):
    stand_in.extra["/tf"] = stand_in.messages()["/tf"]
    guard = GuardedWorld(robot, FAST)
    guard.observe()
    guard.act(LEFT)
    guard.observe()
    guard.act(LEFT)
    with pytest.raises(RobotStopped, check=about("hardly moved")):
        guard.observe()
    until(lambda: not stand_in.twists[-1].any())


def test_a_robot_that_is_cut_off_stands(robot, stand_in):
    guard = GuardedWorld(robot, FAST)
    guard.observe()
    other = threading.Thread(target=lambda: (until(lambda: stand_in.twists), stand_in.cut()))
    other.start()
    with pytest.raises(ConnectionLost):
        guard.act(LEFT)
    other.join()
    with pytest.raises(RobotStopped):
        guard.act(LEFT)
    with pytest.raises(ConnectionLost):
        robot.observe()
    until(lambda: not stand_in.velocity.any())
    assert np.linalg.norm(stand_in.pusher[:2]) < 0.3 * 1.2 * (0.2 + 0.15) + 0.05
    guard.close()


@pytest.mark.parametrize(
    ("topic", "subject"), [("/left/camera_info", "/left/camera_info"), ("/tf_static", "left_optical")]
)
def test_what_is_not_published_is_named(stand_in, topic, subject):
    stand_in.silent.add(topic)
    with pytest.raises((RobotRefused, UnknownName), check=about(subject)):
        short(stand_in)


def test_pictures_that_do_not_come_are_named_and_damaged_ones_refused(stand_in):
    with contextlib.closing(short(stand_in)) as robot:
        for data in ("no base64", "no ascii: \u00e4", "QUJD"):
            stand_in.extra["/left/image_raw/compressed"] = {"data": data}
            with pytest.raises(CorruptFile):
                robot.observe()
        stand_in.silent.add("/right/image_raw/compressed")
        with pytest.raises(RobotRefused, check=about("/right/image_raw/compressed")):
            robot.observe()


def test_messages_that_are_nested_too_deeply_or_no_json_are_passed_over(stand_in):
    deep = "[" * 100_000 + "]" * 100_000
    stand_in.noise = [deep, f'{{"op": "publish", "topic": "/tf", "msg": {{"transforms": {deep}}}}}', "{", "\u00e4"]
    with contextlib.closing(connect(stand_in.url)) as robot:
        assert robot.observe().images.shape[0] == 2


def test_a_camera_that_is_not_calibrated_is_refused(stand_in):
    info = stand_in.messages()["/left/camera_info"]
    stand_in.extra["/left/camera_info"] = info | {"k": [0.0] * 9}
    with pytest.raises(InvalidInput, check=about("K of camera left")):
        short(stand_in)


@pytest.mark.parametrize(
    ("model", "coefficients", "what"),
    [("fov", [0.9], "distortion_model of camera left"), ("plumb_bob", [0.1] * 6, "distortion of camera left")],
)
def test_a_lens_that_is_not_modelled_is_refused(stand_in, model, coefficients, what):
    info = stand_in.messages()["/left/camera_info"]
    stand_in.extra["/left/camera_info"] = info | {"distortion_model": model, "d": coefficients}
    with pytest.raises(InvalidInput, check=about(what)):
        short(stand_in)


def test_the_pictures_of_a_fisheye_are_straightened(stand_in):
    info, coefficients = stand_in.messages()["/left/camera_info"], [-0.05, 0.01, 0.0, 0.0]
    ramp = np.broadcast_to(np.linspace(20, 235, SIDE), (SIDE, SIDE))
    stand_in.pictures["left"] = jpeg(np.repeat(ramp[..., None], 3, axis=2).astype(np.uint8))
    with contextlib.closing(connect(stand_in.url)) as robot:
        plain = robot.observe().images[0]
    stand_in.extra["/left/camera_info"] = info | {"distortion_model": "equidistant", "d": coefficients}
    with contextlib.closing(connect(stand_in.url)) as robot:
        straight = robot.observe().images[0]
    K = np.reshape(info["k"], (3, 3))
    expected = cv2.fisheye.undistortImage(plain, K, np.array(coefficients), Knew=K)
    assert np.abs(straight - plain).max() > 0.05
    np.testing.assert_allclose(straight, expected, atol=0.005)


@pytest.mark.parametrize(
    ("query", "subject"),
    [
        ("", "cameras of the robot"),
        ("?cameras=a,a", "cameras of the robot"),
        ("?cameras=a&colour=red", "part of a robot's address"),
    ],
)
def test_names_of_ros_come_with_the_address(query, subject):
    with pytest.raises((InvalidInput, UnknownName), check=about(subject)):
        connect(f"ros://127.0.0.1:9090{query}")
    with pytest.raises(ConnectionLost):
        connect(f"ros://127.0.0.1:{free_port()}?cameras=a")


# Transforms


@given(st.integers(0, 2**32 - 1))
def test_poses_are_composed_along_the_tree_both_ways(seed):
    drawn = np.random.default_rng(seed).uniform(-3, 3, (3, 6))
    camera, table, mount = (Pose(one[:3], quaternion_exp(one[3:])) for one in drawn)
    tree = TransformTree(
        [{"transforms": [transform("base", "mount", mount), transform("/mount", "camera", camera)]},
         {"transforms": [transform("base", "table", mount)]},
         {"transforms": [transform("base", "table", table)]}]  # what came last counts
    )  # fmt: skip
    found = tree.pose("camera", "table")
    np.testing.assert_allclose(found.matrix(), (table.inverse() @ mount @ camera).matrix(), atol=1e-9)
    np.testing.assert_allclose(tree.pose("table", "camera").matrix(), found.inverse().matrix(), atol=1e-9)
    np.testing.assert_allclose(tree.pose("table", "table").matrix(), np.eye(4), atol=1e-12)


def test_unconnected_frames_and_broken_rotations_are_refused():
    tree = TransformTree([{"transforms": [transform("a", "b", Pose.identity()), transform("b", "a", Pose.identity())]}])
    with pytest.raises(UnknownName, check=about("table")):
        tree.pose("a", "table")
    broken = transform("a", "b", Pose(np.zeros(3), np.array([2.0, 0, 0, 0])))
    with pytest.raises(InvalidInput, check=about("rotation of frame b")):
        TransformTree([{"transforms": [broken]}])
