import doctest

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.render import reference
from osfcore.render.reference import accumulate_along_rays, final_transmittance, render_weights, transmittance

TAUS = st.lists(st.floats(0, 20), min_size=1, max_size=30).map(lambda taus: torch.tensor([taus], dtype=torch.float64))


def test_the_worked_example_is_right():
    failed, tried = doctest.testmod(reference, extraglobs={"torch": torch})
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
