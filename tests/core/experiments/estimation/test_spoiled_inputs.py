import json

import numpy as np
import pytest

from osfcore.experiments.estimation_tasks import FIRST_SCENE, KINDS, BadScore, bad_case, first_frame, summary
from osfcore.geometry.cameras import default_cameras
from osfcore.io.json_codec import decode, encode
from osfcore.world.tasks import draw_scene
from tests.core.experiments.solids import SOLIDS


@pytest.fixture(scope="module")
def cases(library):
    """One of each kind, with the frame that it was made of."""
    found = {}
    for number, kind in enumerate(KINDS):
        case = bad_case(SOLIDS, 2, 4, number, library, 48)
        draw = draw_scene(SOLIDS, 2, 4, FIRST_SCENE + number)
        assert case.kind == kind
        found[kind] = case, first_frame(draw, library, default_cameras(48))
    return found


@pytest.mark.slow
def test_masks_of_two_objects_change_places(cases):
    case, sound = cases["swapped masks"]
    np.testing.assert_array_equal(case.observation.masks, sound.observation.masks[:, ::-1])
    np.testing.assert_array_equal(case.observation.images, sound.observation.images)
    assert case.start is None


@pytest.mark.slow
def test_a_mask_remains_in_one_view_only(cases):
    case, sound = cases["mask in one view"]
    areas = case.observation.masks.sum(axis=(2, 3))
    before = sound.observation.masks.sum(axis=(2, 3))
    (n,) = np.flatnonzero((areas != before).any(axis=0))
    assert sorted(areas[:, n])[:-1] == [0, 0, 0]
    assert 0 < areas[:, n].max() <= 6
    changed = (case.observation.images != sound.observation.images).any(axis=-1)
    assert changed.sum() == before[:, n].max() - areas[:, n].max()


@pytest.mark.slow
def test_a_name_is_wrong(cases):
    case, sound = cases["wrong name"]
    assert len(set(case.observation.names) & set(sound.truth.names)) == 1
    assert case.truth.names == sound.truth.names


@pytest.mark.slow
def test_images_are_black_or_saturated(cases):
    assert cases["black images"][0].observation.images.max() == 0
    case, sound = cases["saturated images"]
    np.testing.assert_allclose(case.observation.images, np.clip(8 * sound.observation.images, 0, 1), atol=1e-12)
    assert (case.observation.images == 1).mean() > 0.3


@pytest.mark.parametrize("kind", ["moved camera", "image of another scene"])
@pytest.mark.slow
def test_one_view_does_not_fit_the_others(cases, kind):
    case, sound = cases[kind]
    differ = [
        np.abs(a - b).max() > 0.05 for a, b in zip(case.observation.images, sound.observation.images, strict=True)
    ]
    assert sum(differ) == 1
    for mine, claimed in zip(case.observation.cameras, sound.observation.cameras, strict=True):
        np.testing.assert_array_equal(mine.T_world_camera.position, claimed.T_world_camera.position)


@pytest.mark.slow
def test_one_view_under_a_grazing_light(cases):
    case, _ = cases["one view, low light"]
    assert len(case.observation.cameras) == 1
    assert 10 <= np.rad2deg(np.arcsin(case.truth.light.direction[2])) <= 13


@pytest.mark.slow
def test_goals_show_other_objects_or_come_from_another_camera(cases):
    other, sound = cases["goal of other objects"]
    assert not set(other.truth.names) & set(other.observation.names)
    assert other.observation.names == sound.truth.names
    turned, _ = cases["goal from another camera"]
    for case in (other, turned):
        assert [camera.name for camera in case.observation.cameras] == ["goal"]
        assert case.observation.masks is case.observation.pusher is None
        assert case.start.masks is not None


@pytest.mark.slow
def test_the_same_number_is_the_same_case(cases, library):
    again = bad_case(SOLIDS, 2, 4, 5, library, 48)
    np.testing.assert_array_equal(again.observation.images, cases[KINDS[5]][0].observation.images)
    later = bad_case(SOLIDS, 2, 4, 5 + len(KINDS), library, 48)
    assert later.kind == again.kind
    assert (later.observation.images != again.observation.images).any()


def test_cases_are_refused_or_flagged_or_believed():
    scores = [
        BadScore(KINDS[0], "no masks", "", False),
        BadScore(KINDS[0], "", "it is hardly visible", False),
        BadScore(KINDS[0], "", "", False, (50.0,), (3.0,)),
        BadScore(KINDS[1], "", "", True),
        BadScore(KINDS[1], "", "it is hardly visible", True),
    ]
    found = summary(scores)
    assert (found["bad_cases"], found["bad_refused"], found["bad_flagged"]) == (5, 1, 2)
    assert (found["bad_right"], found["bad_confident_wrong"]) == (2, 1)
    assert set(found["bad_by_kind"]) == set(KINDS[:2])
    assert found["bad_by_kind"][KINDS[0]]["confident_wrong"] == 1
    assert [decode(BadScore, json.loads(json.dumps(encode(score))), "score") for score in scores] == scores
