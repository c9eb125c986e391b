import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp, rotate
from osfcore.photo.table_layout import place_on_table
from tests.support.errors import about


def standing(x, y, turn=0.0):
    return Pose(np.array([x, y, 0.05]), quaternion_exp(np.array([0.0, 0.0, turn])))


@pytest.mark.parametrize("place", [(0.3, -0.4, 0.5), (-0.6, 0.1, 0.4), (0.0, 0.7, 0.3)])
def test_the_camera_looks_along_y_and_the_objects_are_moved_rigidly_into_the_middle(place):
    camera = Camera.look_at("photo", np.array(place), np.array([0.2, 0.1, 0.0])).T_world_camera
    objects = [standing(0.2, 0.1), standing(0.32, 0.15, 1.0), standing(0.25, -0.1)]
    T = place_on_table(camera, objects)
    direction = rotate((T @ camera).quaternion, np.array([0.0, 0.0, 1.0]))
    assert direction[1] > 0
    assert direction[0] == pytest.approx(0, abs=1e-9)
    placed = np.array([(T @ pose).position for pose in objects])
    np.testing.assert_allclose((placed.min(axis=0) + placed.max(axis=0))[:2], 0, atol=1e-12)
    np.testing.assert_allclose(placed[:, 2], 0.05, atol=1e-12)


def test_the_top_of_a_photo_from_straight_above_is_ahead_and_a_wide_layout_is_refused():
    down = Pose(np.array([0.0, 0.0, 0.8]), np.array([0.0, 1.0, 0.0, 0.0]))  # image's y runs along -y of the table
    T = place_on_table(down, [standing(0.0, 0.0)])
    np.testing.assert_allclose(T.quaternion, [1, 0, 0, 0], atol=1e-12)
    with pytest.raises(InvalidInput, check=about("distance between the objects")):
        place_on_table(down, [standing(-0.3, 0.0), standing(0.3, 0.0)])
