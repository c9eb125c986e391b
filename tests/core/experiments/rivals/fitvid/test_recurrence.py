import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.experiments.rivals.fitvid import Gaussian, LatentLSTM, kl_divergence

numbers = st.floats(-3, 3)
gaussians = st.tuples(numbers, numbers).map(lambda pair: Gaussian(torch.tensor([pair[0]]), torch.tensor([pair[1]])))


@given(one=gaussians)
def test_a_gaussian_does_not_diverge_from_itself(one):
    assert float(kl_divergence(one, one)) == pytest.approx(0, abs=1e-6)


@given(p=gaussians, q=gaussians)
def test_it_is_what_torch_computes_and_never_negative(p, q):
    normal = [torch.distributions.Normal(g.mean, (g.logvar / 2).exp()) for g in (p, q)]
    expected = torch.distributions.kl_divergence(*normal).sum()
    torch.testing.assert_close(kl_divergence(p, q), expected, rtol=1e-4, atol=1e-5)
    assert float(kl_divergence(p, q)) >= -1e-5


def test_closed_forms_add_up_over_components():
    zero = torch.zeros(3)
    p = Gaussian(torch.tensor([1.0, 0.0, 2.0]), torch.tensor([0.0, math.log(4), 0.0]))
    q = Gaussian(zero, zero)
    assert float(kl_divergence(p, q)) == pytest.approx(0.5 + (4 - 1 - math.log(4)) / 2 + 2)


def test_draws_have_the_mean_and_the_variance():
    one = Gaussian(torch.full((40_000,), 2.0), torch.full((40_000,), math.log(9.0)))
    drawn = one.sample(torch.Generator().manual_seed(0))
    assert float(drawn.mean()) == pytest.approx(2, abs=0.05)
    assert float(drawn.std()) == pytest.approx(3, abs=0.05)


def test_step_by_step_is_the_same_as_all_at_once():
    lstm = LatentLSTM(5, 8, 3)
    x = torch.rand(2, 4, 5)
    whole, _ = lstm(x)
    state, parts = None, []
    for step in range(4):
        part, state = lstm(x[:, step : step + 1], state)
        parts.append(part.mean)
    torch.testing.assert_close(torch.cat(parts, dim=1), whole.mean)
