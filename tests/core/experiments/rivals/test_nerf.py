import numpy as np

from osfcore.experiments.rivals.nerf import UnlitRenderer, load_nerf_appearance, mean_table, with_fitted_brightness
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import without_light
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch

NAME = "009_gelatin_box"
LIGHTS = [Light(np.array(direction)) for direction in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.2], [0.0, -1.0, 0.4])]


def scenes(names=(NAME,)):
    count, rows = len(names), len(LIGHTS)
    places = np.array([[0.0, 0.12 * n, 0.02] for n in range(count)]).reshape(count, 3)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (rows, count, 1))
    lights = np.array([light.direction for light in LIGHTS])
    return SceneBatch(names, np.tile(places, (rows, 1, 1)), upright, lights, None)


def test_every_light_shows_the_same():
    models = load_nerf_appearance((NAME,), FieldLibrary(None), None)
    seen = models.together.render(scenes(), (goal_camera(48),)).rgb
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-6)
    np.testing.assert_allclose(seen[2], seen[0], atol=1e-6)
    lit = SceneRenderer({NAME: FieldLibrary(None).load(NAME)}, FieldLibrary(None).load_table())
    relit = lit.render(scenes(), (goal_camera(48),)).rgb
    assert np.abs(relit[0] - relit[1]).mean() > 0.05


def test_a_field_without_light_has_the_density_that_it_had():
    field = FieldLibrary(None).load(NAME)
    unlit = without_light(field)
    np.testing.assert_array_equal(field.density, unlit.density)
    seen, true = (
        SceneRenderer({NAME: one}, None).render(scenes(), (goal_camera(32),), outputs={"rgb", "depth"})
        for one in (unlit, field)
    )
    np.testing.assert_allclose(seen.depth, true.depth, atol=1e-5)
    np.testing.assert_allclose(seen.rgb[1], seen.rgb[0], atol=1e-6)


def test_nothing_casts_a_shadow():
    fields, table = {NAME: FieldLibrary(None).load(NAME)}, FieldLibrary(None).load_table()
    bare = UnlitRenderer(fields, table).render(scenes(()), (goal_camera(48),)).rgb
    seen = UnlitRenderer(fields, table).render(scenes(), (goal_camera(48),), outputs={"rgb", "opacity"})
    free = seen.opacity.sum(axis=2) == 0
    np.testing.assert_allclose(seen.rgb[free], bare[free], atol=1e-6)


def test_the_mean_table_is_the_mean_over_lights():
    table = FieldLibrary(None).load_table()
    lights = np.random.default_rng(0).normal(size=(20_000, 3))
    lights[:, 2] = np.abs(lights[:, 2])
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    unlit = mean_table(table)
    np.testing.assert_allclose(unlit.ambient, table.ambient + table.direct(lights).mean(axis=0), atol=0.01)
    np.testing.assert_array_equal(unlit.direct(lights[:9]), 0)
    assert unlit.albedo is table.albedo


def test_brightness_that_was_changed_is_found_again():
    rng = np.random.default_rng(0)
    opacity = rng.dirichlet(np.ones(3), (2, 8, 8)).transpose(0, 3, 1, 2)[:, :2]  # two objects, and the table between
    shown = rng.uniform(0.1, 0.4, (2, 8, 8, 3))
    shares = np.concatenate([opacity, 1 - opacity.sum(axis=1, keepdims=True)], axis=1)
    truth = shown * np.einsum("vnhw,n->vhw", shares, [0.3, 2.0, 1.2])[..., None]
    np.testing.assert_allclose(with_fitted_brightness(shown, opacity, truth), truth, atol=1e-9)
    negative = with_fitted_brightness(shown, opacity, -truth)
    np.testing.assert_allclose(negative, 0, atol=1e-9)  # nothing is darker than black
