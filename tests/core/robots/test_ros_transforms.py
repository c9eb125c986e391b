import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.robots.ros_robot import TransformTree
from tests.core.robots.ros_stand_in import transform


@given(st.integers(0, 2**32 - 1))
def test_poses_are_composed_along_the_tree_both_ways(seed):
    drawn = np.random.default_rng(seed).uniform(-3, 3, (3, 6))
    camera, table, mount = (Pose(one[:3], quaternion_exp(one[3:])) for one in drawn)
    tree = TransformTree(
        [{"transforms": [transform("base", "mount", mount), transform("/mount", "camera", camera)]},
         {"transforms": [transform("base", "table", table)]}]
    )  # fmt: skip
    found = tree.pose("camera", "table")
    np.testing.assert_allclose(found.matrix(), (table.inverse() @ mount @ camera).matrix(), atol=1e-9)
    np.testing.assert_allclose(tree.pose("table", "camera").matrix(), found.inverse().matrix(), atol=1e-9)
    np.testing.assert_allclose(tree.pose("table", "table").matrix(), np.eye(4), atol=1e-12)


def test_what_came_last_counts():
    first, last = (Pose(np.array([x, 0, 0]), np.array([1.0, 0, 0, 0])) for x in (1.0, 2.0))
    tree = TransformTree([{"transforms": [transform("table", "pusher", pose)]} for pose in (first, last)])
    np.testing.assert_allclose(tree.pose("pusher", "table").position, [2, 0, 0], atol=1e-12)


def test_frames_that_hang_together_by_nothing_are_told():
    tree = TransformTree([{"transforms": [transform("a", "b", Pose.identity()), transform("b", "a", Pose.identity())]}])
    with pytest.raises(UnknownName, match="frame that leads to table"):
        tree.pose("a", "table")


def test_a_rotation_that_is_none_is_told():
    broken = transform("a", "b", Pose(np.zeros(3), np.array([2.0, 0, 0, 0])))
    with pytest.raises(InvalidInput, match="rotation of frame b"):
        TransformTree([{"transforms": [broken]}])
