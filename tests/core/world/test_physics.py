import numpy as np
import pytest

from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_CENTRE_Z_M, PUSHER_RADIUS_M, PUSHER_REACH_M
from osfcore.world.physics import SUBSTEPS, TIME_STEP_S, Physics, body_model, lowest_point, mass_properties
from osfcore.world.scenes import settle
from tests.core.world.boxes import box_asset

BOX = box_asset("box", (0.08, 0.06, 0.04), mass_kg=0.3)
LEVEL = np.array([1.0, 0, 0, 0])


@pytest.fixture
def physics():
    simulation = Physics({"box": body_model(BOX)})
    yield simulation
    simulation.close()


def test_mass_properties_of_a_turned_box_are_the_closed_form():
    a, b, c = 0.08, 0.06, 0.04
    turned = Pose(np.array([0.01, -0.02, 0.03]), quaternion_exp(np.array([0.3, 0.5, -0.2])))
    frame, moments = mass_properties((turned.apply(BOX.parts[0]),), 0.3)
    np.testing.assert_allclose(frame.position, turned.position, atol=1e-9)
    expected = 0.3 / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    np.testing.assert_allclose(moments, expected, rtol=1e-6)


def test_parts_add_up_to_the_whole():
    halves = [BOX.parts[0].copy(), BOX.parts[0].copy()]
    halves[0][:, 0] = np.maximum(halves[0][:, 0], 0)
    halves[1][:, 0] = np.minimum(halves[1][:, 0], 0)
    whole, split = mass_properties(BOX.parts, 0.3), mass_properties(tuple(halves), 0.3)
    np.testing.assert_allclose(split[0].position, whole[0].position, atol=1e-9)
    np.testing.assert_allclose(split[1], whole[1], rtol=1e-6)


def test_box_rests_on_the_table_without_sinking_or_jitter(physics):
    physics.place("box", Pose(np.array([0.0, 0, 0.021]), LEVEL))
    settle(physics, ("box",))
    before = physics.pose("box")
    for _ in range(240):
        physics.step(np.zeros(3))
        assert physics.speed("box")[0] < 1e-3
    after = physics.pose("box")
    assert after.position[2] == pytest.approx(0.02, abs=2e-4)
    np.testing.assert_allclose(after.position, before.position, atol=1e-4)


def test_pose_is_of_the_object_frame_not_of_the_centre_of_mass():
    lopsided = box_asset("box", (0.08, 0.06, 0.04))
    shifted = type(lopsided)(lopsided.info, lopsided.mesh, (lopsided.parts[0] + [0.01, 0.005, 0],), lopsided.resting)
    simulation = Physics({"box": body_model(shifted)})
    pose = Pose(np.array([0.1, 0.05, 0.2]), quaternion_exp(np.array([0.1, 0.2, 0.3])))
    simulation.place("box", pose)
    np.testing.assert_allclose(simulation.pose("box").matrix(), pose.matrix(), atol=1e-6)
    simulation.close()


def pushed_and_let_go(physics: Physics) -> tuple[float, float]:
    """Where the pusher lets go of the box at full speed, and how far it then slides [m]."""
    physics.place("box", Pose(np.array([0.0, 0, 0.02]), LEVEL))
    settle(physics, ("box",))
    physics.place_pusher(np.array([-0.04 - PUSHER_RADIUS_M - 0.001, 0, PUSHER_CENTRE_Z_M]))
    for _ in range(SUBSTEPS):
        physics.step(np.array([MAX_SPEED_M_S, 0, 0]))
    released = float(physics.pose("box").position[0])
    settle(physics, ("box",))
    return released, float(physics.pose("box").position[0]) - released


@pytest.mark.parametrize(("friction", "mass"), [(1, 1), (0.5, 1), (2, 1), (1, 0.5), (1, 2)])
def test_sliding_box_stops_by_coulomb_friction_whatever_its_mass(friction, mass):
    """v^2 / (2 mu g) with mu = 0.5 * 1.0 and a factor: from 0.3 m/s, 9.2 mm with the factor 1."""
    simulation = Physics({"box": body_model(BOX)}, friction_factor=friction, mass_factor=mass)
    slid = pushed_and_let_go(simulation)[1]
    simulation.close()
    assert slid == pytest.approx(0.3**2 / (2 * friction * 0.5 * 9.81), rel=0.1)


