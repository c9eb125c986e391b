"""Lenses: what OpenCV bends is straight again, and descriptions that are not understood are refused by name."""

import cv2
import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.photo.lens import Lens, lens_of
from tests.support.errors import about

SIZE = (640, 480)
K = np.array([[420.0, 0, 322.0], [0, 425.0, 236.0], [0, 0, 1]])  # pixel centres at whole numbers
FEW = (-0.28, 0.09, 0.001, -0.0007)
RATIONAL = (0.45, -2.7, 0.0006, -0.0002, 1.6, 0.33, -2.5, 1.5)  # as an Azure Kinect has them
WIDE = (-0.02, 0.012, -0.009, 0.002)
LENSES = (
    ("plumb_bob", FEW),
    ("radtan", FEW),  # Kalibr
    ("distortion.brown_conrady", (*FEW, -0.02)),  # RealSense
    ("", (*FEW, -0.02)),  # OpenCV
    ("rational_polynomial", RATIONAL),
    ("equidistant", WIDE),
    ("Kannala Brandt4", (*WIDE, 0.0)),
)
POINTS = np.array([[x, y, 1.0] for x in (-0.6, -0.2, 0.5) for y in (-0.4, 0.05, 0.42)])


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_points_of_the_straight_picture_are_where_a_pinhole_sees_them(model, coefficients):
    """A dot is drawn where OpenCV projects a point to, and found where K does."""
    lens, still = lens_of(K, model, coefficients, "the camera"), np.zeros(3)
    if lens.is_fisheye:
        bent = cv2.fisheye.projectPoints(POINTS[:, None], still, still, K, np.array(WIDE))[0].reshape(-1, 2)
    else:
        bent = cv2.projectPoints(POINTS, still, still, K, np.array(coefficients))[0].reshape(-1, 2)
    straight = POINTS[:, :2] * K[[0, 1], [0, 1]] + K[:2, 2]
    assert np.linalg.norm(bent - straight, axis=1).max() > 5
    np.testing.assert_allclose(lens.bent(straight + 0.5), bent + 0.5, atol=1e-6)
    for there, expected in zip(bent, straight, strict=True):
        picture = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        cv2.circle(picture, np.round(16 * there).astype(int).tolist(), 16 * 3, 255, -1, cv2.LINE_AA, 4)
        found = lens.straightened(picture)
        rows, columns = np.indices(found.shape)
        middle = [np.average(axis, weights=found) for axis in (columns, rows)]
        np.testing.assert_allclose(middle, expected, atol=0.3)


def test_a_lens_that_does_not_bend_leaves_pictures_alone_and_grows_with_the_picture():
    picture = np.zeros((4, 4), np.uint8)
    for model in ("plumb_bob", "none", "distortion.inverse_brown_conrady", "distortion.modified_brown_conrady", ""):
        lens = lens_of(K, model, [0.0] * 5, "the camera")
        assert lens.straightened(picture) is picture
        np.testing.assert_array_equal(lens.intrinsics[:2, 2], K[:2, 2] + 0.5)
    assert lens_of(K, "equidistant", [0.0] * 4, "the camera").bends
    larger = Lens(K, FEW).scaled((2, 3))
    np.testing.assert_array_equal(larger.intrinsics[:2], K[:2] * [[2], [3]])
    assert larger.coefficients == FEW


@pytest.mark.parametrize(
    ("change", "model", "coefficients", "what"),
    [
        (np.zeros((3, 3)), "fov", [0.9], "distortion_model"),
        (np.zeros((3, 3)), "distortion.inverse_brown_conrady", [0.1, 0, 0, 0, 0], "distortion_model"),
        (np.zeros((3, 3)), "plumb_bob", [0.1, 0.1, 0.1], "distortion of"),
        (np.zeros((3, 3)), "plumb_bob", [0.1] * 6, "distortion of"),
        (np.zeros((3, 3)), "equidistant", [0.1] * 5, "distortion of"),
        (np.zeros((3, 3)), "plumb_bob", [0.1, np.nan, 0, 0], "distortion of"),
        (np.array([[0, 0.4, 0], [0, 0, 0], [0, 0, 0]]), "plumb_bob", FEW, "skew"),
        (np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]]), "plumb_bob", FEW, "K of"),
        (-K, "plumb_bob", FEW, "K of"),
        (np.full((3, 3), np.nan), "plumb_bob", FEW, "K of"),
    ],
)
def test_what_is_not_modelled_is_refused(change, model, coefficients, what):
    with pytest.raises(InvalidInput, check=about(what)):
        lens_of(K + change, model, coefficients, "the camera")
