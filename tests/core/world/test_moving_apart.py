import numpy as np
import pytest

from osfcore.errors import OverlappingObjects
from osfcore.geometry.poses import Pose
from osfcore.world.physics import Physics, body_model
from osfcore.world.scenes import move_apart, refuse_overlaps
from tests.core.world.boxes import box_asset

SIDE = 0.1
NAMES = ("a", "b")


@pytest.fixture
def boxes():
    physics = Physics({name: body_model(box_asset(name, (SIDE, SIDE, SIDE))) for name in NAMES})
    physics.place_pusher(np.array([0.5, 0.5, 0.06]))
    yield physics
    physics.close()


def put(physics, name, x, y=0.0, z=SIDE / 2):
    physics.place(name, Pose(np.array([x, y, z]), np.array([1.0, 0, 0, 0])))


def test_separation_is_the_gap_and_the_way_out(boxes):
    put(boxes, "a", 0.13)
    put(boxes, "b", 0.0)
    gap, away = boxes.separation("a", "b")
    assert gap == pytest.approx(0.03, abs=1e-3)
    np.testing.assert_allclose(away, [1, 0, 0], atol=1e-3)
    assert boxes.separation("b", "a")[1] == pytest.approx(-away, abs=1e-3)


def test_boxes_side_by_side_each_give_way_by_half(boxes):
    put(boxes, "a", 0.09)
    put(boxes, "b", 0.0)
    with pytest.raises(OverlappingObjects):
        refuse_overlaps(boxes, NAMES)
    move_apart(boxes, NAMES)
    refuse_overlaps(boxes, NAMES)
    np.testing.assert_allclose(boxes.pose("a").position, [0.095, 0, SIDE / 2], atol=1e-3)
    np.testing.assert_allclose(boxes.pose("b").position, [-0.005, 0, SIDE / 2], atol=1e-3)


def test_the_upper_one_of_a_stack_is_lifted(boxes):
    put(boxes, "a", 0.01, z=1.5 * SIDE - 0.008)
    put(boxes, "b", 0.0)
    move_apart(boxes, NAMES)
    assert boxes.pose("a").position[2] == pytest.approx(1.5 * SIDE, abs=1e-3)
    np.testing.assert_array_equal(boxes.pose("b").position, [0, 0, SIDE / 2])


def test_what_sinks_into_the_table_is_lifted_and_what_is_apart_stays(boxes):
    put(boxes, "a", 0.3, z=SIDE / 2 - 0.012)
    put(boxes, "b", 0.0)
    move_apart(boxes, NAMES)
    assert boxes.pose("a").position[2] == pytest.approx(SIDE / 2, abs=1e-3)
    np.testing.assert_array_equal(boxes.pose("b").position, [0, 0, SIDE / 2])
