import pytest
import torch
from safetensors.torch import load, save

from osfcore.dynamics.graph import FORMAT, PropagationNetwork, network_bytes, read_network, shipped, write_network
from osfcore.errors import CannotWrite, CorruptFile
from tests.core.dynamics.scenes import network
from tests.core.dynamics.test_propagation_network import graph


def repacked(meta=None, **tensors) -> bytes:
    """The file of a network with some tensors or words changed; None leaves one out."""
    content = load(network_bytes(network())) | tensors
    words = {"format": FORMAT, "hidden": "16", "steps": "3"} | (meta or {})
    kept = {name: value for name, value in content.items() if value is not None}
    return save(kept, {name: word for name, word in words.items() if word is not None})


@pytest.mark.parametrize(("hidden", "steps"), [(1, 1), (16, 3), (40, 5)])
def test_a_round_trip_loses_no_more_than_half_precision(tmp_path, hidden, steps):
    torch.manual_seed(0)
    original = PropagationNetwork(hidden, steps)
    write_network(tmp_path / "a.safetensors", original)
    back = read_network(tmp_path / "a.safetensors")
    assert (back.hidden, back.steps) == (hidden, steps)
    assert not back.training
    for name, value in original.state_dict().items():
        torch.testing.assert_close(back.state_dict()[name], value, rtol=2**-10, atol=1e-7)
    with torch.inference_mode():
        torch.testing.assert_close(back(*graph()), original(*graph()), rtol=0, atol=0.02)


def test_what_was_read_is_written_without_further_loss(tmp_path):
    write_network(tmp_path / "a.safetensors", network())
    once = read_network(tmp_path / "a.safetensors")
    again, first = load(network_bytes(once)), load((tmp_path / "a.safetensors").read_bytes())
    assert set(again) == set(first)
    assert all(torch.equal(again[name], first[name]) for name in first)


BIAS = "decoder.4.bias"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (lambda: b"", "no network"),
        (lambda: b"not a network at all", "no network"),
        (lambda: network_bytes(network())[:100], "no network"),
        (lambda: network_bytes(network())[:-1], "no network"),
        (lambda: repacked({"format": "pushes-0"}), f"not of the format {FORMAT}"),
        (lambda: repacked({"format": None}), f"not of the format {FORMAT}"),
        (lambda: save(load(network_bytes(network()))), f"not of the format {FORMAT}"),
        (lambda: repacked({"hidden": None}), "no network"),
        (lambda: repacked({"hidden": "many"}), "no network"),
        (lambda: repacked({"hidden": "0"}), "out of range"),
        (lambda: repacked({"hidden": "1000000"}), "out of range"),
        (lambda: repacked({"steps": "0"}), "out of range"),
        (lambda: repacked({"hidden": "17"}), "do not fit"),
        (lambda: repacked(**{BIAS: None}), "do not fit"),
        (lambda: repacked(**{BIAS: torch.zeros(7)}), "do not fit"),
        (lambda: repacked(more=torch.zeros(7)), "do not fit"),
        (lambda: repacked(**{BIAS: torch.full((6,), float("nan"))}), "not all finite"),
        (lambda: repacked(**{BIAS: torch.full((6,), float("inf"))}), "not all finite"),
    ],
)
def test_files_that_hold_no_network_are_told(tmp_path, data, words):
    path = tmp_path / "a.safetensors"
    path.write_bytes(data())
    with pytest.raises(CorruptFile, match=words) as caught:
        read_network(path)
    assert "a.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_places_that_cannot_be_read_or_written_are_told(tmp_path):
    with pytest.raises(CorruptFile):
        read_network(tmp_path / "nowhere.safetensors")
    with pytest.raises(CorruptFile):
        read_network(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        write_network(tmp_path / "file" / "a.safetensors", network())


def test_the_shipped_network_is_small_and_whole():
    assert shipped().stat().st_size < 2_500_000
    assert read_network(shipped()).hidden >= 16
    assert shipped("else").name == "else.safetensors"
