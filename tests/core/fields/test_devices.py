import numba
import pytest
import torch

from osfcore.errors import InvalidInput
from osfcore.fields.devices import computing_threads, pick_device


def test_the_processor_is_always_there():
    assert pick_device("cpu") == torch.device("cpu")


def test_auto_takes_a_gpu_where_there_is_one(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert pick_device("auto") == torch.device("cuda")
    assert pick_device("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert pick_device("auto") == torch.device("cpu")


def test_a_missing_gpu_is_told_in_words(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InvalidInput, match="finds no GPU"):
        pick_device("cuda")
    with pytest.raises(InvalidInput, match="auto, cpu or cuda"):
        pick_device("tpu")


def test_threads_are_limited_and_given_back():
    before = torch.get_num_threads(), numba.get_num_threads()
    with computing_threads(1):
        assert (torch.get_num_threads(), numba.get_num_threads()) == (1, 1)
        with computing_threads(3):
            assert torch.get_num_threads() == 3
            assert 1 <= numba.get_num_threads() <= before[1]
    assert (torch.get_num_threads(), numba.get_num_threads()) == before
