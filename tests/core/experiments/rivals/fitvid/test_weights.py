import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from osfcore.errors import CorruptFile
from osfcore.experiments.rivals.fitvid import FORMAT, FitVidModel, FitVidSettings, read_fitvid, write_fitvid

pytestmark = pytest.mark.usefixtures("one_thread")
TINY = FitVidSettings(side=16, width=1, features=6, hidden=8, latent=2)
META = {"format": FORMAT, "side": "16", "width": "1", "features": "6", "hidden": "8", "latent": "2"}


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = FitVidModel(TINY)
    network.losses(torch.rand(2, 4, 3, 16, 16), torch.zeros(2, 3, 3), None)  # so that batch norm has seen something
    return network.eval()


@pytest.fixture
def file(network, tmp_path):
    write_fitvid(tmp_path / "net.safetensors", network)
    return tmp_path / "net.safetensors"


def test_what_was_written_predicts_the_same(network, file):
    again = read_fitvid(file)
    assert again.settings == TINY
    assert not again.training
    for name, value in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=1e-3, atol=1e-6)
    context, actions = np.random.default_rng(0).random((2, 16, 16, 3)), np.full((2, 3, 3), 0.1)
    np.testing.assert_allclose(again.predict(context, actions), network.predict(context, actions), atol=5e-3)
    write_fitvid(file.with_name("twice.safetensors"), again)
    assert load(file.read_bytes()).keys() == load(file.with_name("twice.safetensors").read_bytes()).keys()


def test_parameters_take_two_bytes(network, file):
    assert file.stat().st_size < 2.6 * network.parameter_count + 40_000


def test_it_computes_in_what_is_asked_for(file):
    assert read_fitvid(file, torch.bfloat16).precision == torch.bfloat16


def damaged(file, **changes):
    tensors = {**load(file.read_bytes()), **changes}
    return save({name: tensor for name, tensor in tensors.items() if tensor is not None}, META)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: f.read_bytes()[:1000], "no video prediction network"),
        (lambda f: b"rubbish", "no video prediction network"),
        (lambda f: save(load(f.read_bytes()), {**META, "format": "pushes-2"}), FORMAT),
        (lambda f: save(load(f.read_bytes()), {n: v for n, v in META.items() if n != "hidden"}), "no video"),
        (lambda f: save(load(f.read_bytes()), {**META, "side": "17"}), "side of the frames"),
        (lambda f: save(load(f.read_bytes()), {**META, "width": "256", "hidden": "4096"}), "do not fit"),
        (lambda f: damaged(f, **{"encoder.head.bias": None}), "do not fit"),
        (lambda f: damaged(f, **{"encoder.head.bias": torch.zeros(7)}), "do not fit"),
        (lambda f: damaged(f, **{"encoder.head.bias": torch.full((6,), torch.nan)}), "not all finite"),
    ],
)
def test_damaged_files_are_refused(file, spoil, words):
    file.write_bytes(spoil(file))
    with pytest.raises(CorruptFile, match=words):
        read_fitvid(file)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(CorruptFile):
        read_fitvid(tmp_path / "none.safetensors")
