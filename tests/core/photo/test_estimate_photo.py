"""Poses and light of an object in a photograph of unknown exposure, white balance and lamp."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotation_angle
from osfcore.photo.lamp import photo_light
from osfcore.photo.poses import FINE_ACROSS, PhotoConfig, PhotoModels, PhotoObject, PhotoPose, estimate_photo
from tests.core.photo.conftest import NAME, take

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def models(fields):
    return PhotoModels(fields)


def found_in(models, photo, name, config=None):
    *_, last = estimate_photo(models, [photo], [name], np.random.default_rng(0), config)
    return last.found[0]


def errors(found, pose):
    turned = rotation_angle(found.best.pose.quaternion, pose.quaternion)
    return np.linalg.norm(found.best.pose.position - pose.position), np.rad2deg(turned)


@pytest.fixture(scope="module")
def found(models, taken):
    return found_in(models, taken.photo, NAME)


@pytest.mark.slow
def test_without_a_start(found, taken):
    distance, turned = errors(found, taken.pose)
    assert distance < 8e-3
    assert turned < 3
    assert found.doubt == ""
    assert found.ratio > 1.15


@pytest.mark.slow
def test_from_a_start_two_centimetres_and_fifteen_degrees_off(models, taken):
    turn = quaternion_exp(np.deg2rad(15) * np.array([0.6, 0, 0.8]))
    start = Pose(taken.pose.position + [0.012, 0.0, 0.016], quaternion_multiply(turn, taken.pose.quaternion))
    distance, turned = errors(found_in(models, taken.photo, NAME, PhotoConfig({NAME: start})), taken.pose)
    assert distance < 8e-3
    assert turned < 3


@pytest.mark.slow
def test_a_wrong_name_is_doubted(models, taken):
    photo = replace(taken.photo, masks={"006_mustard_bottle": taken.photo.masks[NAME]})
    assert found_in(models, photo, "006_mustard_bottle").doubt


def test_the_lamp_by_the_shading_of_a_bottle(models, fields):
    bottle = "006_mustard_bottle"
    taken = take(fields, bottle, light=(0.7, -0.5, -0.4))
    there = PhotoObject(bottle, PhotoPose(taken.pose, 0.3, 0.95, 0.2, 0.8), (), "", 0.0, 0.0)
    light = photo_light(taken.photo, [there], [models.surfels(bottle, FINE_ACROSS)])
    assert not light.is_diffuse
    assert np.rad2deg(np.arccos(light.direction @ taken.light)) < 12


def test_an_object_without_a_field_is_told(models, taken):
    photo = replace(taken.photo, masks={"teapot": taken.photo.masks[NAME]})
    with pytest.raises(UnknownName, match="no field named 'teapot'"):
        found_in(models, photo, "teapot")


def test_photos_without_a_common_table_are_told(models, taken):
    with pytest.raises(InvalidInput, match="number of photos is 2, 0 of them with a known table"):
        next(estimate_photo(models, [taken.photo, taken.photo], [NAME], np.random.default_rng(0)))


def test_no_photo_is_told(models):
    with pytest.raises(InvalidInput, match="number of photos is 0"):
        next(estimate_photo(models, [], [NAME], np.random.default_rng(0)))
