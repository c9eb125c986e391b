from dataclasses import replace

import numpy as np
import pytest

from osfcore.dynamics.motion import SUBSTEPS, is_on_table, substates
from osfcore.errors import InvalidInput
from tests.core.dynamics.scenes import CAN, GELATIN, episode, scene


@pytest.fixture(scope="module")
def pushed(shapes):
    return episode(shapes, scene(shapes, {CAN: (0.06, 0.0), GELATIN: (0.2, 0.1)}), np.tile([0.2, 0.0, 0.0], (3, 1)))


def test_poses_come_substep_by_substep(pushed):
    poses = substates(pushed)
    assert poses.position.shape == (3 * SUBSTEPS + 1, 2, 3)
    np.testing.assert_array_equal(poses.position[::SUBSTEPS], pushed.positions)
    np.testing.assert_array_equal(poses.quaternion[::SUBSTEPS], pushed.quaternions)


def test_an_episode_without_poses_within_its_actions_is_refused(pushed):
    with pytest.raises(InvalidInput, match="without poses within its actions"):
        substates(replace(pushed, sub_positions=None, sub_quaternions=None))


@pytest.mark.parametrize(("place", "stays"), [((0.54, 0, 0.05), True), ((0.56, 0, 0.05), False),
                                              ((0, -0.56, 0.05), False), ((0, 0, -0.1), False)])  # fmt: skip
def test_what_nears_the_edge_or_fell_is_not_on_the_table(pushed, place, stays):
    positions = pushed.positions.copy()
    positions[2, 1] = place
    assert is_on_table(replace(pushed, positions=positions)).tolist() == [True, True, stays, True]