def test_a_box_heavier_than_the_pusher_yields_more_slowly():
    """Three times its mass: no object is, but only then does a mass show where everything is pushed."""
    ends = []
    for mass in (1, 1000):
        simulation = Physics({"box": body_model(BOX)}, mass_factor=mass)
        ends.append(pushed_and_let_go(simulation)[0])
        simulation.close()
    assert 0.002 < ends[0] - ends[1] < 0.02


def test_a_box_in_the_air_goes_on_as_it_was_thrown(physics):
    physics.place("box", Pose(np.array([0.0, 0, 0.5]), LEVEL))
    physics.place_pusher(np.array([0.3, 0.3, PUSHER_CENTRE_Z_M]))
    physics.set_velocity("box", np.array([0.2, -0.1, 0]), np.array([0, 0, 2.0]))
    for _ in range(24):
        physics.step(np.zeros(3))
    pose = physics.pose("box")
    np.testing.assert_allclose(pose.position[:2], [0.02, -0.01], atol=1e-5)
    np.testing.assert_allclose(pose.quaternion, quaternion_exp(np.array([0, 0, 0.2])), atol=1e-4)


def test_pusher_follows_its_velocity_exactly_and_pushes_what_it_meets(physics):
    physics.place("box", Pose(np.array([0.0, 0, 0.02]), LEVEL))
    start = np.array([-0.1, 0.0, PUSHER_CENTRE_Z_M])
    physics.place_pusher(start)
    touched = [physics.step(np.array([0.3, 0.1, 0])) for _ in range(SUBSTEPS)]
    np.testing.assert_allclose(physics.pusher, start + [0.06, 0.02, 0], atol=1e-12)
    assert frozenset(["box"]) in touched
    assert frozenset() == touched[0]
    gap = physics.distance("box", None)
    assert -0.001 < gap < 0.01
    assert physics.pose("box").position[0] > 0.01


def test_pusher_stops_at_its_reach(physics):
    physics.place_pusher(np.array([PUSHER_REACH_M - 0.01, 0, PUSHER_CENTRE_Z_M]))
    for _ in range(SUBSTEPS):
        physics.step(np.array([0.3, 0.3, 0]))
    np.testing.assert_allclose(physics.pusher[:2], [PUSHER_REACH_M, 0.3 * SUBSTEPS * TIME_STEP_S], atol=1e-9)


def test_gap_between_boxes_is_the_true_one():
    simulation = Physics({"a": body_model(BOX), "b": body_model(BOX)})
    simulation.place("a", Pose(np.array([0.0, 0, 0.02]), LEVEL))
    simulation.place("b", Pose(np.array([0.09, 0, 0.02]), LEVEL))
    assert simulation.distance("a", "b") == pytest.approx(0.01, abs=5e-4)
    simulation.place("b", Pose(np.array([0.07, 0, 0.02]), LEVEL))
    assert simulation.distance("a", "b") == pytest.approx(-0.01, abs=5e-4)
    simulation.close()


def test_reset_forgets_everything(physics):
    def episode() -> np.ndarray:
        physics.reset()
        physics.place("box", Pose(np.array([0.0, 0, 0.02]), LEVEL))
        physics.place_pusher(np.array([-0.07, 0.01, PUSHER_CENTRE_Z_M]))
        for _ in range(100):
            physics.step(np.array([0.2, 0.05, 0]))
        return physics.pose("box").matrix()

    np.testing.assert_array_equal(episode(), episode())


def test_lowest_point_of_a_turned_box():
    assert lowest_point(BOX, LEVEL) == pytest.approx(-0.02)
    on_its_side = quaternion_exp(np.array([np.pi / 2, 0, 0]))
    assert lowest_point(BOX, on_its_side) == pytest.approx(-0.03)
