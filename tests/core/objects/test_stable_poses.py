import numpy as np
import pytest
import trimesh

from osfcore.geometry.poses import quaternion_conjugate, rotate
from osfcore.objects.mesh import MAX_POSES, resting_poses


def box_parts(sides):
    return (np.array(trimesh.creation.box(sides).vertices),)


def test_a_box_rests_on_each_face():
    sides = np.array([0.10, 0.09, 0.08])
    resting = resting_poses(box_parts(sides))
    assert len(resting.quaternions) == 6
    downs = np.array([rotate(quaternion_conjugate(q), np.array([0, 0, -1.0])) for q in resting.quaternions])
    np.testing.assert_allclose(np.abs(downs).max(axis=1), 1, atol=1e-6)
    assert len({tuple(d.round(3) + 0.0) for d in downs}) == 6
    largest_face = np.abs(downs[0])
    assert largest_face[2] == pytest.approx(1)  # 10 x 9 cm is the largest


def test_probabilities_are_a_distribution_largest_first():
    resting = resting_poses(box_parts((0.1, 0.06, 0.05)))
    assert resting.probabilities.sum() == pytest.approx(1)
    assert (np.diff(resting.probabilities) <= 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(resting.quaternions, axis=1), 1, atol=1e-9)


def test_a_thin_plate_does_not_stand_on_its_edge():
    resting = resting_poses(box_parts((0.2, 0.2, 0.005)))
    ups = np.array([rotate(q, np.array([0, 0, 1.0])) for q in resting.quaternions])
    np.testing.assert_allclose(np.abs(ups[:, 2]), 1, atol=1e-6)


def test_a_can_stands_and_lies_in_a_handful_of_ways():
    can = np.array(trimesh.creation.cylinder(0.035, 0.1, sections=64).vertices)
    resting = resting_poses((can,))
    assert 3 <= len(resting.quaternions) <= MAX_POSES
    ups = np.abs(np.array([rotate(q, np.array([0, 0, 1.0])) for q in resting.quaternions])[:, 2])
    assert np.all((ups > 0.999) | (ups < 0.03))


def test_mass_counts_where_the_parts_are():
    block = np.array(trimesh.creation.box((0.1, 0.1, 0.1)).vertices)
    rod = trimesh.creation.box((0.01, 0.01, 0.2))
    rod.apply_translation((0, 0, 0.15))
    resting = resting_poses((block, np.array(rod.vertices)))
    ups = np.array([rotate(q, np.array([0, 0, 1.0])) for q in resting.quaternions])
    assert ups[:, 2].max() == pytest.approx(1)  # standing on the block
    assert (ups[:, 2] > -0.7).all()  # never balanced on the rod


def test_the_same_parts_give_the_same_poses(library):
    parts = library.load("006_mustard_bottle").parts
    first, second = resting_poses(parts), resting_poses(parts)
    assert np.array_equal(first.quaternions, second.quaternions)
    assert np.array_equal(first.probabilities, second.probabilities)


@pytest.mark.parametrize("name", ["003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "035_power_drill"])
def test_real_objects_have_their_centre_over_what_they_stand_on(name, library):
    asset = library.load(name)
    points = np.concatenate(asset.parts)
    assert 2 <= len(asset.resting.quaternions) <= MAX_POSES
    for q in asset.resting.quaternions:
        placed = rotate(q, points)
        feet = placed[placed[:, 2] < placed[:, 2].min() + 1e-3][:, :2]
        assert len(feet) >= 3
        # the frame's origin is near the centre of mass for these bodies
        assert (feet.min(axis=0) < 0.03).all()
        assert (feet.max(axis=0) > -0.03).all()
