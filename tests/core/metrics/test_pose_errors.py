import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate
from osfcore.metrics.pose_errors import adds, direction_components, rotation_components, rotation_error
from osfcore.objects.asset import Symmetry
from osfcore.objects.catalogue import CATALOGUE

NONE = Symmetry("none", reason="labelled")
ROUND = Symmetry("continuous", axis=(0.0, 0.0, 1.0), reason="a bowl")
seeds = st.integers(0, 2**32 - 1)


def turn(*vector):
    return quaternion_exp(np.array(vector, float))


def random_turn(seed):
    return quaternion_exp(np.random.default_rng(seed).normal(size=3))


@given(seeds, st.floats(0, 3.1))
@settings(max_examples=40)
def test_without_symmetry_it_is_the_angle(seed, angle):
    true = random_turn(seed)
    axis = np.random.default_rng(seed + 1).normal(size=3)
    off = quaternion_multiply(quaternion_exp(angle * axis / np.linalg.norm(axis)), true)
    assert rotation_error(NONE, off, true) == pytest.approx(angle, abs=1e-6)


@given(seeds, st.floats(-3, 3), st.floats(0, 3.1))
@settings(max_examples=40)
def test_turns_about_the_axis_of_a_round_body_do_not_count(seed, spin, tilt):
    true = random_turn(seed)
    off = quaternion_multiply(quaternion_multiply(true, turn(tilt, 0, 0)), turn(0, 0, spin))
    assert rotation_error(ROUND, off, true) == pytest.approx(tilt, abs=1e-6)


@pytest.mark.parametrize("name", [n for n, info in CATALOGUE.items() if info.symmetry.kind == "discrete"])
@given(seeds)
@settings(max_examples=40)
def test_orientations_that_look_alike_are_no_error(name, seed):
    symmetry, true = CATALOGUE[name].symmetry, random_turn(seed)
    for like in symmetry.rotations:
        assert rotation_error(symmetry, quaternion_multiply(true, np.array(like)), true) < 1e-6


@given(seeds, st.sampled_from(sorted(CATALOGUE)))
@settings(max_examples=40)
def test_components_are_those_of_a_small_turn(seed, name):
    symmetry, true = CATALOGUE[name].symmetry, random_turn(seed)
    vector = np.random.default_rng(seed + 1).normal(size=3) * 0.02
    alike = true if symmetry.kind != "discrete" else quaternion_multiply(true, np.array(symmetry.rotations[0]))
    found = rotation_components(symmetry, quaternion_multiply(quaternion_exp(vector), alike), true)
    if symmetry.kind == "continuous":
        axis = rotate(true, np.asarray(symmetry.axis))
        assert found.shape == (2,)
        assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(vector - axis * (axis @ vector)), abs=1e-3)
    else:
        np.testing.assert_allclose(found, vector, atol=1e-9)


@given(seeds, st.floats(0, np.pi))
@settings(max_examples=40)
def test_directions_differ_by_the_angle_between_them(seed, angle):
    rng = np.random.default_rng(seed)
    true, across = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    found = direction_components(np.cos(angle) * true + np.sin(angle) * across, true)
    assert np.linalg.norm(found) == pytest.approx(angle, abs=1e-6)


@given(seeds)
@settings(max_examples=40)
def test_adds_of_a_small_shift_is_at_most_the_shift_and_of_a_symmetric_turn_none(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(200, 3))
    true = Pose(rng.normal(size=3), random_turn(seed))
    shift = rng.normal(size=3) * 1e-3
    assert adds(points, true, true) == pytest.approx(0, abs=1e-12)
    assert adds(points, Pose(true.position + shift, true.quaternion), true) <= np.linalg.norm(shift) + 1e-12
    corners, flat = np.array(list(np.ndindex(2, 2, 2)), float) - 0.5, Pose.identity()
    assert adds(corners, Pose(np.zeros(3), turn(0, 0, np.pi / 2)), flat) == pytest.approx(0, abs=1e-12)
    assert adds(corners, Pose(np.zeros(3), turn(0, 0, np.pi / 4)), flat) > 0.1
