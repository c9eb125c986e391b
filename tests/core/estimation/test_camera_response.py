from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from osfcore.estimation.camera_response import ImageModel, linear_of_srgb, srgb_of_linear
from osfcore.estimation.photometry import adapted
from osfcore.geometry.cameras import default_cameras
from osfcore.render.types import SceneBatch

USUAL = ImageModel(np.ones(3), 1.0, np.ones(3))
OTHER = ImageModel(np.array([0.6, 0.7, 0.8]), 2.0, np.array([0.5, 0.8, 1.2]))


def test_srgb_has_its_well_known_values_and_both_curves_rise_without_a_step_and_keep_the_type():
    linear = np.array([0, 0.002, 0.18, 0.5, 1])
    np.testing.assert_allclose(srgb_of_linear(linear), [0, 0.02584, 0.46136, 0.73536, 1], atol=1e-5)
    for curve in (srgb_of_linear, linear_of_srgb):
        steps = np.diff(curve(np.linspace(0, 1, 100_001)))
        assert np.all(steps > 0)
        assert steps.max() < 2e-4
        assert curve(np.ones(2, np.float32)).dtype == np.float32


@given(value=st.floats(0, 1))
def test_each_curve_is_the_inverse_of_the_other(value):
    values = np.array([value])
    np.testing.assert_allclose(linear_of_srgb(srgb_of_linear(values)), values, atol=1e-7)
    np.testing.assert_allclose(srgb_of_linear(linear_of_srgb(values)), values, atol=1e-7)


def rendered(models, state):
    return models.together.render(SceneBatch.of(state), default_cameras(48)[:1]).rgb[0, 0]


def test_the_usual_image_model_changes_nothing(models, truth, seen):
    np.testing.assert_array_equal(rendered(adapted(models, truth.names, USUAL), truth), rendered(models, truth))
    np.testing.assert_array_equal(USUAL.normalized(seen).images, seen.images.astype(np.float32))
    assert USUAL.is_usual
    assert USUAL.oddities == ""
    assert not OTHER.is_usual
    assert "exposure" in OTHER.oddities


def test_encoded_pictures_are_decoded_and_brought_to_the_usual_exposure(seen):
    taken = replace(seen, images=srgb_of_linear(seen.images * (OTHER.gain / OTHER.scale)))
    np.testing.assert_allclose(replace(OTHER, encoding="srgb").normalized(taken).images, seen.images, atol=1e-5)


def test_radiance_is_linear_in_the_ambient_light(models, truth):
    """With ambient light r, the scale apart, a picture is that without ambient light plus r times the ambient part."""
    plain = [
        rendered(adapted(models, truth.names, model), truth) / model.scale
        for model in (ImageModel(np.ones(3), r, np.ones(3)) for r in (0.5, 1.0, 1.5))
    ]
    np.testing.assert_allclose(plain[0] + plain[2], 2 * plain[1], atol=1e-5)


def test_the_tables_colour_does_not_change_objects(models, truth):
    ours = rendered(models, truth)
    theirs = rendered(adapted(models, truth.names, replace(USUAL, table=OTHER.table)), truth)
    opacity = models.together.render(SceneBatch.of(truth), default_cameras(48)[:1], outputs={"opacity"}).opacity[0, 0]
    solid, bare = opacity.sum(axis=0) > 0.999, opacity.sum(axis=0) == 0
    np.testing.assert_allclose(theirs[solid], ours[solid], atol=2e-3)
    on_table = bare & (ours[..., 0] > 0.15)
    np.testing.assert_allclose(theirs[on_table], ours[on_table] * OTHER.table, rtol=1e-4)
