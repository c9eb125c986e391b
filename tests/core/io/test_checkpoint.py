import pytest
import torch

from osfcore.errors import CorruptFile
from osfcore.io.checkpoint import resume_from, write_checkpoint
from tests.support.errors import about


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "net.checkpoint"
    write_checkpoint(path, "this run", {"weights": torch.arange(1000.0), "done": 7})
    return path


@pytest.mark.parametrize("damage", ["missing", "cut short", "rubbish", "empty", "of another run", "no checkpoint"])
def test_a_run_goes_on_from_its_own_checkpoint_and_starts_over_where_there_is_none(path, damage):
    taken, data = [], path.read_bytes()
    resume_from(path, "this run", taken.append)
    assert [(content["done"], float(content["weights"][-1])) for content in taken] == [(7, 999.0)]
    if damage == "missing":
        path.unlink()
    elif damage == "of another run":
        write_checkpoint(path, "another run", {})
    elif damage == "no checkpoint":
        torch.save([1, 2], path)
    else:
        path.write_bytes({"cut short": data[: len(data) // 2], "rubbish": b"rubbish", "empty": b""}[damage])
    resume_from(path, "this run", taken.append)
    assert len(taken) == 1


def test_a_checkpoint_that_is_taken_over_by_half_ends_the_run_and_stays(path):
    with pytest.raises(CorruptFile, check=about("net.checkpoint")):
        resume_from(path, "this run", lambda content: content["optimiser"])
    assert path.exists()
    with pytest.raises(CorruptFile):  # what cannot be read is not taken for none
        resume_from(path.parent, "this run", print)


@pytest.mark.parametrize("error", [MemoryError, torch.OutOfMemoryError])
def test_a_lack_of_memory_is_not_laid_to_the_checkpoint(path, error):
    def restore(content):
        raise error

    with pytest.raises(error):
        resume_from(path, "this run", restore)
