from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.objective import fibonacci_sphere, resting_orientations, yaw_quaternions
from osfcore.geometry.poses import Pose, rotate, rotation_angle
from tests.core.render.scenes import ball, block

HALF = np.array([0.06, 0.045, 0.09])


@pytest.fixture(scope="module")
def box():
    return resting_orientations(block(HALF, voxel=0.005), yaws=4)


def down(resting):
    """The direction in the object's frame that points down, of each orientation."""
    conjugate = resting.quaternions * [1, -1, -1, -1]
    return rotate(conjugate, np.array([0, 0, -1.0]))


def test_a_box_lies_on_its_six_faces(box):
    assert len(box.quaternions) == len(box.heights) == 6 * 4
    faces = down(box)
    axes = np.abs(faces).argmax(axis=1)
    assert np.all(np.abs(faces).max(axis=1) > np.cos(np.deg2rad(5)))
    sides = {(int(axis), bool(face[axis] > 0)) for axis, face in zip(axes, faces, strict=True)}
    assert len(sides) == 6
    # Corners a voxel's part inside the surface count as its solid, and directions are a few degrees apart.
    np.testing.assert_allclose(box.heights, HALF[axes], atol=0.006)


def test_the_flattest_comes_first(box):
    assert np.all(np.diff(box.heights) >= 0)
    assert np.abs(down(box)[0]).argmax() == HALF.argmin()


def test_the_centre_and_the_radius_are_those_of_the_solid(box):
    np.testing.assert_allclose(box.centre, 0, atol=1e-4)
    assert box.radius == pytest.approx(np.linalg.norm(HALF), abs=0.01)


def test_every_way_is_turned_about_the_vertical(box):
    np.testing.assert_allclose(np.linalg.norm(box.quaternions, axis=1), 1, atol=1e-12)
    for own in box.quaternions.reshape(6, 4, 4):
        turns = rotation_angle(own, own[0])
        np.testing.assert_allclose(np.sort(turns), np.array([0, 1, 1, 2]) * np.pi / 2, atol=1e-6)


def test_the_centre_of_mass_is_found_off_the_origin():
    field = block(HALF)
    moved = replace(field, origin=field.origin + np.float32([0.01, -0.02, 0.03]))
    here, there = resting_orientations(field, yaws=1), resting_orientations(moved, yaws=1)
    np.testing.assert_allclose(there.centre - here.centre, [0.01, -0.02, 0.03], atol=1e-4)
    np.testing.assert_allclose(there.heights, here.heights, atol=1e-4)


def test_a_sphere_lies_in_every_way():
    resting = resting_orientations(ball(0.05), yaws=1)
    assert len(resting.heights) > 40
    np.testing.assert_allclose(resting.heights, 0.05, atol=0.006)
    assert np.abs(down(resting).mean(axis=0)).max() < 0.1


def test_the_lowest_solid_corner_is_on_the_table():
    field = block(HALF)
    points = field.origin + field.voxel * np.argwhere(field.density > 2)
    resting = resting_orientations(field, yaws=2)
    for quaternion, height in zip(resting.quaternions, resting.heights, strict=True):
        z = rotate(quaternion, points - resting.centre)[:, 2]
        assert z.min() + height == pytest.approx(0, abs=1e-6)
        lifted = Pose(np.array([0.3, -0.2, height + 0.05]) - rotate(quaternion, resting.centre), quaternion)
        assert resting.lowest(lifted) == pytest.approx(0.05, abs=1e-6)


def test_real_objects_lie_in_a_few_ways(models):
    for name in models.together.names:
        resting = models.resting(name)
        assert 5 <= len(resting.heights) / 24 <= 12
        assert np.all(resting.heights <= resting.radius)


def test_the_sphere_is_even():
    directions = fibonacci_sphere(500)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=5e-3)
    np.testing.assert_allclose(directions.T @ directions / 500, np.eye(3) / 3, atol=5e-3)
    cosines = directions @ directions.T - 2 * np.eye(500)
    nearest = np.rad2deg(np.arccos(cosines.max(axis=1)))
    assert nearest.min() > 5
    assert nearest.max() < 12


def test_turns_about_the_vertical():
    turned = rotate(yaw_quaternions(np.array([0, np.pi / 2, np.pi])), np.array([1.0, 0, 2]))
    np.testing.assert_allclose(turned, [[1, 0, 2], [0, 1, 2], [-1, 0, 2]], atol=1e-12)
