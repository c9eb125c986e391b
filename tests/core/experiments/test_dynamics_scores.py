import numpy as np
import pytest

from osfcore.dynamics.graph import PropagationNetwork
from osfcore.experiments.dynamics_scores import (
    HORIZONS,
    LONGEST,
    Predicted,
    analytic,
    constant,
    errors,
    learned,
    windows_of,
)
from osfcore.geometry.poses import quaternion_exp
from osfcore.objects.asset import Symmetry
from tests.support.push_episodes import NAMES, STEPS, episode, shapes

NONE = {name: Symmetry("none", reason="label") for name in NAMES}


def test_windows_hold_the_step_before_their_start_and_all_that_follows():
    windows = windows_of([episode(speed=0.01)])
    assert len(windows.names) == (STEPS - LONGEST) // 4 + 1
    np.testing.assert_array_equal(windows.positions[0, 0], windows.positions[0, 1])  # nothing is known before
    np.testing.assert_allclose(np.diff(windows.positions[1, :, 0, 0]), 0.01, atol=1e-12)
    assert (windows.on_table == LONGEST).all()


def test_what_leaves_the_table_is_not_scored():
    windows = windows_of([episode(speed=0.04)])
    reached = -0.1 + 0.04 * np.arange(STEPS + 1)
    assert windows.on_table[0] == np.flatnonzero(reached >= 0.55)[0] - 1
    found = errors(windows, constant(windows), NONE)
    assert found.valid[HORIZONS.index(4)].all()
    assert not found.valid[-1].any()


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_the_constant_pose_errs_by_the_whole_way(turn):
    windows = windows_of([episode(speed=0.01, turn=turn)])
    found = errors(windows, constant(windows), NONE)
    for number, horizon in enumerate(HORIZONS):
        np.testing.assert_allclose(found.mm[number, :, 0], 10 * horizon, rtol=1e-9)
        np.testing.assert_allclose(found.deg[number, :, 0], np.rad2deg(turn * horizon), atol=1e-6)
    np.testing.assert_allclose(found.of_moved(4), 40)
    np.testing.assert_allclose(found.of_moved(4, deg=True), np.rad2deg(4 * turn), atol=1e-6)
    assert len(found.of_moved(4, among=np.array([[False, True]]))) == 0
    assert (found.of_still(4) == 0).all()  # the second object


def test_moved_is_ten_millimetres_or_five_degrees():
    few = errors(w := windows_of([episode(speed=0.002)]), constant(w), NONE)
    assert not few.moved[HORIZONS.index(4)].any()
    assert few.moved[HORIZONS.index(6), :, 0].all()
    turned = errors(w := windows_of([episode(turn=np.deg2rad(1.3))]), constant(w), NONE)
    assert turned.moved[HORIZONS.index(4), :, 0].all()
    assert not turned.moved[HORIZONS.index(3)].any()
    assert not turned.moved[:, :, 1].any()


def test_the_truth_has_no_error_and_symmetric_turns_are_none():
    windows = windows_of([episode(speed=0.01, turn=0.02)])
    truth = Predicted(windows.positions[:, 2:], windows.quaternions[:, 2:])
    found = errors(windows, truth, NONE)
    assert found.mm.max() < 1e-9
    assert found.deg.max() < 1e-5
    round_can = NONE | {NAMES[0]: Symmetry("continuous", axis=(0.0, 0.0, 1.0), reason="plain")}
    assert errors(windows, constant(windows), round_can).deg.max() < 1e-5
    brick = NONE | {NAMES[0]: Symmetry("discrete", ((0.0, 0.0, 0.0, 1.0),), reason="plain")}
    half_turned = Predicted(truth.positions, truth.quaternions.copy())
    half_turned.quaternions[:] = quaternion_exp(np.array([0, 0, np.pi]))
    still = windows_of([episode(speed=0.01)])
    assert errors(still, half_turned, brick).deg[:, :, 0].max() < 1e-5
    assert errors(still, half_turned, NONE).deg[:, :, 0].min() > 179


def test_predictors_leave_alone_what_nothing_touches():
    windows = windows_of([episode()])
    network = PropagationNetwork(8, 1)
    for predicted in (learned(network, shapes(), windows), analytic(shapes(), windows)):
        assert predicted.positions.shape == (len(windows.names), LONGEST, 2, 3)
        np.testing.assert_allclose(predicted.positions, windows.positions[:, 2:], atol=1e-6)
        np.testing.assert_allclose(predicted.quaternions, windows.quaternions[:, 2:], atol=1e-6)
