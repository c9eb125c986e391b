import json

import pytest
import torch
from safetensors.torch import load, save

from osfcore.errors import CannotWrite, CorruptFile
from osfcore.fields.field_library import FieldLibrary
from osfcore.paper.dynamics import FORMAT, network_bytes, read_network, shipped, weights_path, write_network
from tests.core.paper.dynamics.scenes import NAMES, network

BIAS = "answer.bias"


def repacked(meta=None, **tensors) -> bytes:
    """The file of a network with some tensors or words changed; None leaves one out."""
    content = load(network_bytes(network())) | tensors
    words = {"format": FORMAT, "hidden": "16", "steps": "2", "names": json.dumps(NAMES)} | (meta or {})
    kept = {name: value for name, value in content.items() if value is not None}
    return save(kept, {name: word for name, word in words.items() if word is not None})


def test_a_round_trip_loses_no_more_than_half_precision(tmp_path):
    original = network(hidden=12, steps=3)
    write_network(tmp_path / "a.safetensors", original)
    back = read_network(tmp_path / "a.safetensors")
    assert (back.hidden, back.steps, back.names) == (12, 3, NAMES)
    assert not back.training
    for name, value in original.state_dict().items():
        torch.testing.assert_close(back.state_dict()[name], value, rtol=2**-10, atol=1e-7)
    again, first = load(network_bytes(back)), load((tmp_path / "a.safetensors").read_bytes())
    assert all(torch.equal(again[name], first[name]) for name in first)  # and nothing more the second time


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (lambda: b"", "no network"),
        (lambda: network_bytes(network())[:100], "no network"),
        (lambda: network_bytes(network())[:-1], "no network"),
        (lambda: repacked({"format": "pushes-2"}), f"not of the format {FORMAT}"),
        (lambda: repacked({"format": None}), f"not of the format {FORMAT}"),
        (lambda: repacked({"hidden": None}), "no network"),
        (lambda: repacked({"hidden": "many"}), "no network"),
        (lambda: repacked({"names": "["}), "no network"),
        (lambda: repacked({"names": "[" * 100_000}), "no network"),
        (lambda: repacked({"hidden": "1000000"}), "out of range"),
        (lambda: repacked({"steps": "0"}), "out of range"),
        (lambda: repacked({"names": "7"}), "names of objects"),
        (lambda: repacked({"names": '["a", 7]'}), "names of objects"),
        (lambda: repacked({"names": '["a", "a"]'}), "names of objects"),
        (lambda: repacked({"names": '["a"]'}), "do not fit"),
        (lambda: repacked({"hidden": "17"}), "do not fit"),
        (lambda: repacked(**{BIAS: None}), "do not fit"),
        (lambda: repacked(more=torch.zeros(7)), "do not fit"),
        (lambda: repacked(**{BIAS: torch.full((7,), float("nan"))}), "not all finite"),
        (lambda: repacked(**{"embedding.weight": torch.ones(4, 16)}), "unknown objects is not zero"),
    ],
)
def test_files_that_hold_no_network_are_told_in_one_sentence(tmp_path, data, words):
    path = tmp_path / "a.safetensors"
    path.write_bytes(data())
    with pytest.raises(CorruptFile, match=words) as caught:
        read_network(path)
    assert "a.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_places_that_cannot_be_read_or_written_are_told(tmp_path):
    with pytest.raises(CorruptFile):
        read_network(tmp_path / "nowhere.safetensors")
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        write_network(tmp_path / "file" / "a.safetensors", network())


def test_the_shipped_network_is_small_whole_and_described():
    assert shipped().stat().st_size < 1_000_000
    assert set(read_network(shipped()).names) == set(FieldLibrary(None).names())
    told = json.loads(shipped().with_suffix(".json").read_text())
    assert told["command"].startswith("osf train dynamics --method paper")
    assert told["validation_mm_4"] < told["validation_constant_mm_4"]
    assert told["bytes"] == shipped().stat().st_size


def test_a_network_of_this_machine_comes_first(tmp_path):
    assert weights_path(None) == weights_path(tmp_path) == shipped()
    own = tmp_path / "dynamics" / "paper_pushes.safetensors"
    write_network(own, network())
    assert weights_path(tmp_path) == own
