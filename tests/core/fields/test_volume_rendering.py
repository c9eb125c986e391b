import doctest

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.fields import volume_rendering
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.rays import RayBatch
from osfcore.fields.volume_rendering import (
    accumulate_along_rays,
    composite,
    final_transmittance,
    render_weights,
    transmittance,
)
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.support.rendered_scenes import ball, camera_rays, random_field, state, view

TAUS = st.lists(st.floats(0, 20), min_size=1, max_size=30).map(lambda taus: torch.tensor([taus], dtype=torch.float64))


def test_the_worked_example_is_right():
    failed, tried = doctest.testmod(volume_rendering, extraglobs={"torch": torch})
    assert (failed, tried) == (0, 8)


@given(TAUS)
def test_what_is_not_scattered_passes(taus):
    torch.testing.assert_close(render_weights(taus).sum(dim=1) + final_transmittance(taus), torch.ones(1).double())
    assert (transmittance(taus).diff(dim=1) <= 1e-12).all()


@given(st.floats(0.01, 30), st.floats(0.1, 2), st.integers(1, 64))
def test_a_homogeneous_medium_follows_beer_and_lambert_however_finely_it_is_sampled(sigma, length, num_samples):
    taus = torch.full((1, num_samples), sigma * length / num_samples, dtype=torch.float64)
    glow = accumulate_along_rays(render_weights(taus), torch.ones(1, num_samples, 1).double())
    np.testing.assert_allclose(glow.item(), 1 - np.exp(-sigma * length), rtol=1e-9)


def seen(field, camera, light=(0.0, 0.0, 1.0)):
    origins, directions = camera_rays(camera)
    nothing = np.zeros((len(origins), 3), np.float32)
    rays = RayBatch(origins, directions, np.tile(np.float32(light), (len(origins), 1)), nothing, nothing[:, 0])
    with torch.no_grad():
        return composite(KiloQuery(field), field, rays, min_weight=1e-5, most=400)


def test_training_sees_what_the_renderer_draws_and_black_where_rays_meet_nothing():
    """A lone object over black, sample by sample the same."""
    for seed in (0, 5):
        field = random_field(np.random.default_rng(seed))
        camera, light = view((0.3, 0.1, 0.2), (0, 0, 0), 24, 30), np.array([0.6, 0.0, 0.8])
        colour, alpha = seen(field, camera, light)
        scene = SceneBatch.of(state({"it": (0, 0, 0)}, light))
        drawn = SceneRenderer({"it": field}, None).render(scene, [camera], outputs={"rgb", "opacity"})
        np.testing.assert_allclose(colour.reshape(24, 24, 3), drawn.rgb[0, 0], atol=2e-3)
        np.testing.assert_allclose(alpha.reshape(24, 24), drawn.opacity[0, 0, 0], atol=2e-3)
    colour, alpha = seen(ball(), view((0.5, 0, 0), (1, 0, 0), 16))
    assert not colour.any()
    assert not alpha.any()
