import contextlib
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, NoRoom, OverlappingObjects
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, WORKSPACE_HALF_M
from osfcore.world.imaging import Lamp, TableSurface
from osfcore.world.physics import body_model
from osfcore.world.scenes import Conditions, SceneRequest, is_calm, move_apart, place_randomly, refuse_overlaps, settle
from osfcore.world.simulators import simulate
from tests.core.world.boxes import box_asset
from tests.support.errors import about


@pytest.fixture(params=["pybullet", "mujoco"])
def physics_of(request):
    """Starts a simulation of objects by each of the two engines."""
    pytest.importorskip(request.param)

    def start(assets):
        models = {name: body_model(asset) for name, asset in assets.items()}
        return contextlib.closing(simulate(models, request.param))

    return start


def test_scenes_of_real_objects_lie_apart_inside_the_workspace_at_rest(physics_of, library):
    assets = {name: library.load(name) for name in library.names()}
    with physics_of(assets) as physics:
        for seed in range(3):
            place_randomly(physics, assets, np.random.default_rng(seed))
            assert is_calm(physics, tuple(assets))
            for i, name in enumerate(assets):
                assert np.abs(physics.pose(name).position[:2]).max() <= WORKSPACE_HALF_M
                assert physics.table_distance(name) > -1e-3
                assert physics.distance(name, None) > 0.015
                assert all(physics.distance(name, other) > 0 for other in list(assets)[i + 1 :])


def test_objects_that_cannot_fit_are_refused(physics_of):
    assets = {name: box_asset(name, (0.7, 0.7, 0.02)) for name in "ab"}
    with physics_of(assets) as physics, pytest.raises(NoRoom):
        place_randomly(physics, assets, np.random.default_rng(0))


def test_everything_that_moves_at_pushing_speed_stops_within_a_second(physics_of, library):
    """In every resting pose, pushed at 0.3 m/s and let go; rolling friction stops cans and bottles too."""
    for name in library.names():
        asset = library.load(name)
        with physics_of({name: asset}) as physics:
            for quaternion in asset.resting.quaternions:
                bottom = quaternion_to_matrix(quaternion)[2] @ np.concatenate(asset.parts).T
                physics.place(name, Pose(np.array([0, 0, -bottom.min()]), quaternion))
                settle(physics, (name,))
                physics.set_velocity(name, np.array([0.3, 0, 0]), np.zeros(3))
                assert settle(physics, (name,)) <= 240 + 12


# Two boxes, "b" in the middle of the table and "a" moved apart from it

SIDE = 0.1


@pytest.mark.parametrize(
    ("place", "expected_a", "expected_b"),
    [
        ((0.09, 0, SIDE / 2), (0.095, 0, SIDE / 2), (-0.005, 0, SIDE / 2)),  # side by side: each gives way by half
        ((0.01, 0, 1.5 * SIDE - 0.008), (0.01, 0, 1.5 * SIDE), (0, 0, SIDE / 2)),  # a stack: the upper one is lifted
        ((0.3, 0, SIDE / 2 - 0.012), (0.3, 0, SIDE / 2), (0, 0, SIDE / 2)),  # sunk into the table
    ],
)
def test_boxes_are_moved_apart_as_little_as_needed(physics_of, place, expected_a, expected_b):
    level, names = np.array([1.0, 0, 0, 0]), ("a", "b")
    with physics_of({name: box_asset(name, (SIDE, SIDE, SIDE)) for name in names}) as physics:
        physics.place_pusher(np.array([0.5, 0.5, 0.06]))
        physics.place("a", Pose(np.array(place), level))
        physics.place("b", Pose(np.array([0.0, 0, SIDE / 2]), level))
        with pytest.raises(OverlappingObjects):
            refuse_overlaps(physics, names)
        move_apart(physics, names)
        refuse_overlaps(physics, names)
        np.testing.assert_allclose(physics.pose("a").position, expected_a, atol=1e-3)
        np.testing.assert_allclose(physics.pose("b").position, expected_b, atol=1e-3)


# Conditions

CAMERAS = default_cameras(48)


@pytest.mark.slow
def test_a_world_is_seen_under_its_lamp_and_on_its_table(tables):
    changed = (None, Conditions(lamp=Lamp(intensity=0.5)), Conditions(table=TableSurface((0.2, 0.3, 0.6))))
    usual, dim, blue = (tables(0, conditions=conditions) for conditions in changed)
    a, b, c = ([p.rgb[p.coverage.max(axis=0) > 0.999] for p in w.pictures(CAMERAS)] for w in (usual, dim, blue))
    for mine, halved, same in zip(a, b, c, strict=True):
        np.testing.assert_allclose(halved, 0.5 * mine, atol=1e-6)
        np.testing.assert_array_equal(same, mine)  # no light goes from the table to objects
    open_table = blue.observe().images[0, -1, 24]
    np.testing.assert_allclose(open_table[0] / open_table[2], 1 / 3, rtol=1e-3)


def test_objects_slide_farther_on_less_friction(tables):
    """In proportion, as Coulomb has it."""
    slid = []
    for factor in (0.5, 1.0, 2.0):
        world = tables(
            1, conditions=Conditions(friction_factor=factor), request=SceneRequest(names=("009_gelatin_box",))
        )
        state = world.truth()
        assert state.poses.position[0, 2] < 0.02  # it lies flat
        world.restore(replace(state, pusher=np.array([*state.poses.position[0, :2] - [0.07, 0], PUSHER_CENTRE_Z_M])))
        world.act(np.array([0.3, 0, 0]))
        released = world.truth().poses.position[0, :2]
        for _ in world.settle():
            pass
        slid.append(float(np.linalg.norm(world.truth().poses.position[0, :2] - released)))
    assert slid[:2] == pytest.approx([2 * slid[1], 2 * slid[2]], rel=0.25)


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_factors_that_no_world_has_are_refused(factor):
    for what in ("friction", "mass"):
        with pytest.raises(InvalidInput, check=about(what)):
            Conditions(**{f"{what}_factor": factor})


def test_a_near_lamp_takes_the_place_of_the_scenes_light(tables):
    """In pictures, and in the truth as the direction in which it stands; the rest of the scene stays as it is."""
    spot = SpotLamp(np.array([0.2, -0.1, 0.5]), np.zeros(3), 20, 25)
    usual, near = (tables(2, conditions=conditions) for conditions in (None, Conditions(spot=spot)))
    np.testing.assert_array_equal(usual.truth().poses.position, near.truth().poses.position)
    np.testing.assert_allclose(near.truth().light.direction, spot.direction, atol=1e-12)
    first = near.observe().images
    near.set_light(Light(np.array([0, 0, 1.0])))
    np.testing.assert_array_equal(near.observe().images, first)
    x, y = np.floor(CAMERAS[0].project(np.array([-0.5, 0.0, 0]))).astype(int)
    assert first[0][y, x, 0] == pytest.approx(0.25 * 0.66, abs=1e-3)  # outside the cone
