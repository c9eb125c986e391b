"""Whether a photo shows some objects at all."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.estimation.content_check import ContentChecker
from osfcore.estimation.goal_view import is_goal_view
from osfcore.estimation.objective import ObjectModels
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from tests.support.posed_scenes import NAMES, lying, observe, scene

CAMERA = goal_camera(96)
OTHERS = ("013_apple", "024_bowl")


@pytest.fixture(scope="module")
def models():
    library = FieldLibrary(None)
    return ObjectModels({name: library.load(name) for name in (*NAMES, *OTHERS)}, library.load_table())


@pytest.fixture(scope="module")
def checker(models):
    return ContentChecker(models)


def at_rest(models, names, light=(0.5, 0.3, 0.8)):
    places = ((0.07, -0.08), (-0.08, 0.07))
    poses = {name: lying(models, name, 0, *place) for name, place in zip(names, places, strict=True)}
    return scene(poses, np.array(light) / np.linalg.norm(light))


def photo(pixels, names=NAMES):
    return Observation((CAMERA,), pixels[None], names, None, None, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("names", [NAMES, OTHERS])
@pytest.mark.parametrize("light", [(0.5, 0.3, 0.8), (-0.7, 0.6, 0.3)])
def test_objects_that_are_there_are_found_and_others_are_missed(models, checker, names, light):
    table = at_rest(models, names)
    seen = observe(models, at_rest(models, names, light), [CAMERA], masks=False)
    found = checker.check(seen, table)
    assert found.verdict == "shown"
    absent = NAMES if names == OTHERS else OTHERS
    missed = checker.check(photo(seen.images[0], absent), at_rest(models, absent))
    assert missed.verdict in ("others", "doubtful")
    assert missed.colours < found.colours


def test_where_the_objects_lie_now_plays_no_part(models, checker):
    here = at_rest(models, NAMES)
    seen = observe(models, here, [CAMERA], masks=False)
    away = replace(here, poses=Pose(here.poses.position + [0.1, 0.05, 0], here.poses.quaternion))
    assert checker.check(seen, here) == checker.check(seen, away)


def test_a_plain_square_the_bare_table_and_a_picture_of_something_else_are_recognised(models, checker):
    for pixels, verdict in (
        (np.full((96, 96, 3), 0.4), "bare"),
        (np.random.default_rng(0).random((96, 96, 3)), "elsewhere"),
    ):
        assert checker.check(photo(pixels), at_rest(models, NAMES)).verdict == verdict
    bare = replace(at_rest(models, NAMES), light=Light(np.array([0.6, 0, 0.8])))
    beside = replace(bare, poses=Pose(bare.poses.position + [5.0, 0, 0], bare.poses.quaternion))
    seen = observe(models, beside, [CAMERA], masks=False)
    assert checker.check(seen, bare).verdict == "bare"


@pytest.mark.parametrize("light", [(0.5, 0.3, 0.8), (-0.7, 0.6, 0.3)])
def test_pictures_of_the_goal_camera_are_told_from_photographs(models, light):
    table = FieldLibrary(None).load_table()
    seen = observe(models, at_rest(models, NAMES, light), [CAMERA], masks=False).images[0].astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 0.02, seen.shape)
    for goal in (
        seen,
        seen[::-1, ::-1].copy(),
        np.clip(seen + noise, 0, 1).astype(np.float32),
        np.full_like(seen, 0.9),
    ):
        assert is_goal_view(table, goal, CAMERA)
    as_a_phone_writes_it = srgb_of_linear(seen).astype(np.float32)
    for photograph in (as_a_phone_writes_it, np.random.default_rng(1).random(seen.shape, np.float32)):
        assert not is_goal_view(table, photograph, CAMERA)
