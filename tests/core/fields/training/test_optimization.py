import numpy as np
import pytest
import torch

from osfcore.fields.kiloosf import EMPTY_G
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.rays import RayBatch, RaySource, camera_rays
from osfcore.fields.train_osf import Rates, Stage, composite
from osfcore.io.image_set import read_image_set
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.core.fields.rendered_sets import painted_block, write_object_set
from tests.core.render.scenes import ball, fog, fog_depth, random_field, state, view


def rays_of(camera, light=(0.0, 0.0, 1.0)) -> RayBatch:
    origins, directions = camera_rays(camera)
    nothing = np.zeros((len(origins), 3), np.float32)
    lights = np.tile(np.float32(light), (len(origins), 1))
    return RayBatch(origins, directions, lights, nothing, nothing[:, 0])


@pytest.fixture(scope="module")
def rays(tmp_path_factory):
    images = read_image_set(write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block()), "train")
    source = RaySource(images)
    return source.batch(np.random.default_rng(0).permutation(source.silhouette_pixels())[:2000])


def stage_of(field) -> Stage:
    return Stage(field, Rates(1e-2, 1e-3), torch.device("cpu"))


def test_training_sees_what_the_renderer_draws():
    """A lone object over black, sample by sample the same."""
    for seed in (0, 5):
        field = random_field(np.random.default_rng(seed))
        camera, light = view((0.3, 0.1, 0.2), (0, 0, 0), 32, 30), np.array([0.6, 0.0, 0.8])
        colour, alpha = composite(KiloQuery(field), field, rays_of(camera, light), min_weight=1e-5, most=400)
        scene = SceneBatch.of(state({"it": (0, 0, 0)}, light))
        drawn = SceneRenderer({"it": field}, None).render(scene, [camera], outputs={"rgb", "opacity"})
        np.testing.assert_allclose(colour.detach().reshape(32, 32, 3), drawn.rgb[0, 0], atol=2e-3)
        np.testing.assert_allclose(alpha.detach().reshape(32, 32), drawn.opacity[0, 0, 0], atol=2e-3)


def test_a_slab_has_the_opacity_of_its_depth():
    field = fog((0.04, 0.04, 0.02), g=-2.0)
    rays = rays_of(view((0, 0, 2.0), (0, 0, 0), 16, 0.5))
    _, alpha = composite(KiloQuery(field), field, rays, min_weight=0.0, most=100)
    np.testing.assert_allclose(alpha.detach(), 1 - np.exp(-fog_depth(field, -2.0, 0.04)), atol=0.01)


def test_rays_that_meet_nothing_are_black_and_harmless():
    field = ball()
    colour, alpha = composite(KiloQuery(field), field, rays_of(view((0.5, 0, 0), (1, 0, 0), 16)))
    assert not colour.any()
    assert not alpha.any()


def test_steps_lower_the_loss_and_keep_features_in_bounds(rays):
    """From a grey ball toward the block that the images show."""
    stage, rng, generator = stage_of(ball(0.05)), np.random.default_rng(0), torch.Generator().manual_seed(0)
    losses = [stage.step(rays, n / 40, rng, generator) for n in range(40)]
    assert np.mean(losses[-5:]) < 0.75 * losses[0]
    field = stage.snapshot()
    np.testing.assert_array_equal(field.rows[0], [EMPTY_G, *[0] * 7])
    assert np.all(np.abs(field.rows[1:, 0]) <= 10 + 1e-5)
    assert np.all((field.rows[1:, 1:4] >= 0) & (field.rows[1:, 1:4] <= 1))
    assert np.all(np.abs(field.rows[1:, 4:]) <= 1.5 + 1e-5)
    assert np.all(field.ambient >= 0)


def test_a_stage_goes_on_from_its_state_as_if_nothing_had_happened(rays):
    one = stage_of(ball(0.05))
    rngs = [np.random.default_rng(0) for _ in range(2)]
    generators = [torch.Generator().manual_seed(0) for _ in range(2)]
    for n in range(8):
        one.step(rays, n / 16, rngs[0], generators[0])
    other = stage_of(one.snapshot())
    other.restore(one.state())
    rngs[1].bit_generator.state = rngs[0].bit_generator.state
    generators[1].set_state(generators[0].get_state())
    for n in range(8, 16):
        losses = [s.step(rays, n / 16, r, g) for s, r, g in zip((one, other), rngs, generators, strict=True)]
        assert losses[0] == pytest.approx(losses[1], rel=1e-3)
    # Adam turns the last bit of a tiny gradient into a step, so single features may part ways a little.
    assert np.mean(np.abs(one.snapshot().rows - other.snapshot().rows)) < 1e-3


def test_rates_fall_exponentially():
    rates = Rates(1e-2, 1e-4)
    np.testing.assert_allclose([rates.at(s) for s in (0, 0.5, 1)], [1e-2, 1e-3, 1e-4], atol=1e-12)
