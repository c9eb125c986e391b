"""Scenes: placing, conditions."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, NoRoom
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_to_matrix, rotate
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, WORKSPACE_HALF_M
from osfcore.world.imaging import Lamp, TableSurface
from osfcore.world.physics import Physics, body_model
from osfcore.world.scenes import Conditions, SceneRequest, is_calm, place_randomly, random_rest, settle
from osfcore.world.tabletop import Tabletop
from tests.core.world.boxes import box_asset

# Placing


def test_scenes_of_real_objects_lie_apart_inside_the_workspace_at_rest(library):
    assets = {name: library.load(name) for name in library.names()}
    physics = Physics({name: body_model(asset) for name, asset in assets.items()})
    for seed in range(5):
        place_randomly(physics, assets, np.random.default_rng(seed))
        assert is_calm(physics, tuple(assets))
        for i, name in enumerate(assets):
            assert np.abs(physics.pose(name).position[:2]).max() <= WORKSPACE_HALF_M
            assert physics.table_distance(name) > -1e-3
            assert physics.distance(name, None) > 0.015
            assert all(physics.distance(name, other) > 0 for other in list(assets)[i + 1 :])
    physics.close()


def test_what_cannot_fit_is_told():
    assets = {f"box{i}": box_asset(f"box{i}", (0.5, 0.5, 0.02)) for i in range(3)}
    physics = Physics({name: body_model(asset) for name, asset in assets.items()})
    with pytest.raises(NoRoom, match="box0, box1, box2"):
        place_randomly(physics, assets, np.random.default_rng(0))
    physics.close()


def test_random_rest_turns_a_resting_pose_about_the_vertical():
    asset = box_asset("box", (0.1, 0.05, 0.02))
    rng = np.random.default_rng(0)
    for _ in range(10):
        up = rotate(random_rest(asset, rng), np.array([0.0, 0, 1]))
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-12)


def test_everything_that_moves_at_pushing_speed_stops_within_a_second(library):
    """In every resting pose, pushed at 0.3 m/s and let go; rolling friction stops cans and bottles too."""
    for name in library.names():
        asset = library.load(name)
        physics = Physics({name: body_model(asset)})
        for quaternion in asset.resting.quaternions:
            bottom = quaternion_to_matrix(quaternion)[2] @ np.concatenate(asset.parts).T
            physics.place(name, Pose(np.array([0, 0, -bottom.min()]), quaternion))
            settle(physics, (name,))
            physics.set_velocity(name, np.array([0.3, 0, 0]))
            assert settle(physics, (name,)) <= 240 + 12
        physics.close()


# Conditions


FLAT = 1  # the seed of a scene in which the box lies flat
CAMERAS = default_cameras(48)
PUSHES = [np.array(action) for action in ([0.3, 0.0, 0], [-0.3, 0.2, 0], [0.0, -0.3, 0], [0.3, 0.3, 0])]


def world_with(library, conditions: Conditions | None, **given) -> Tabletop:
    return Tabletop(library, cameras=CAMERAS, conditions=conditions, **given)


def test_default_conditions_are_no_conditions_to_the_last_bit(library):
    images, states = [], []
    for conditions in (None, Conditions()):
        world = world_with(library, conditions)
        world.arrange(3)
        for push in PUSHES:
            world.act(push)
        images.append(world.observe().images)
        states.append(world.truth())
        world.close()
    np.testing.assert_array_equal(*images)
    np.testing.assert_array_equal(*(state.poses.position for state in states))
    np.testing.assert_array_equal(*(state.poses.quaternion for state in states))


def test_a_world_is_seen_under_its_lamp_and_on_its_table(library):
    usual, dim, blue = (
        world_with(library, c)
        for c in (None, Conditions(lamp=Lamp(intensity=0.5)), Conditions(table=TableSurface((0.2, 0.3, 0.6))))
    )
    for world in (usual, dim, blue):
        world.arrange(0)
    a, b, c = ([p.rgb[p.coverage.max(axis=0) > 0.999] for p in w.pictures(CAMERAS)] for w in (usual, dim, blue))
    for mine, halved, same in zip(a, b, c, strict=True):
        np.testing.assert_allclose(halved, 0.5 * mine, atol=1e-6)
        np.testing.assert_array_equal(same, mine)  # no light goes from the table to objects
    open_table = blue.observe().images[0, -1, 24]
    np.testing.assert_allclose(open_table[0] / open_table[2], 1 / 3, rtol=1e-3)
    for world in (usual, dim, blue):
        world.close()


def slide_m(library, conditions: Conditions) -> float:
    """How far a flat box goes on after a push at full speed."""
    world = world_with(library, conditions, request=SceneRequest(names=("009_gelatin_box",)))
    world.arrange(FLAT)
    state = world.truth()
    assert state.poses.position[0, 2] < 0.02
    behind = np.array([*state.poses.position[0, :2] - [0.07, 0], PUSHER_CENTRE_Z_M])
    world.restore(replace(state, pusher=behind))
    world.act(np.array([0.3, 0, 0]))
    released = world.truth().poses.position[0, :2]
    for _ in world.settle():
        pass
    slid = np.linalg.norm(world.truth().poses.position[0, :2] - released)
    world.close()
    return float(slid)


def test_objects_slide_farther_on_less_friction(library):
    """In proportion, as Coulomb has it."""
    half, usual, double = (slide_m(library, Conditions(friction_factor=factor)) for factor in (0.5, 1.0, 2.0))
    assert half == pytest.approx(2 * usual, rel=0.25)
    assert usual == pytest.approx(2 * double, rel=0.25)


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_factors_that_no_world_has_are_refused(factor):
    with pytest.raises(InvalidInput, match="friction"):
        Conditions(friction_factor=factor)
    with pytest.raises(InvalidInput, match="mass"):
        Conditions(mass_factor=factor)


def test_a_near_lamp_takes_the_place_of_the_scenes_light(library):
    """In pictures, and in the truth as the direction in which it stands; the rest of the scene stays as it is."""
    spot = SpotLamp(np.array([0.2, -0.1, 0.5]), np.zeros(3), 20, 25)
    usual, near = (world_with(library, c) for c in (None, Conditions(spot=spot)))
    for world in (usual, near):
        world.arrange(2)
    np.testing.assert_array_equal(usual.truth().poses.position, near.truth().poses.position)
    np.testing.assert_allclose(near.truth().light.direction, spot.direction, atol=1e-12)
    first = near.observe().images
    near.set_light(Light(np.array([0, 0, 1.0])))
    np.testing.assert_array_equal(near.observe().images, first)
    x, y = np.floor(CAMERAS[0].project(np.array([-0.5, 0.0, 0]))).astype(int)
    assert first[0][y, x, 0] == pytest.approx(0.25 * 0.66, abs=1e-3)  # outside the cone
    usual.close()
    near.close()
