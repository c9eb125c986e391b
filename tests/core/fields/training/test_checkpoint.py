import numpy as np
import pytest
import torch

from osfcore.errors import CannotWrite, CorruptFile
from osfcore.fields.train_osf import Checkpoint, Rates, Stage, read_checkpoint, write_checkpoint
from tests.core.render.scenes import random_field

MARK = {"settings": {"seed": 3, "minutes": 0.5, "iterations": None}, "images": 7}


@pytest.fixture
def checkpoint() -> Checkpoint:
    field = random_field(np.random.default_rng(0))
    stage = Stage(field, Rates(1e-2, 1e-3), torch.device("cpu"))
    random = {
        "numpy": np.random.default_rng(5).bit_generator.state,
        "torch": torch.Generator().manual_seed(1).get_state(),
    }
    clock = {"seconds": 12.5, "steps": 340, "looked_at": 10.0, "psnr": (30.0, 25.0)}
    return Checkpoint("fine", stage.snapshot(), stage.state(), clock, random)


def test_what_was_written_is_read(checkpoint, tmp_path):
    path = tmp_path / "a.partial"
    write_checkpoint(path, checkpoint, MARK)
    back = read_checkpoint(path, MARK)
    assert back is not None
    assert (back.stage, back.clock) == ("fine", checkpoint.clock)
    for name in ("origin", "index", "rows", "cells", "networks", "ambient", "density", "macro"):
        np.testing.assert_array_equal(getattr(back.field, name), getattr(checkpoint.field, name))
        assert getattr(back.field, name).dtype == getattr(checkpoint.field, name).dtype
    rng = np.random.default_rng(0)
    rng.bit_generator.state = back.random["numpy"]
    assert rng.random() == np.random.default_rng(5).random()
    generator = torch.Generator()
    generator.set_state(back.random["torch"])
    assert torch.rand(1, generator=generator) == torch.rand(1, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("mark", [{}, MARK | {"images": 8}, MARK | {"settings": {"seed": 4}}])
def test_other_runs_do_not_go_on_from_it(checkpoint, tmp_path, mark):
    write_checkpoint(tmp_path / "a.partial", checkpoint, MARK)
    assert read_checkpoint(tmp_path / "a.partial", mark) is None


def test_broken_files_are_passed_over(checkpoint, tmp_path):
    path = tmp_path / "a.partial"
    assert read_checkpoint(path, MARK) is None
    write_checkpoint(path, checkpoint, MARK)
    data = path.read_bytes()
    for garbage in (b"", b"PK", data[:1000], data[: len(data) // 2], data[:-1], bytes(100)):
        path.write_bytes(garbage)
        assert read_checkpoint(path, MARK) is None


def test_a_checkpoint_of_the_same_run_that_lacks_something_is_told_and_kept(checkpoint, tmp_path):
    path = tmp_path / "a.partial"
    write_checkpoint(path, checkpoint, MARK)
    content = torch.load(path)
    for lost in ("stage", "field", "optimiser", "clock", "random"):
        torch.save({key: value for key, value in content.items() if key != lost}, path)
        with pytest.raises(CorruptFile, match="delete it"):
            read_checkpoint(path, MARK)
        assert path.exists()


class _Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('ran')",))


def test_a_checkpoint_runs_no_code(tmp_path):
    torch.save({"fingerprint": MARK, "stage": _Evil()}, tmp_path / "a.partial")
    assert read_checkpoint(tmp_path / "a.partial", MARK) is None


def test_a_disk_that_refuses_leaves_the_former_one(checkpoint, tmp_path, monkeypatch):
    path = tmp_path / "a.partial"
    write_checkpoint(path, checkpoint, MARK)
    before = path.read_bytes()

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(CannotWrite, match="No space left"):
        write_checkpoint(path, checkpoint, MARK)
    assert path.read_bytes() == before
