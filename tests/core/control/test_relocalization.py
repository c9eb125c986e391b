from dataclasses import replace

import numpy as np
import pytest

import osfcore.control.closed_loop as module
from osfcore.control.closed_loop import relocalize
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from tests.core.control.scenes import CAN, GELATIN, models, sure, table


def looks_at(position, target):
    return Camera.look_at(f"{position}", np.array(position), np.array(target), size=64)


def test_a_camera_that_hardly_sees_the_table_is_not_searched(library, monkeypatch):
    world = table(library)
    truth, observation = world.truth(), world.observe()
    world.close()
    away = looks_at((0.6, 0.0, 0.5), (3.0, 0.0, 0.5))
    beside = looks_at((0.0, -0.6, 0.5), (0.4, 0.0, 0.0))
    cameras = (away, beside, observation.cameras[0], away)
    searched = []
    monkeypatch.setattr(module, "estimate_goal", lambda _models, seen, *_: searched.append(seen.cameras) or iter(()))
    shown = replace(observation, cameras=cameras, masks=None)
    for seed in range(8):
        with pytest.raises(AssertionError):  # nothing is found in no steps
            list(relocalize(models().appearance, shown, sure(truth, ("it was lost", "")), np.random.default_rng(seed)))
    assert searched == [cameras[2:3]] * 8


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
