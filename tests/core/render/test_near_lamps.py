"""Closed forms of a lamp at a finite distance, for both paths, and that they agree."""

from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import SpotLamp
from osfcore.paper.rendering import PaperRenderer
from osfcore.render.types import SceneBatch
from tests.support.rendered_scenes import block, both, plain_table, random_scene, state, view, wooden_table

ALBEDO = 0.5  # of the plain table
ROUNDING = 1e-5  # of sums of single precision: near lamps and distant lights are compiled apart
LAMP = SpotLamp(np.array([0.25, -0.15, 0.45]), np.array([0.02, 0.03, 0.0]), 25, 40)
WIDE = SpotLamp(np.array([0.25, -0.15, 0.45]), np.zeros(3), 80, 90)


def seen_points(camera: Camera) -> np.ndarray:
    """Where the rays through pixel centres meet the plane z = 0 [m]."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.ray_directions(np.stack([x, y], axis=-1))
    origin = camera.T_world_camera.position
    return origin + rays * (-origin[2] / rays[..., 2:])


@pytest.mark.parametrize("spot", [LAMP, WIDE, SpotLamp(np.array([0, 0.1, 0.3]), np.array([0.1, 0, 0.05]), 20, 20)])
def test_the_empty_table_falls_off_and_has_the_cones_edge(spot):
    camera = view((0.1, 0, 0.9), (0, 0, 0), 24, 50.0)
    points = seen_points(camera)
    lit = 0.75 * spot.toward(points)[..., 2] * spot.falloff(points) * spot.spot_factor(points)
    off_the_edge = np.abs(spot.spot_factor(points + 1e-5) - spot.spot_factor(points - 1e-5)) < 0.01
    assert off_the_edge.mean() > 0.9
    for rendered in both({}, plain_table(ALBEDO), state({}), camera, spot=spot):
        expected = np.broadcast_to(ALBEDO * (0.25 + lit[..., None]), (24, 24, 3))
        np.testing.assert_allclose(rendered.rgb[0, 0][off_the_edge], expected[off_the_edge], atol=1e-5)


@pytest.mark.slow
def test_a_lamp_200_m_away_is_the_distant_light():
    fields, scene = random_scene(1)
    spot = SpotLamp(200 * scene.light.direction, np.zeros(3), 10, 20)
    pairs = (both(fields, wooden_table(), scene, view(size=16), spot=one) for one in (spot, None))
    for rendered, distant in zip(*pairs, strict=True):
        np.testing.assert_allclose(rendered.rgb, distant.rgb, atol=5e-3)
        np.testing.assert_allclose(rendered.opacity, distant.opacity, atol=ROUNDING)


@pytest.mark.parametrize("lamp", [(0.2, 0.05, 0.3), (-0.1, 0.2, 0.16)])
def test_the_shadow_of_a_box_is_its_perspective_projection(lamp):
    """A point of the table is dark if the way to the lamp passes through the box (slab method)."""
    half, centre = np.array([0.03, 0.02, 0.05]), np.array([0.0, 0.0, 0.05])
    camera = view((0, 0, 1.5), (0, 0, 0), 96, 18.0)
    points, spot = seen_points(camera), SpotLamp(np.array(lamp), centre, 80, 90)
    ways = spot.position - points
    with np.errstate(divide="ignore"):
        enter, leave = np.sort([(centre - half - points) / ways, (centre + half - points) / ways], axis=0)
    dark = np.maximum(enter.max(axis=-1), 0) < np.minimum(leave.min(axis=-1), 1)
    fields = {"box": block(half, voxel=0.0025)}
    for rendered in both(fields, plain_table(ALBEDO), state({"box": centre}), camera, spot=spot):
        on_table = rendered.opacity[0, 0, 0] < 1e-3
        open_table = ALBEDO * (0.25 + 0.75 * spot.toward(points)[..., 2] * spot.falloff(points))
        shaded = rendered.rgb[0, 0, ..., 0] < (open_table + 0.25 * ALBEDO) / 2
        union = (shaded | dark) & on_table
        assert union.sum() > 200
        assert (shaded & dark & on_table).sum() > 0.92 * union.sum()
        core = shaded & dark & on_table & (rendered.rgb[0, 0, ..., 0] < 0.126)
        assert core.sum() > 0.85 * union.sum()  # ambient light alone


def test_what_lies_beyond_the_lamp_casts_no_shadow():
    """A plate above the lamp, one below it, and light from far above both."""
    fields = {"plate": block((0.06, 0.06, 0.01))}
    camera = view((0.4, 0, 0.1), (0, 0, 0), 24, 20.0)
    spot = SpotLamp(np.array([0, 0, 0.3]), np.zeros(3), 60, 70)
    empty, beyond, between = (
        both(fields if names else {}, plain_table(), state(names), camera, spot=spot)
        for names in ({}, {"plate": (0, 0, 0.4)}, {"plate": (0, 0, 0.2)})
    )
    for open_table, unshaded, shaded in zip(empty, beyond, between, strict=True):
        np.testing.assert_allclose(unshaded.rgb, open_table.rgb, atol=1e-6)
        assert shaded.rgb[0, 0, 12, 12, 0] == pytest.approx(0.125, abs=1e-4)


def test_sides_that_face_the_lamp_are_bright_and_others_are_not():
    """A lamp between two blocks lights the side of each that looks at it, as no distant light can."""
    fields = {"left": block((0.04, 0.04, 0.04), voxel=0.002), "right": block((0.04, 0.04, 0.04), voxel=0.002)}
    scene = state({"left": (-0.2, 0, 0.04), "right": (0.2, 0, 0.04)})
    spot = SpotLamp(np.array([0.0, 0.0, 0.2]), np.zeros(3), 85, 90)
    for side in (-1, 1):
        middle = np.array([0.16 * side, 0, 0.04])  # of the face toward the lamp
        bright = 0.25 + 0.75 * spot.falloff(middle) * spot.toward(middle)[0] * -side
        within = view((0, 0, 0.15), middle, 16, 4.0)
        beyond = view((0.6 * side, 0, 0.15), middle + [0.08 * side, 0, 0], 16, 4.0)
        for camera, expected in ((within, bright), (beyond, 0.25)):
            for rendered in both(fields, None, scene, camera, spot=spot):
                np.testing.assert_allclose(rendered.rgb[0, 0, 8, 8], np.array([0.3, 0.6, 0.8]) * expected, rtol=0.03)


def test_a_trained_tables_answer_to_the_lights_direction_counts():
    """Its network is asked for the direction at every point."""
    rng = np.random.default_rng(0)
    w1, b1, w2 = (rng.normal(size=shape).astype(np.float32) for shape in ((3, 6), 6, (6, 3)))
    slow, fast = both({}, replace(wooden_table(), w1=w1, b1=b1, w2=0.3 * w2), state({}), view(size=24), spot=LAMP)
    np.testing.assert_allclose(fast.rgb, slow.rgb, atol=1e-5)


def test_lamps_are_counted_and_the_published_renderer_takes_none():
    one = SceneBatch.of(state({}), LAMP)
    np.testing.assert_allclose(one.lights[0], LAMP.direction, atol=1e-12)
    with pytest.raises(InvalidInput):
        replace(one, spots=(LAMP, LAMP))
    with pytest.raises(InvalidInput):
        PaperRenderer({}, plain_table()).render(one, [view()])
