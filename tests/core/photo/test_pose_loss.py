"""Surfels of a field, windows of photographs, and the prior of a table."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import resting_orientations
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply
from osfcore.photo.photograph import Photograph
from osfcore.photo.pose_loss import PoseLoss, TablePrior, draw, object_windows, print_match, signed_distance, surfels_of
from tests.support.errors import about
from tests.support.photographs import NAME

# Surfels


@pytest.fixture(scope="module")
def surfels(fields):
    return surfels_of(fields[NAME], 0.003)


def test_they_lie_on_the_surface_one_spacing_apart_and_look_outward(fields, surfels):
    low, high = fields[NAME].extent
    assert np.all((surfels.points >= low - 1e-3) & (surfels.points <= high + 1e-3))
    np.testing.assert_allclose(np.linalg.norm(surfels.normals, axis=1), 1, atol=1e-3)
    assert (np.einsum("ij,ij->i", surfels.normals, surfels.points) > 0).mean() > 0.99
    assert np.all((surfels.albedo >= 0) & (surfels.albedo < 1.5))
    nearest = KDTree(surfels.points).query(surfels.points, k=2)[0][:, 1]
    assert 0.4 * surfels.spacing < np.median(nearest) < 1.2 * surfels.spacing


def test_they_draw_the_silhouette_and_the_depth_of_the_field(surfels, taken):
    window = object_windows([taken.photo], NAME, 1000)[0]
    index, depth = draw(surfels, window, taken.pose[None])
    shown = index[0] >= 0
    assert (shown & window.mask).sum() / (shown | window.mask).sum() > 0.95
    truth = window.frame.cut(taken.depth)
    assert np.median(np.abs(depth[0] - truth)[shown & window.mask]) < 2e-3


def test_the_true_pose_has_the_least_loss_at_any_exposure(surfels, taken):
    steps = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.05]])
    poses = Pose(taken.pose.position + steps, np.tile(taken.pose.quaternion, (4, 1)))
    darker = replace(taken.photo, image=np.float32(0.5) * taken.photo.image)
    terms, dark = (PoseLoss(object_windows([p], NAME, 60), surfels).terms(poses) for p in (taken.photo, darker))
    assert np.argmin(terms.losses) == 0
    assert terms.iou[0] > 0.94
    assert terms.correlation[0] > 0.8
    assert dark.losses[0] == pytest.approx(terms.losses[0], abs=1e-3)
    outlines = PoseLoss(object_windows([taken.photo], NAME, 60), surfels, kind="iou")
    np.testing.assert_allclose(outlines(poses), 1 - terms.iou, atol=1e-12)


@pytest.mark.parametrize(
    ("turn", "shift_m", "is_found"),
    [((0, 0, 0), 0.0, True), ((0, 0, 0), 0.003, True), ((0, 0, np.pi), 0.0, False), ((0, np.pi, 0), 0.0, False)],
)
def test_the_print_is_found_in_the_right_pose_even_if_it_is_3_mm_off(surfels, taken, turn, shift_m, is_found):
    pose = taken.pose @ Pose(np.zeros(3), quaternion_exp(np.array(turn, float)))
    moved = Pose(pose.position + [shift_m, 0, 0], pose.quaternion)
    match = print_match(PoseLoss(object_windows([taken.photo], NAME, 240), surfels), moved)
    assert (match > 0.6) == is_found
    assert 0 < match <= 1


# Windows


K = np.array([[200.0, 0, 64], [0, 200, 48], [0, 0, 1]])


def photo(**masks):
    image = np.random.default_rng(0).uniform(size=(96, 128, 3)).astype(np.float32)
    return Photograph(image, np.ones((96, 128), bool), K, Pose.identity(), False, masks)


def rectangle(top, bottom, left, right):
    mask = np.zeros((96, 128), bool)
    mask[top:bottom, left:right] = True
    return mask


def test_a_window_looks_along_the_same_rays():
    window, point = object_windows([photo(a=rectangle(30, 60, 40, 60))], "a", 15)[0], np.array([0.02, -0.01, 0.5])
    pixel, own, frame = K @ point, window.intrinsics @ point, window.frame
    scale = np.array([frame.width, frame.height]) / [frame.right - frame.left, frame.bottom - frame.top]
    np.testing.assert_allclose(own[:2] / own[2], (pixel[:2] / pixel[2] - [frame.left, frame.top]) * scale, atol=1e-12)


def test_what_another_object_may_hide_or_lies_beyond_the_photo_is_not_known():
    window = object_windows([photo(a=rectangle(30, 60, 40, 60), b=rectangle(30, 60, 60, 80))], "a", 100)[0]
    columns = np.arange(window.size[1]) + window.frame.left
    assert not window.known[15, (columns >= 61) & (columns < 70)].any()
    assert window.known[window.mask].all()
    assert window.cut == 0
    window = object_windows([photo(a=rectangle(0, 40, 40, 60))], "a", 100)[0]
    assert not window.known[np.arange(window.size[0]) + window.frame.top < 0].any()
    assert window.cut > 0.1


def test_distances_to_a_straight_border():
    found = signed_distance(rectangle(0, 96, 0, 64))[50]
    np.testing.assert_allclose(found, 64 - (np.arange(128) + 0.5), atol=1e-12)


def test_objects_with_few_pixels_or_none_are_refused():
    for name in ("mug", "a"):
        with pytest.raises(InvalidInput, check=about(f"mask of {name}")):
            object_windows([photo(a=rectangle(30, 32, 40, 42))], name, 40)


# The prior of a table


def test_what_stands_on_the_table_pays_nothing_and_the_rest_a_bounded_price(fields):
    resting = resting_orientations(fields[NAME])
    prior, turned = TablePrior(resting), Pose(np.zeros(3), resting.quaternions[0])
    pose = Pose(np.array([0.1, 0.2, -resting.lowest(turned)]), turned.quaternion)
    high = Pose(pose.position + [0, 0, 0.3], pose.quaternion)
    leaning = Pose(high.position, quaternion_multiply(quaternion_exp(np.array([0.7, 0, 0])), pose.quaternion))
    penalties = prior.penalties(Pose.stacked([pose, high, leaning]))
    assert penalties[0] < 0.1
    np.testing.assert_allclose(penalties[1:], [100 + penalties[0], 200], rtol=0.1)
    turn = quaternion_exp(np.array([0.03, -0.05, 0.4]))
    moved = Pose(pose.position + [0, 0, 6e-3], quaternion_multiply(turn, pose.quaternion))
    before = prior.penalties(moved[None])[0]
    for _ in range(3):  # steps of Gauss and Newton bring it back to the table
        normal, right = prior.normal_equations(moved)
        step = np.linalg.solve(normal + 1e-6 * np.eye(6), right)
        moved = Pose(moved.position + step[:3], quaternion_multiply(quaternion_exp(step[3:]), moved.quaternion))
    assert prior.penalties(moved[None])[0] < 0.05 * before
