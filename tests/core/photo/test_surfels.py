from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from osfcore.geometry.poses import Pose
from osfcore.photo.pose_loss import PoseLoss, draw, object_windows, surfels_of
from tests.core.photo.conftest import NAME


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
