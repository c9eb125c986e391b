import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.rivals.fitvid import read_fitvid
from osfcore.experiments.rivals.train_fitvid import TrainFitVid, train_fitvid
from tests.core.experiments.rivals.fitvid.videos import write_videos

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_videos(tmp_path_factory.mktemp("videos") / "videos.h5")


def config(data, folder, **changes) -> TrainFitVid:
    settings = {"iterations": 3, "width": 1, "batch": 2, "frames": 4, "save_every": 1, "device": "cpu"}
    return TrainFitVid((data,), folder / "net.safetensors", **{**settings, **changes})


def assert_same_weights(a, b) -> None:
    a, b = load(a.read_bytes()), load(b.read_bytes())
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_run_writes_a_network_and_what_is_known_of_it(data, tmp_path):
    settings = config(data, tmp_path)
    steps = list(train_fitvid(settings))
    assert (steps[0].done, steps[-1].done, steps[-1].total) == (0, 3, 3)
    assert "held out" in steps[-1].note
    assert read_fitvid(settings.out).settings.side == 16
    told = json.loads(settings.out.with_suffix(".json").read_text(), parse_constant=pytest.fail)
    assert (told["iterations"], told["episodes"], told["videos"], told["data"]) == (3, 12, 2, ["videos.h5"])
    assert told["command"] == settings.command
    assert told["bytes"] == settings.out.stat().st_size
    assert told["parameters"] == read_fitvid(settings.out).parameter_count
    assert told["horizons"]["5"]["psnr_copied"] > 10
    assert len(told["steps"]) == 5
    assert {p.name for p in tmp_path.iterdir()} == {"net.safetensors", "net.json"}  # no checkpoint is left


def test_the_command_says_how_to_do_it_again(data, tmp_path):
    plain = TrainFitVid((data,), tmp_path / "net.safetensors")
    assert plain.command == "osf train fitvid --data videos.h5 --out net.safetensors"
    told = replace(plain, minutes=5.0, save_every=7, augment=False, seed=3).command
    assert told.endswith("--minutes 5.0 --no-augment --save-every 7 --seed 3")


def test_an_abandoned_run_goes_on_and_ends_as_a_whole_one(data, tmp_path):
    whole, parts = config(data, tmp_path / "whole"), config(data, tmp_path / "parts")
    list(train_fitvid(whole))
    begun = train_fitvid(parts)
    while next(begun).done < 2:
        pass
    begun.close()
    assert not parts.out.exists()
    assert [s.done for s in train_fitvid(parts)][:2] == [2, 3]
    assert_same_weights(whole.out, parts.out)


@pytest.mark.parametrize("damage", ["other settings", "cut short"])
def test_a_checkpoint_that_does_not_fit_is_not_gone_on_with(data, tmp_path, damage):
    settings = config(data, tmp_path)
    begun = train_fitvid(replace(settings, seed=1) if damage == "other settings" else settings)
    while next(begun).done < 2:
        pass
    begun.close()
    checkpoint = settings.out.with_suffix(".checkpoint")
    if damage == "cut short":
        checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    assert next(iter(train_fitvid(settings))).done == 0


def test_the_budget_may_grow(data, tmp_path):
    settings = config(data, tmp_path, iterations=2)
    begun = train_fitvid(settings)
    while next(begun).done < 1:
        pass
    begun.close()
    steps = list(train_fitvid(replace(settings, iterations=4)))
    assert (steps[0].done, steps[-1].done) == (1, 4)


def test_a_time_budget_ends(data, tmp_path):
    steps = list(train_fitvid(config(data, tmp_path, iterations=None, minutes=0.01)))
    assert steps[-1].done == steps[-1].total == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"iterations": 0}, "iterations is 0"),
        ({"minutes": 0.0}, "minutes is 0"),
        ({"width": 0}, "width of the network is 0"),
        ({"batch": 0}, "batch is 0"),
        ({"frames": 2}, "frames of a window is 2"),
        ({"frames": 8}, "frames of a window is 8"),
        ({"rate": float("nan")}, "rate of learning is nan"),
        ({"beta": -1.0}, "beta is -1"),
        ({"precision": "float64"}, "precision"),
        ({"save_every": 0}, "checkpoints is 0"),
        ({"measured": 0}, "held-out videos is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"device": "tpu"}, "device"),
        ({"data": ()}, "is 0"),
    ],
)
def test_bad_settings_are_refused_and_nothing_is_written(data, tmp_path, change, words):
    with pytest.raises(InvalidInput, match=words):
        list(train_fitvid(replace(config(data, tmp_path), **change)))
    assert not list(tmp_path.iterdir())


def test_bad_places_and_files_are_told(data, tmp_path):
    good = config(data, tmp_path)
    with pytest.raises(InvalidInput, match=r"\.safetensors"):
        list(train_fitvid(replace(good, out=tmp_path / "net.pt")))
    (tmp_path / "file").write_text("not a push file")
    with pytest.raises(CorruptFile, match="file"):
        list(train_fitvid(replace(good, data=(tmp_path / "file",))))
    (tmp_path / "net.json").write_text("{}")
    with pytest.raises(InvalidInput, match=r"net\.json beside it"):
        list(train_fitvid(good))
