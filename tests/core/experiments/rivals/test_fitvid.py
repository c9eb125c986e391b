import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load, save

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.rivals import fitvid
from osfcore.experiments.rivals.train_fitvid import Video, windows
from tests.support.errors import about
from tests.support.push_videos import square_video

pytestmark = pytest.mark.usefixtures("one_thread")

# Model


PUSHER = np.array([-0.1, 0.05, 0.06])
TINY = fitvid.FitVidSettings(side=16, width=2, features=12, hidden=16, latent=3)


def model(settings=TINY, seed=0, **more) -> fitvid.FitVidModel:
    """A network as it begins, but for two layers, whose zeros would hide what is before them."""
    torch.manual_seed(seed)
    network = fitvid.FitVidModel(settings, **more)
    with torch.no_grad():
        network.decoder.colours.weight.normal_(std=0.1)
        network.frame_predictor.head.weight.normal_(std=0.3)
    return network


def scene(side=16, steps=4, seed=0):
    frames, actions = square_video(side, steps, np.random.default_rng(seed))
    places = np.concatenate([[[0.0, 0.0]], np.cumsum(0.2 * actions[:, :2], axis=0)])
    given = (torch.as_tensor(one, dtype=torch.float32) for one in (actions, places))
    return windows([Video(torch.as_tensor(frames), *given, ())], np.zeros(1, int), steps)


@pytest.mark.parametrize(
    ("bad", "subject"),
    [({"side": 20}, "side"), ({"side": 8}, "side"), ({"width": 0}, "width"), ({"hidden": 0}, "LSTMs")],
)
def test_sizes_out_of_range_are_refused(bad, subject):
    with pytest.raises(InvalidInput, check=about(subject)):
        fitvid.FitVidSettings(**bad)


def test_a_decoder_cell_begins_as_its_shortcut():
    x = torch.randn(2, 4, 8, 8)
    torch.testing.assert_close(fitvid.DecoderCell(4, 4)(x), torch.nn.functional.silu(x))
    assert fitvid.DecoderCell(4, 2, grows=True)(x).shape == (2, 2, 16, 16)
    assert fitvid.EncoderCell(4, 6, 2)(x).shape == (2, 6, 4, 4)


@pytest.mark.parametrize("side", [16, 32])
def test_predictions_are_images_and_the_same_each_time(side):
    network = model(fitvid.FitVidSettings(side=side, width=1, features=8, hidden=8, latent=2)).eval()
    context = np.random.default_rng(0).random((2, side, side, 3))
    frames, again = (network.predict(context, np.zeros((5, 3, 3)), PUSHER) for _ in range(2))
    assert frames.shape == (5, 3, side, side, 3)
    assert frames.dtype == np.float32
    assert 0 <= frames.min() <= frames.max() <= 1
    np.testing.assert_array_equal(frames, again)
    with pytest.raises(InvalidInput, check=about("context frames")):
        network.predict(np.zeros((2, 48, 48, 3)), np.zeros((1, 1, 3)), PUSHER)


def test_a_new_network_copies_the_last_frame():
    context = np.random.default_rng(0).random((2, 16, 16, 3))
    frames = fitvid.FitVidModel(TINY).eval().predict(context, np.full((2, 3, 3), 0.1), PUSHER)
    np.testing.assert_allclose(frames, np.broadcast_to(context[1], frames.shape), atol=1 / 255)


def test_each_sequence_is_predicted_as_if_alone_and_nothing_sees_the_future():
    network = model().eval()
    rng = np.random.default_rng(0)
    context, actions = rng.random((2, 16, 16, 3)), rng.uniform(-0.3, 0.3, (40, 3, 3))
    together = network.predict(context, actions, PUSHER)
    np.testing.assert_allclose(together[35], network.predict(context, actions[35:36], PUSHER)[0], atol=1e-5)
    changed = actions[:2].copy()
    changed[:, 2] = 0.2
    later = network.predict(context, changed, PUSHER)
    np.testing.assert_allclose(later[:, :2], together[:2, :2], atol=1e-6)
    assert np.abs(later[:, 2] - together[:2, 2]).max() > 0
    elsewhere = network.predict(context, actions[:1], np.array([0.2, 0.1, 0.06]))
    assert np.abs(elsewhere - together[0]).max() > 0
    moved = network.predict(context, actions[:1], PUSHER, between=np.array([0.3, 0, 0]))
    assert np.abs(moved - together[0]).max() > 0


def test_gradients_reach_every_parameter():
    """In one of four networks at least: rectified units may all be off for one scene."""
    dead = set[str]()
    for seed in range(4):
        network = model(seed=seed)
        with torch.no_grad():  # what begins at zero would hide what is behind it
            for parameter in network.parameters():
                parameter += 0.1 * torch.randn_like(parameter)
        losses = network.losses(*scene(seed=seed), torch.Generator().manual_seed(0))
        (losses.squared_error + losses.kl).backward()
        reached = {n for n, p in network.named_parameters() if p.grad is not None and bool(p.grad.abs().sum() > 0)}
        missed = {n for n, _ in network.named_parameters()} - reached
        dead = missed if seed == 0 else dead & missed
    assert dead == set()


