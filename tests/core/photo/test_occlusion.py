"""Masks that lack a part of what stands in front, or hold a part of it."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp, rotation_angle
from osfcore.photo.poses import FINE_ACROSS, PhotoModels, PhotoObject, PhotoPose, estimate_photo, without_others
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.core.photo.conftest import NAME

pytestmark = pytest.mark.usefixtures("one_thread")
BEHIND = "006_mustard_bottle"


@pytest.fixture(scope="module")
def models(fields):
    return PhotoModels(fields)


@pytest.fixture(scope="module")
def surfels(models):
    return {name: models.surfels(name, FINE_ACROSS) for name in (NAME, BEHIND)}


def at(pose, name=NAME, iou=0.95):
    return PhotoObject(name, PhotoPose(pose, 0.1, iou, 0.1, 0.9), (), "", 0.0, 0.0)


@pytest.fixture
def spoiled(taken):
    """The front's mask lacks its left part; that behind it claims the middle of it and something beside it."""
    whole = taken.photo.masks[NAME]
    columns = np.nonzero(whole)[1]
    third = np.quantile(columns, 1 / 3), np.quantile(columns, 2 / 3)
    x = np.arange(whole.shape[1])
    front, behind = whole & (x > third[0]), whole & (x > third[0]) & (x < third[1])
    behind[:20, :20] = True
    return replace(taken.photo, masks={NAME: front, BEHIND: behind})


def test_what_is_drawn_is_added_to_the_others_and_taken_from_the_own_mask(taken, spoiled, surfels):
    found = [at(taken.pose), at(Pose.identity(), BEHIND, iou=0.5)]
    (seen,) = without_others([spoiled], BEHIND, found, surfels)
    whole = taken.photo.masks[NAME]
    assert (seen.masks[NAME] & whole).sum() / (seen.masks[NAME] | whole).sum() > 0.95
    assert seen.masks[BEHIND][:20, :20].all()
    assert seen.masks[BEHIND].sum() < 400 + 0.05 * spoiled.masks[BEHIND].sum()


def test_an_outline_that_fits_badly_takes_nothing_from_the_own_mask(taken, spoiled, surfels):
    found = [at(taken.pose, iou=0.5), at(Pose.identity(), BEHIND, iou=0.5)]
    (seen,) = without_others([spoiled], BEHIND, found, surfels)
    np.testing.assert_array_equal(seen.masks[BEHIND], spoiled.masks[BEHIND])


def test_photographs_without_the_object_are_left_as_they_are(taken, surfels):
    (seen,) = without_others([taken.photo], BEHIND, [at(taken.pose)], surfels)
    assert seen is taken.photo


@pytest.mark.slow
def test_an_object_behind_another_of_which_half_is_marked(models, fields, taken):
    """The box hides the bottle's lower half, but only the box's own lower half is marked: both are looked for twice."""
    front = Pose(np.array([0.01, 0.05, 0.5]), quaternion_exp(np.array([1.2, 0.9, -0.3])))
    behind = Pose(np.array([0.0, 0.02, 0.64]), quaternion_exp(np.array([-1.5, 0.3, 0.1])))
    both = Pose.stacked([front, behind])
    batch = SceneBatch((NAME, BEHIND), both.position[None], both.quaternion[None], taken.light[None], None)
    camera = Camera("photo", Pose.identity(), taken.photo.intrinsics, 300, 260)
    drawn = SceneRenderer(fields, None).render(batch, [camera], outputs={"rgb", "masks"})
    box, bottle = drawn.masks[0, 0]
    half = box & (np.arange(260)[:, None] > np.median(np.nonzero(box)[0]))
    image = np.where((box | bottle)[..., None], drawn.rgb[0, 0], 0.2).astype(np.float32)
    exposed = np.ones(box.shape, bool)
    photo = replace(taken.photo, image=image, well_exposed=exposed, masks={NAME: half, BEHIND: bottle})
    *_, last = estimate_photo(models, [photo], (NAME, BEHIND), np.random.default_rng(0))
    assert last.progress.total == 2 + 2 + 1
    for found, pose in zip(last.found, (front, behind), strict=True):
        assert np.rad2deg(rotation_angle(found.best.pose.quaternion, pose.quaternion)) < 5
        assert found.doubt == ""
