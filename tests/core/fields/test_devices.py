import numba
import pytest
import torch

from osfcore.errors import InvalidInput
from osfcore.fields.devices import computing_threads, pick_device


@pytest.mark.parametrize("has_gpu", [True, False])
def test_auto_takes_a_gpu_where_there_is_one(monkeypatch, has_gpu):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_gpu)
    assert pick_device("cpu").type == "cpu"
    assert pick_device("auto").type == ("cuda" if has_gpu else "cpu")
    for name in ("tpu",) if has_gpu else ("tpu", "cuda"):
        with pytest.raises(InvalidInput):
            pick_device(name)


def test_threads_are_limited_and_given_back():
    before = torch.get_num_threads(), numba.get_num_threads()
    with computing_threads(1):
        assert (torch.get_num_threads(), numba.get_num_threads()) == (1, 1)
        with computing_threads(3):
            assert torch.get_num_threads() == 3
            assert 1 <= numba.get_num_threads() <= before[1]
    assert (torch.get_num_threads(), numba.get_num_threads()) == before
