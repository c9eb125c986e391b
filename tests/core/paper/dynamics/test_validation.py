from dataclasses import replace

import numpy as np
import pytest

from osfcore.geometry.poses import quaternion_exp
from osfcore.paper.dynamics import GraphNetwork
from osfcore.paper.train_dynamics import record, validate
from tests.core.paper.dynamics.scenes import KAPPAS, NAMES, episode, network

STILL = GraphNetwork(NAMES, 8)  # before anything is learned, nothing moves


def moving(speed: float, turn: float):
    """The first object slides along x [m an action] and turns about z [rad an action]."""
    e = episode(0)
    times = np.arange(len(e.positions))
    positions, quaternions = e.positions.copy(), e.quaternions.copy()
    positions[:, 0, 0] = speed * times
    quaternions[:, 0] = quaternion_exp(np.stack([0 * times, 0 * times, turn * times], axis=1))
    return record([replace(e, positions=positions, quaternions=quaternions)], STILL, KAPPAS, 4)


def test_predicting_no_motion_errs_by_the_motion_of_what_moves():
    found = validate(STILL, moving(0.02, 0.1))
    assert found.windows == 5
    for mm in (found.mm_4, found.mean_mm_4, found.constant_mm_4):
        assert mm == pytest.approx(80, abs=1e-3)
    for deg in (found.deg_4, found.constant_deg_4):
        assert deg == pytest.approx(np.rad2deg(0.4), abs=0.1)


def test_where_nothing_moves_everything_counts():
    found = validate(STILL, moving(0.0, 0.0))
    assert (found.windows, found.mm_4, found.constant_mm_4) == (0, pytest.approx(0, abs=1e-3), pytest.approx(0))
    assert validate(network(), moving(0.0, 0.0)).mm_4 > 1


def test_the_network_decides_nothing_about_what_no_motion_errs_by():
    one, other = validate(STILL, moving(0.02, 0.1)), validate(network(), moving(0.02, 0.1))
    assert (one.constant_mm_4, one.constant_deg_4, one.windows) == (
        other.constant_mm_4,
        other.constant_deg_4,
        other.windows,
    )
    assert one.mm_4 != other.mm_4
