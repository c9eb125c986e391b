"""The lamp from shading of surfaces and cast shadows, in scenes made by the model in closed form."""

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.light import SpotLamp
from osfcore.geometry.poses import Pose, fibonacci_sphere
from osfcore.photo.lamp import TABLE, LitPixels, ShadedPixels, Shadows, fit_lamp, fit_near_lamp
from osfcore.photo.pose_loss import Surfels
from tests.support.errors import about

# A distant lamp, from shading alone.


def angle_deg(a, b):
    return np.rad2deg(np.arccos(np.clip(a @ b, -1, 1)))


@pytest.mark.parametrize("seed", range(3))
def test_a_lamp_is_found_despite_ambient_light_colour_noise_and_highlights_and_a_room_is_diffuse(seed):
    """On a ball that a camera along z sees."""
    rng, normals = np.random.default_rng(seed), fibonacci_sphere(2000)
    normals = normals[normals[:, 2] < 0]
    albedo = rng.uniform(0.2, 0.9, normals.shape)
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

    room = 0.5 + 0.2 * normals @ np.array([0.1, -0.9, 0.3])
    radiance = albedo * room[:, None] + rng.normal(0, 0.005, albedo.shape)
    assert fit_lamp(ShadedPixels(radiance, albedo, normals)).is_diffuse


# A near lamp from pixels of two balls on a table, made by the model in closed form.


BALLS = ((np.array([0.09, 0.0, 0.05]), 0.05), (np.array([-0.06, 0.08, 0.04]), 0.04))
CENTRE = np.zeros(3)


def ball_under_lamp(radius, count=3000):
    normals = fibonacci_sphere(count).astype(np.float32)
    spacing = radius * np.sqrt(4 * np.pi / count)
    return Surfels(radius * normals, normals, np.full_like(normals, 0.5), float(spacing))


def shadows():
    still = Pose.identity().quaternion
    return Shadows([ball_under_lamp(radius) for _, radius in BALLS], [Pose(centre, still) for centre, _ in BALLS])


def surfaces(rng):
    """Points, normals and owners of what a camera above sees."""
    table = np.column_stack([rng.uniform(-0.35, 0.35, (1000, 2)), np.zeros(1000)])
    table = table[[all(np.linalg.norm(p[:2] - c[:2]) > r for c, r in BALLS) for p in table]]
    normals = fibonacci_sphere(350)
    normals = normals[normals[:, 2] > -0.2]
    points = np.concatenate([table, *(centre + radius * normals for centre, radius in BALLS)])
    counts = [len(table), *[len(normals)] * len(BALLS)]
    owner = np.repeat([TABLE, *range(len(BALLS))], counts)
    return points, np.concatenate([np.tile([0.0, 0.0, 1.0], (len(table), 1)), *[normals] * len(BALLS)]), owner


def reached(points, toward, length):
    """Whether no ball stands between points and the lamp, by the quadratic equation of ray and sphere."""
    free = np.ones(len(points))
    for centre, radius in BALLS:
        way = centre - points
        along = np.einsum("ij,ij->i", way, toward)
        across = np.einsum("ij,ij->i", way, way) - along**2
        entry = along - np.sqrt(np.maximum(radius**2 - across, 0))
        free[(across < radius**2) & (entry > 1e-6) & (entry < length)] = 0
    return free


def scene(spot=None, direction=None, ambient=0.3, diffuse=0.7, gain=1.0, noise=0.004, seed=0, views=1):
    """Pixels under a near lamp, a distant one from a direction, or none."""
    rng = np.random.default_rng(seed)
    points, normals, owner = surfaces(rng)
    albedo = np.where(owner[:, None] == TABLE, 1.0, rng.uniform(0.2, 0.9, (len(points), 3)))
    own = np.where(owner[:, None] == TABLE, [0.6, 0.5, 0.4], albedo)
    share = np.zeros(len(points))
    if spot is not None:
        toward, length = spot.toward(points), np.linalg.norm(spot.position - points, axis=1)
        share = spot.falloff(points) * spot.spot_factor(points) * reached(points, toward, length)
        share *= np.maximum(np.einsum("ij,ij->i", toward, normals), 0)
    if direction is not None:
        share = np.maximum(normals @ direction, 0) * reached(points, np.tile(direction, (len(points), 1)), np.inf)
    radiance = gain * own * (ambient + diffuse * share)[:, None] + rng.normal(0, noise, own.shape)
    return LitPixels(radiance, albedo, points, normals, owner, np.arange(len(points)) % views, shadows())


