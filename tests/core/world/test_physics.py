import numpy as np
import pytest

from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_CENTRE_Z_M, PUSHER_RADIUS_M, PUSHER_REACH_M
from osfcore.world.physics import SUBSTEPS, TIME_STEP_S, Physics, body_model, lowest_point, mass_properties
from osfcore.world.scenes import settle
from osfcore.world.simulators import simulate
from tests.core.world.boxes import box_asset

BOX = box_asset("box", (0.08, 0.06, 0.04), mass_kg=0.3)
LEVEL = np.array([1.0, 0, 0, 0])


FRICTION = {"pybullet": 0.5, "mujoco": 0.31}


@pytest.fixture(params=FRICTION)
def simulator(request):
    """Each of the two."""
    return pytest.importorskip(request.param).__name__


@pytest.fixture
def simulated(simulator):
    """Makes simulations of boxes, and closes them."""
    made = []

    def make(*names, model=None, **factors):
        made.append(simulate({name: model or body_model(BOX) for name in names or ("box",)}, simulator, **factors))
        return made[-1]

    yield make
    for physics in made:
        physics.close()


def test_mass_properties_of_a_turned_box_are_the_closed_form_and_parts_add_up():
    a, b, c = 0.08, 0.06, 0.04
    turned = Pose(np.array([0.01, -0.02, 0.03]), quaternion_exp(np.array([0.3, 0.5, -0.2])))
    halves = [BOX.parts[0].copy(), BOX.parts[0].copy()]
    halves[0][:, 0], halves[1][:, 0] = np.maximum(halves[0][:, 0], 0), np.minimum(halves[1][:, 0], 0)
    for parts in (BOX.parts, halves):
        frame, moments = mass_properties(tuple(turned.apply(part) for part in parts), 0.3)
        np.testing.assert_allclose(frame.position, turned.position, atol=1e-9)
        expected = 0.3 / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
        np.testing.assert_allclose(moments, expected, rtol=1e-6)


def test_box_rests_on_the_table_without_sinking_or_jitter(simulated):
    physics = simulated()
    physics.place("box", Pose(np.array([0.0, 0, 0.021]), LEVEL))
    settle(physics, ("box",))
    before = physics.pose("box")
    for _ in range(240):
        physics.step(np.zeros(3))
        assert physics.speed("box")[0] < 1e-3
    after = physics.pose("box")
    assert after.position[2] == pytest.approx(0.02, abs=2e-4)
    np.testing.assert_allclose(after.position, before.position, atol=1e-4)


def test_pose_is_of_the_object_frame_not_of_the_centre_of_mass(simulated):
    shifted = type(BOX)(BOX.info, BOX.mesh, (BOX.parts[0] + [0.01, 0.005, 0],), BOX.resting)
    pose = Pose(np.array([0.1, 0.05, 0.2]), quaternion_exp(np.array([0.1, 0.2, 0.3])))
    physics = simulated(model=body_model(shifted))
    physics.place("box", pose)
    np.testing.assert_allclose(physics.pose("box").matrix(), pose.matrix(), atol=1e-6)


def pushed(physics: Physics) -> float:
    """How far an action at full speed, begun 1 mm before the box, pushes it [m]."""
    physics.place("box", Pose(np.array([0.0, 0, 0.02]), LEVEL))
    settle(physics, ("box",))
    physics.place_pusher(np.array([-0.04 - PUSHER_RADIUS_M - 0.001, 0, PUSHER_CENTRE_Z_M]))
    for _ in range(SUBSTEPS):
        physics.step(np.array([MAX_SPEED_M_S, 0, 0]))
    return float(physics.pose("box").position[0])


@pytest.mark.parametrize(("friction", "mass"), [(1, 1), (0.5, 1), (2, 1), (1, 0.5), (1, 2)])
def test_sliding_box_stops_by_coulomb_friction_whatever_its_mass(simulated, simulator, friction, mass):
    """v^2 / (2 mu g) with a factor on mu: from 0.3 m/s, 9.2 mm in PyBullet and 14.8 mm in MuJoCo with the factor 1."""
    physics = simulated(friction_factor=friction, mass_factor=mass)
    physics.place("box", Pose(np.array([0.0, 0, 0.02]), LEVEL))
    settle(physics, ("box",))
    physics.set_velocity("box", np.array([0.3, 0, 0]), np.zeros(3))
    settle(physics, ("box",))
    slid = float(physics.pose("box").position[0])
    assert slid == pytest.approx(0.3**2 / (2 * friction * FRICTION[simulator] * 9.81), rel=0.1)


def test_a_box_heavier_than_the_pusher_yields_more_slowly(simulated):
    """Three times its mass: no object is, but only then does a mass show where everything is pushed."""
    light, heavy = (pushed(simulated(mass_factor=mass)) for mass in (1, 1000))
    assert 0 < light - heavy < 0.02


def test_pusher_follows_its_velocity_exactly_pushes_what_it_meets_and_stops_at_its_reach(simulated):
    physics = simulated()
    physics.place("box", Pose(np.array([0.0, 0, 0.02]), LEVEL))
    start = np.array([-0.1, 0.0, PUSHER_CENTRE_Z_M])
    physics.place_pusher(start)
    touched = [physics.step(np.array([0.3, 0.1, 0])) for _ in range(SUBSTEPS)]
    np.testing.assert_allclose(physics.pusher, start + [0.06, 0.02, 0], atol=1e-12)
    assert frozenset(["box"]) in touched
    assert frozenset() == touched[0]
    assert -0.001 < physics.distance("box", None) < 0.01
    assert physics.pose("box").position[0] > 0.01
    physics.place_pusher(np.array([PUSHER_REACH_M - 0.01, 0, PUSHER_CENTRE_Z_M]))
    for _ in range(SUBSTEPS):
        physics.step(np.array([0.3, 0.3, 0]))
    np.testing.assert_allclose(physics.pusher[:2], [PUSHER_REACH_M, 0.3 * SUBSTEPS * TIME_STEP_S], atol=1e-9)


def test_gap_between_boxes_is_the_true_one_and_separation_the_way_out(simulated):
    physics = simulated("a", "b")
    physics.place("a", Pose(np.array([0.0, 0, 0.02]), LEVEL))
    for x, gap in ((0.09, 0.01), (0.07, -0.01), (0.3, 0.05)):
        physics.place("b", Pose(np.array([x, 0, 0.02]), LEVEL))
        assert physics.distance("a", "b") == pytest.approx(gap, abs=5e-4)
        found, away = physics.separation("b", "a")
        assert found == pytest.approx(gap, abs=5e-4)
        np.testing.assert_allclose(away, [1, 0, 0] if gap < 0.05 else [0, 0, 1], atol=1e-3)


def test_lowest_point_of_a_turned_box():
    assert lowest_point(BOX, LEVEL) == pytest.approx(-0.02)
    assert lowest_point(BOX, quaternion_exp(np.array([np.pi / 2, 0, 0]))) == pytest.approx(-0.03)