def test_the_error_is_that_of_the_frames_and_latents_come_from_the_generator():
    network = model()
    video, actions, pushers = scene()
    first, again, other = (network.losses(video, actions, pushers, torch.Generator().manual_seed(s)) for s in (0, 0, 1))
    assert torch.equal(first.squared_error, again.squared_error)
    assert not torch.equal(first.squared_error, other.squared_error)
    torch.testing.assert_close(first.kl, other.kl)  # of distributions, not of draws
    assert 0 < float(first.squared_error.detach()) < 4  # four frames, each of a mean over pixels below 1
    network.eval()  # else batch norm sees other frames
    whole, *parts = (
        float(network.losses(video, actions, pushers, torch.Generator().manual_seed(0), steps).squared_error.detach())
        for steps in (None, [0], [1], [2], [3])
    )
    assert np.mean(parts) == pytest.approx(whole, rel=1e-4)


@pytest.mark.slow
def test_a_short_sequence_can_be_learned_better_than_by_copying():
    network = model(fitvid.FitVidSettings(side=16, width=4, features=16, hidden=32, latent=2))
    videos = [scene(steps=4, seed=seed) for seed in range(2)]
    video, actions, pushers = (torch.cat(parts) for parts in zip(*videos, strict=True))
    copied = float((video[:, 2:] - video[:, 1:2]).square().mean())
    adam = torch.optim.Adam(network.parameters(), 3e-3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(80):
        losses = network.losses(video, actions, pushers, generator)
        adam.zero_grad()
        (losses.squared_error + 1e-4 * losses.kl).backward()
        adam.step()
    assert float(losses.squared_error.detach()) / 4 < 0.6 * copied


# Recurrence


pairs = st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(torch.tensor)
gaussians = st.builds(fitvid.Gaussian, pairs, pairs)


@given(p=gaussians, q=gaussians)
def test_the_divergence_is_what_torch_computes_and_never_negative(p, q):
    normal = [torch.distributions.Normal(g.mean, (g.logvar / 2).exp()) for g in (p, q)]
    expected = torch.distributions.kl_divergence(*normal).sum()
    torch.testing.assert_close(fitvid.kl_divergence(p, q), expected, rtol=1e-4, atol=1e-5)
    assert float(fitvid.kl_divergence(p, q)) >= -1e-5
    assert float(fitvid.kl_divergence(p, p)) == pytest.approx(0, abs=1e-6)


def test_draws_have_the_mean_and_the_variance():
    one = fitvid.Gaussian(torch.full((40_000,), 2.0), torch.full((40_000,), math.log(9.0)))
    drawn = one.sample(torch.Generator().manual_seed(0))
    assert float(drawn.mean()) == pytest.approx(2, abs=0.05)
    assert float(drawn.std()) == pytest.approx(3, abs=0.05)


# Weights


SETTINGS = fitvid.FitVidSettings(side=16, width=1, features=6, hidden=8, latent=2)
META = {"format": fitvid.FORMAT, "side": "16", "width": "1", "features": "6", "hidden": "8", "latent": "2"}


@pytest.fixture
def network():
    network = model(SETTINGS)
    seen = torch.rand(2, 4, 3, 16, 16), torch.zeros(2, 3, 3), torch.zeros(2, 4, 2)
    network.losses(*seen, None)  # so that batch norm has statistics
    return network.eval()


@pytest.fixture
def file(network, tmp_path):
    fitvid.write_fitvid(tmp_path / "net.safetensors", network)
    return tmp_path / "net.safetensors"


def test_what_was_written_predicts_the_same(network, file):
    again = fitvid.read_fitvid(file)
    assert again.settings == SETTINGS
    assert not again.training
    for name, value in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=1e-3, atol=1e-6)
    context, actions = np.random.default_rng(0).random((2, 16, 16, 3)), np.full((2, 3, 3), 0.1)
    np.testing.assert_allclose(
        again.predict(context, actions, PUSHER), network.predict(context, actions, PUSHER), atol=5e-3
    )
    assert file.stat().st_size < 2.6 * network.parameter_count + 40_000  # two bytes a parameter


def damaged(file, **changes):
    tensors = {**load(file.read_bytes()), **changes}
    return save({name: tensor for name, tensor in tensors.items() if tensor is not None}, META)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda f: f.read_bytes()[:1000], "no video prediction network"),
        (lambda f: save(load(f.read_bytes()), {**META, "format": "pushes-2"}), fitvid.FORMAT),
        (lambda f: save(load(f.read_bytes()), {n: v for n, v in META.items() if n != "hidden"}), "hidden"),
        (lambda f: save(load(f.read_bytes()), {**META, "side": "17"}), "17"),
        (lambda f: save(load(f.read_bytes()), {**META, "width": "256", "hidden": "4096"}), "fit"),
        (lambda f: damaged(f, **{"encoder.head.bias": None}), "fit"),
        (lambda f: damaged(f, **{"encoder.head.bias": torch.zeros(7)}), "fit"),
        (lambda f: damaged(f, **{"encoder.head.bias": torch.full((6,), torch.nan)}), "finite"),
    ],
)
def test_damaged_files_are_refused(file, spoil, reason):
    file.write_bytes(spoil(file))
    with pytest.raises(CorruptFile, check=about(reason)):
        fitvid.read_fitvid(file)
