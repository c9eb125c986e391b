"""Pose loss: surfels, object window."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.photo.photograph import Photograph
from osfcore.photo.pose_loss import PoseLoss, draw, object_windows, signed_distance, surfels_of
from tests.core.photo.conftest import NAME

# Surfels


@pytest.fixture(scope="module")
def surfels(fields):
    return surfels_of(fields[NAME], 0.003)


def test_they_lie_on_the_surface_and_look_outward(fields, surfels):
    low, high = fields[NAME].extent
    assert np.all((surfels.points >= low - 1e-3) & (surfels.points <= high + 1e-3))
    np.testing.assert_allclose(np.linalg.norm(surfels.normals, axis=1), 1, atol=1e-3)
    assert (np.einsum("ij,ij->i", surfels.normals, surfels.points) > 0).mean() > 0.99
    assert np.all((surfels.albedo >= 0) & (surfels.albedo < 1.5))


def test_their_distance_is_the_spacing(surfels):
    nearest = KDTree(surfels.points).query(surfels.points, k=2)[0][:, 1]
    assert 0.4 * surfels.spacing < np.median(nearest) < 1.2 * surfels.spacing


def test_they_draw_the_silhouette_and_the_depth_of_the_field(surfels, taken):
    window = object_windows([taken.photo], NAME, 1000)[0]
    index, depth = draw(surfels, window, Pose(taken.pose.position[None], taken.pose.quaternion[None]))
    shown = index[0] >= 0
    assert (shown & window.mask).sum() / (shown | window.mask).sum() > 0.95
    truth = window.frame.cut(taken.depth)
    common = shown & window.mask
    assert np.median(np.abs(depth[0] - truth)[common]) < 2e-3


@pytest.mark.slow
def test_the_true_pose_has_a_small_loss(surfels, taken):
    loss = PoseLoss(object_windows([taken.photo], NAME, 60), surfels)
    steps = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.05]])
    poses = Pose(taken.pose.position + steps, np.tile(taken.pose.quaternion, (4, 1)))
    terms = loss.terms(poses)
    assert np.argmin(terms.losses) == 0
    assert terms.iou[0] > 0.94
    assert terms.correlation[0] > 0.8


@pytest.mark.slow
def test_the_loss_knows_nothing_of_exposure(surfels, taken):
    darker = replace(taken.photo, image=np.float32(0.5) * taken.photo.image)
    pose = Pose(taken.pose.position[None], taken.pose.quaternion[None])
    first, second = (PoseLoss(object_windows([p], NAME, 60), surfels).terms(pose) for p in (taken.photo, darker))
    assert second.losses[0] == pytest.approx(first.losses[0], abs=1e-3)


def test_the_outline_alone_counts_if_asked(surfels, taken):
    loss = PoseLoss(object_windows([taken.photo], NAME, 60), surfels, kind="iou")
    terms = loss.terms(Pose(taken.pose.position[None], taken.pose.quaternion[None]))
    np.testing.assert_allclose(terms.losses, 1 - terms.iou, atol=1e-12)


# Object window


K = np.array([[200.0, 0, 64], [0, 200, 48], [0, 0, 1]])


def photo(**masks):
    image = np.random.default_rng(0).uniform(size=(96, 128, 3)).astype(np.float32)
    return Photograph(image, np.ones((96, 128), bool), K, Pose.identity(), False, masks)


def rectangle(top, bottom, left, right):
    mask = np.zeros((96, 128), bool)
    mask[top:bottom, left:right] = True
    return mask


def test_a_window_looks_along_the_same_rays():
    window = object_windows([photo(a=rectangle(30, 60, 40, 60))], "a", 15)[0]
    point = np.array([0.02, -0.01, 0.5])
    pixel, own = K @ point, window.intrinsics @ point
    frame = window.frame
    scale = np.array([frame.width, frame.height]) / [frame.right - frame.left, frame.bottom - frame.top]
    np.testing.assert_allclose(own[:2] / own[2], (pixel[:2] / pixel[2] - [frame.left, frame.top]) * scale, atol=1e-12)


def test_what_another_object_may_hide_is_not_known():
    window = object_windows([photo(a=rectangle(30, 60, 40, 60), b=rectangle(30, 60, 60, 80))], "a", 100)[0]
    columns = np.arange(window.size[1]) + window.frame.left
    assert not window.known[15, (columns >= 61) & (columns < 70)].any()
    assert window.known[window.mask].all()


def test_what_lies_beyond_the_photo_is_not_known():
    window = object_windows([photo(a=rectangle(0, 40, 40, 60))], "a", 100)[0]
    rows = np.arange(window.size[0]) + window.frame.top
    assert not window.known[rows < 0].any()
    assert window.cut > 0.1


def test_an_object_within_the_photo_is_not_cut():
    assert object_windows([photo(a=rectangle(30, 60, 40, 60))], "a", 100)[0].cut == 0


def test_distances_to_a_straight_border():
    distances = signed_distance(rectangle(0, 96, 0, 64))
    np.testing.assert_allclose(
        distances[50], np.concatenate([np.arange(64, 0, -1) - 0.5, -(np.arange(64) + 0.5)]), atol=1e-12
    )


def test_an_object_without_a_mask_is_told():
    with pytest.raises(InvalidInput, match="mask of mug is missing"):
        object_windows([photo(a=rectangle(30, 60, 40, 60))], "mug", 40)


def test_a_mask_of_few_pixels_is_told():
    with pytest.raises(InvalidInput, match="size of the mask of a is 4 pixels"):
        object_windows([photo(a=rectangle(30, 32, 40, 42))], "a", 40)
