"""The empty table from compiled code."""

import numpy as np

from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, Quality, SceneBatch
from tests.core.render.scenes import plain_table

NOTHING = np.zeros((1, 0, 3)), np.zeros((1, 0, 4))


def bare(table, light, camera, quality=EXACT):
    batch = SceneBatch((), *NOTHING, light.direction[None], None)
    return SceneRenderer({}, table).render(batch, (camera,), quality=quality, outputs={"rgb", "depth"})


def test_the_bare_table_is_its_albedo_under_the_light():
    table, camera = plain_table(), goal_camera(32)
    light = Light(np.array([0.3, 0.2, 0.8]))
    image = bare(table, light, camera).rgb[0, 0]
    expected = table.albedo[0, 0] * (table.ambient + table.direct(light.direction[None])[0])
    np.testing.assert_allclose(image[16, 16], expected, atol=1e-5)


def test_depth_is_that_of_the_plane():
    camera = goal_camera(32)
    depth = bare(plain_table(), Light(np.array([0.0, 0, 1])), camera).depth[0, 0]
    pixels = np.array([[16.5, 20.5]])
    ray = camera.ray_directions(pixels)[0]
    distance = -camera.T_world_camera.position[2] / ray[2]
    axis = camera.T_world_camera.matrix()[:3, 2]
    np.testing.assert_allclose(depth[20, 16], distance * (ray @ axis), rtol=1e-5)


def test_several_rays_a_pixel_change_only_the_tables_edge():
    light, camera = Light(np.array([0.0, 0, 1])), goal_camera(64)
    one = bare(plain_table(), light, camera).rgb[0, 0]
    many = bare(plain_table(), light, camera, Quality(samples_per_side=4)).rgb[0, 0]
    changed = np.abs(one - many).max(axis=-1) > 1e-5
    assert 0 < changed.sum() < 0.1 * changed.size
