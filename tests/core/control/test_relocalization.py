from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.closed_loop import relocalize
from osfcore.geometry.poses import Pose
from tests.core.control.scenes import CAN, GELATIN, models, sure, table


@pytest.mark.slow
def test_what_is_lost_is_found_anywhere_on_the_table(library):
    world = table(library)
    truth, observation = world.truth(), world.observe()
    world.close()
    position = truth.poses.position.copy()
    position[0, :2] += [0.15, -0.1] if position[0, 0] < 0 else [-0.15, 0.1]
    last = sure(replace(truth, poses=Pose(position, truth.poses.quaternion)), ("it was lost", ""))
    *before, step = relocalize(models().appearance, observation, last, np.random.default_rng(0))
    assert all(one.estimate is None for one in before)
    found = step.estimate
    assert found.trusted
    for name in (GELATIN, CAN):
        assert found.state.pose(name).position == pytest.approx(truth.pose(name).position, abs=0.005)