@pytest.mark.parametrize(
    ("place", "cone"),
    [
        ((0.3, -0.2, 0.4), (60, 75)),
        pytest.param((-0.5, 0.3, 0.35), (14, 22), marks=pytest.mark.slow),
        pytest.param((0.1, 0.6, 0.9), (12, 18), marks=pytest.mark.slow),
    ],
)
def test_place_and_cone_are_recovered_within_their_deviations(place, cone):
    spot = SpotLamp(np.array(place), np.array([0.02, -0.01, 0.0]), *cone)
    found = fit_near_lamp(scene(spot), CENTRE)
    assert not found.is_diffuse
    assert found.distance_known
    assert np.deg2rad(angle_deg(found.direction, spot.direction)) < min(np.deg2rad(2), 3 * found.std)
    assert abs(np.log(found.distance / spot.distance)) < min(0.08, 3 * found.log_distance_std)
    assert angle_deg(found.lamp.direction, found.direction) < 1e-3
    if cone[1] < 45:
        assert abs(found.lamp.outer_deg - cone[1]) < 4


@pytest.mark.slow
def test_of_a_distant_lamp_the_distance_stays_unknown_and_light_from_everywhere_is_called_diffuse():
    direction = np.array([0.5, -0.4, 0.7]) / np.linalg.norm([0.5, -0.4, 0.7])
    found = fit_near_lamp(scene(direction=direction), CENTRE)
    assert not found.is_diffuse
    assert angle_deg(found.direction, direction) < 2
    assert not found.distance_known
    assert found.lamp is None
    assert fit_near_lamp(scene(ambient=0.8), CENTRE).is_diffuse


@pytest.mark.slow
def test_strength_is_relative_to_the_exposure_of_each_view():
    spot = SpotLamp(np.array([0.3, -0.2, 0.4]), CENTRE, 60, 75)
    pixels = scene(spot, views=2)
    pixels.radiance[pixels.view == 1] *= 0.4
    found = fit_near_lamp(pixels, CENTRE)
    assert angle_deg(found.direction, spot.direction) < 2
    np.testing.assert_allclose(found.strength[0], 0.7, rtol=0.15)
    np.testing.assert_allclose(found.strength[1], 0.4 * found.strength[0], rtol=0.1)


@pytest.mark.slow
def test_objects_alone_show_the_direction():
    spot = SpotLamp(np.array([0.4, 0.3, 0.5]), CENTRE, 60, 75)
    whole = scene(spot)
    kept = whole.owner != TABLE
    columns = (whole.radiance, whole.albedo, whole.points, whole.normals, whole.owner, whole.view)
    pixels = LitPixels(*(column[kept] for column in columns), whole.shadows)
    assert angle_deg(fit_near_lamp(pixels, CENTRE).direction, spot.direction) < 4


def test_few_pixels_are_refused():
    four = [np.ones((4, 3))] * 4
    with pytest.raises(InvalidInput, check=about("number of shaded pixels")):
        LitPixels(*four, np.zeros(4, int), np.zeros(4, int), shadows())
    with pytest.raises(InvalidInput, check=about("number of shaded pixels")):
        ShadedPixels(*four[:3])


@pytest.mark.parametrize("direction", [(0.6, 0.0, 0.8), (0.0, -0.8, 0.6)])
def test_shadows_on_the_table_lie_where_geometry_says(direction):
    points, normals, owner = surfaces(np.random.default_rng(0))
    table, direction, place, cast = points[owner == TABLE], np.array(direction), np.array([0.15, 0.1, 0.3]), shadows()
    way = place - table
    length = np.linalg.norm(way, axis=1)
    for found, expected in (
        (cast.from_direction(direction, table), reached(table, np.tile(direction, (len(table), 1)), np.inf)),
        (cast.from_place(place, table), reached(table, way / length[:, None], length)),
    ):
        assert np.sum(np.abs(found - expected) > 0.5) < 0.15 * np.sum(1 - expected)
    lit = (owner == 0) & (normals[:, 2] > 0.3)  # a ball does not shade its own lit side
    assert cast.from_direction(np.array([0.0, 0.0, 1.0]), cast.lifted(points[lit], normals[lit])).min() > 0.999
