import numpy as np
import pytest

from app.viewer.nodes.push_nodes import TRAIL, PushNodes
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState

BOX, CAN, GONE = "003_cracker_box", "005_tomato_soup_can", "my_thing"
COUNT = 11


@pytest.fixture
def drawing(server, library):
    return PushNodes(server, library)


@pytest.fixture
def rollouts():
    """Of three objects the first slides from its fourth action on, the second stays, the third turns by 90 degrees."""
    positions = np.zeros((1, COUNT, 3, 3))
    positions[0, :, 0, 0] = 0.02 * np.maximum(np.arange(COUNT) - 4, 0)
    positions[0, :, 1:, 1] = [0.2, -0.2]
    quaternions = np.tile([1.0, 0, 0, 0], (1, COUNT, 3, 1))
    half = np.linspace(0, np.pi / 4, COUNT)
    quaternions[0, :, 2] = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    quaternions[0, 1::2, 2] *= -1  # the same rotations
    pusher = np.linspace([-0.2, 0, 0.06], [0.1, 0, 0.06], COUNT)[None]
    return Rollouts((BOX, CAN, GONE), positions, quaternions, pusher)


def ghost(driver, name):
    node = driver.node(f"/push/ghost/{name}")
    return np.asarray(node.batched_positions)[0], np.asarray(node.batched_wxyzs)[0]


def test_what_moves_gets_a_ghost_at_the_end_and_a_way(drawing, driver, rollouts):
    drawing.show(rollouts)
    assert drawing.moving == (BOX, GONE)
    np.testing.assert_allclose(ghost(driver, BOX)[0], [0.12, 0, 0], atol=1e-6)
    np.testing.assert_allclose(driver.node("/push/pusher").position, [0.1, 0, 0.06], atol=1e-6)
    assert driver.shows("/push/ways")
    assert driver.node("/push/ways").points.shape == (2 * (COUNT - 1), 2, 3)
    assert driver.node("/push/ways").points[0, 0, 2] > 0.1  # above the box


def test_the_trail_is_spread_over_the_way_and_not_over_the_wait(drawing, driver, rollouts):
    drawing.show(rollouts)
    assert driver.below("/push/trail") == {BOX}  # what only turns has none
    x = np.asarray(driver.node(f"/push/trail/{BOX}").batched_positions)[:, 0]
    assert len(x) == TRAIL
    assert x.min() > 0.01
    assert x.max() < 0.12


def test_ghosts_move_with_time_by_the_shorter_way(drawing, driver, rollouts):
    drawing.show(rollouts)
    drawing.at(5.5)
    position, _ = ghost(driver, BOX)
    np.testing.assert_allclose(position, [0.03, 0, 0], atol=1e-6)
    _, quaternion = ghost(driver, GONE)
    half = np.pi / 4 * 5.5 / 10
    np.testing.assert_allclose(np.abs(quaternion), [np.cos(half), 0, 0, np.sin(half)], atol=1e-4)
    for step, x in ((-3, 0.0), (99, 0.12)):
        drawing.at(step)
        np.testing.assert_allclose(ghost(driver, BOX)[0][0], x, atol=1e-6)


def test_truth_is_drawn_beside_it_and_all_goes_again(drawing, driver, rollouts):
    drawing.show(rollouts)
    light, turns = Light(np.array([0, 0, 1.0])), np.tile([1.0, 0, 0, 0], (2, 1))
    states = [
        SceneState((BOX, CAN), Pose(np.array([[x, 0, 0], [0, 0.2, 0]]), turns), light, None) for x in (0.0, 0.05, 0.1)
    ]
    drawing.show_truth(states)
    assert driver.shows("/push/true_ways")
    assert driver.node("/push/true_ways").points.shape == (2, 2, 3)
    np.testing.assert_allclose(
        driver.node("/push/true_ways").points[0, 0, 2], driver.node("/push/ways").points[0, 0, 2]
    )
    drawing.show_truth(())
    assert not driver.shows("/push/true_ways")
    drawing.plan(np.array([[0, 0], [0.1, 0.1]]))
    drawing.clear()
    assert drawing.moving == ()
    assert not driver.shows("/push/pusher")
    assert not driver.shows("/push/ways")
    assert driver.shows("/push/plan")
    drawing.plan(None)
    assert not driver.shows("/push/plan")
    drawing.at(3)  # there is nothing to move
