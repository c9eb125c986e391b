import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import fibonacci_sphere
from osfcore.photo.lamp import ShadedPixels, fit_lamp


def ball(rng, count=3000):
    """Pixels of a ball that a camera along z sees: random albedo."""
    normals = fibonacci_sphere(2 * count)
    normals = normals[normals[:, 2] < 0]
    return normals, rng.uniform(0.2, 0.9, (len(normals), 3))


def angle_deg(a, b):
    return np.rad2deg(np.arccos(np.clip(a @ b, -1, 1)))


@pytest.mark.parametrize("seed", range(6))
def test_a_lamp_is_found_despite_ambient_light_colour_noise_and_highlights(seed):
    rng = np.random.default_rng(seed)
    normals, albedo = ball(rng)
    direction = rng.normal(size=3)
    direction[2] = -abs(direction[2])
    direction /= np.linalg.norm(direction)
    light = np.array([0.2, 0.25, 0.3]) + np.array([0.7, 0.6, 0.5]) * np.maximum(normals @ direction, 0)[:, None]
    radiance = albedo * light + rng.normal(0, 0.005, albedo.shape)
    half = direction - [0, 0, 1]
    radiance[normals @ (half / np.linalg.norm(half)) > 0.97] = 1.0
    found = fit_lamp(ShadedPixels(radiance, albedo, normals))
    assert angle_deg(found.direction, direction) < 1.0
    assert not found.is_diffuse
    np.testing.assert_allclose(found.strength, [0.7, 0.6, 0.5], rtol=0.15)


def test_a_room_is_called_diffuse():
    rng = np.random.default_rng(0)
    normals, albedo = ball(rng)
    light = 0.5 + 0.2 * normals @ np.array([0.1, -0.9, 0.3])
    found = fit_lamp(ShadedPixels(albedo * light[:, None] + rng.normal(0, 0.005, albedo.shape), albedo, normals))
    assert found.is_diffuse


def test_exposure_changes_the_strength_alone():
    rng = np.random.default_rng(1)
    normals, albedo = ball(rng)
    radiance = albedo * (0.2 + 0.6 * np.maximum(normals @ np.array([0.6, 0, -0.8]), 0))[:, None]
    one, half = (fit_lamp(ShadedPixels(g * radiance, albedo, normals)) for g in (1.0, 0.5))
    assert angle_deg(one.direction, half.direction) < 0.2
    np.testing.assert_allclose(half.strength, one.strength / 2, rtol=0.02)


def test_few_pixels_are_refused():
    with pytest.raises(InvalidInput, match="number of shaded pixels is 3"):
        ShadedPixels(np.ones((3, 3)), np.ones((3, 3)), np.ones((3, 3)))
