import numpy as np
import pytest

from osfcore.errors import NoRoom
from osfcore.geometry.poses import Pose, quaternion_to_matrix, rotate
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.world.physics import Physics, body_model
from osfcore.world.scenes import is_calm, place_randomly, random_rest, settle
from tests.core.world.boxes import box_asset


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
