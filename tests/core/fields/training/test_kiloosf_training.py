import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.fields import train_kiloosf as training
from osfcore.fields.kiloosf import read_field
from osfcore.fields.train_kiloosf import Pace, TrainField, train_field
from osfcore.io.image_set import read_image_set
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.core.fields.rendered_sets import QUICK, painted_ball, painted_block, write_object_set, write_table_set
from tests.core.render.scenes import plain_table


@pytest.fixture(scope="module")
def block_set(tmp_path_factory):
    return write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block())


@pytest.fixture(scope="module")
def ball_set(tmp_path_factory):
    return write_object_set(tmp_path_factory.mktemp("sets") / "ball", painted_ball(), seed=1)


OFTEN = Pace(0.0, 0.0)


def run(config: TrainField, pace: Pace | None = None):
    return list(train_field(config, QUICK, pace))


def metrics(config: TrainField) -> dict:
    return json.loads(config.out.with_suffix(".json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["block", "ball"])
def test_a_field_learns_shape_colour_and_light_from_images(shape, request, tmp_path):
    config = TrainField(
        request.getfixturevalue(f"{shape}_set"), tmp_path / "a.safetensors", iterations=150, device="cpu"
    )
    steps = run(config)
    last = steps[-1]
    assert last.psnr_full > 33
    assert last.psnr_mask > 31
    assert last.progress.done == last.progress.total == 150
    assert "dB held out" in last.progress.note
    assert [s.progress.done for s in steps] == sorted(s.progress.done for s in steps)
    found = metrics(config)
    assert found["psnr_full"] == pytest.approx(last.psnr_full, abs=1e-3)
    assert found["psnr_mask"] == pytest.approx(last.psnr_mask, abs=1e-3)
    assert (found["train_images"], found["test_images"], found["image_size"]) == (24, 4, [32, 32])
    assert (found["iterations"], found["seed"], found["data"], found["device"]) == (150, 0, shape, "cpu")
    assert found["bytes"] == config.out.stat().st_size < 2_000_000
    assert found["recipe"]["fine_across"] == QUICK.fine_across
    assert found["minutes"] > 0
    assert last.preview.shape == (32, 96, 3)
    assert last.preview.dtype == np.uint8
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.safetensors"]
    size = np.ptp(read_field(config.out).extent, axis=0)
    truth = np.ptp(painted_block().extent if shape == "block" else painted_ball().extent, axis=0)
    np.testing.assert_allclose(size, truth, atol=0.02)


@pytest.mark.slow
def test_a_field_without_light_learns_the_mean_over_lights(ball_set, tmp_path):
    lit, unlit = (
        TrainField(ball_set, tmp_path / f"{name}.safetensors", iterations=150, device="cpu", lit=name == "lit")
        for name in ("lit", "unlit")
    )
    assert run(unlit)[-1].psnr_full < run(lit)[-1].psnr_full - 3
    assert (metrics(unlit)["lit"], metrics(lit)["lit"]) == (False, True)
    field = read_field(unlit.out)
    scene = SceneBatch(("ball",), np.zeros((2, 1, 3)), np.tile([1.0, 0, 0, 0], (2, 1, 1)), np.eye(3)[1:], None)
    seen = SceneRenderer({"ball": field}, None).render(scene, read_image_set(ball_set, "test").cameras[:1]).rgb
    assert seen.max() > 0.1
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-6)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_field(block_set, tmp_path):
    outs = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        config = TrainField(block_set, tmp_path / f"{name}.safetensors", iterations=40, seed=seed, device="cpu")
        outs.append((run(config)[-1].psnr_full, read_field(config.out)))
    assert outs[0][0] == pytest.approx(outs[1][0], abs=0.1)
    np.testing.assert_allclose(outs[0][1].networks, outs[1][1].networks, atol=0.02)
    assert not np.array_equal(outs[0][1].networks, outs[2][1].networks)


@pytest.mark.slow
def test_longer_training_does_not_hurt(block_set, tmp_path):
    short, long = (run(TrainField(block_set, tmp_path / f"{n}.safetensors", iterations=n))[-1] for n in (15, 100))
    assert long.psnr_full > short.psnr_full + 1


@pytest.mark.slow
def test_a_time_budget_is_kept(block_set, tmp_path):
    config = TrainField(block_set, tmp_path / "a.safetensors", minutes=0.05)
    steps = run(config)
    assert steps[-1].progress.total == 3
    assert 0.04 < metrics(config)["minutes"] < 0.5
    assert metrics(config)["iterations"] > 3


_KILLED = """
import sys
from pathlib import Path
from osfcore.fields.train_kiloosf import train_field
from osfcore.fields.train_kiloosf import Pace, TrainField
from tests.core.fields.rendered_sets import QUICK
config = TrainField(Path(sys.argv[1]), Path(sys.argv[2]), iterations=240, device="cpu")
for step in train_field(config, QUICK, Pace(0.2, 0.2)):
    print(step.progress.done, flush=True)
"""


@pytest.mark.slow
def test_killed_training_goes_on_where_it_was(block_set, tmp_path):
    """SIGKILL in the middle: the same command takes up the checkpoint and ends as an undisturbed run does."""
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=240, device="cpu")
    command = [sys.executable, "-c", _KILLED, str(block_set), str(config.out)]
    process = subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, stdout=subprocess.PIPE, text=True)
    partial = config.out.with_suffix(".partial")
    done = 0
    for line in process.stdout:
        done = int(line)
        if done >= 80 and partial.exists():
            break
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=30)
    process.stdout.close()
    assert 80 <= done < 240
    assert not config.out.exists()
    began = time.monotonic()
    steps = run(config, pace=OFTEN)
    assert steps[1].progress.note == "Going on from a checkpoint"
    assert 20 < steps[1].progress.done <= done + 100
    assert not partial.exists()
    assert metrics(config)["iterations"] == 240
    undisturbed = run(replace(config, out=tmp_path / "b.safetensors"))[-1]
    assert abs(steps[-1].psnr_full - undisturbed.psnr_full) < 1
    assert time.monotonic() - began < 300


def test_a_checkpoint_of_other_settings_is_not_gone_on_from(block_set, tmp_path):
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=40, device="cpu")
    for step in train_field(config, QUICK, OFTEN):
        if step.progress.done >= 3:
            break
    assert config.out.with_suffix(".partial").exists()
    steps = run(replace(config, seed=9), OFTEN)
    assert steps[1].progress.note == "Carving the silhouettes"


def test_a_checkpoint_of_other_images_in_the_same_place_is_not_gone_on_from(block_set, tmp_path):
    data = shutil.copytree(block_set, tmp_path / "set")
    config = TrainField(data, tmp_path / "a.safetensors", iterations=40, device="cpu")

    def begin():
        for step in train_field(config, QUICK, OFTEN):
            if step.progress.done >= 3:
                return
            if step.progress.note in ("Going on from a checkpoint", "Carving the silhouettes"):
                yield step.progress.note

    assert list(begin()) == ["Carving the silhouettes"]
    assert list(begin()) == ["Going on from a checkpoint"]
    anno = data / "train" / "anno.json"
    entries = json.loads(anno.read_text())
    entries[3]["light_pos"] = [0, 0, 1]
    anno.write_text(json.dumps(entries))
    assert list(begin()) == ["Carving the silhouettes"]
    shutil.rmtree(data)
    write_object_set(data, painted_ball(), seed=1)
    assert list(begin()) == ["Carving the silhouettes"]


def test_a_field_that_cannot_be_read_back_leaves_the_older_one(block_set, tmp_path, monkeypatch):
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=10, device="cpu")
    config.out.write_bytes(b"older")
    monkeypatch.setattr(training, "field_bytes", lambda field: b"broken")
    with pytest.raises(CorruptFile, match="The trained field cannot be used"):
        run(config)
    assert config.out.read_bytes() == b"older"
    assert not config.out.with_suffix(".json").exists()


def test_a_checkpoint_that_cannot_be_gone_on_from_ends_the_training_and_stays(block_set, tmp_path):
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=40, device="cpu")
    for step in train_field(config, QUICK, OFTEN):
        if step.progress.done >= 3:
            break
    partial = config.out.with_suffix(".partial")
    content = torch.load(partial)
    torch.save({**content, "optimiser": {"state": {}, "param_groups": []}}, partial)
    kept = partial.read_bytes()
    with pytest.raises(CorruptFile, match="delete it"):
        run(config)
    assert partial.read_bytes() == kept


class Clock:
    """A clock that goes on by a quarter of a second whenever it is read."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        self.now_s += 0.25
        return self.now_s


@pytest.mark.parametrize(("report_s", "checkpoint_s"), [(0.0, 0.0), (0.0, 1e9), (1e9, 0.0), (1e9, 1e9)])
def test_only_steps_of_descent_cost_the_budget(block_set, tmp_path, report_s, checkpoint_s):
    config = TrainField(block_set, tmp_path / "a.safetensors", minutes=0.05, device="cpu")
    clock = Clock()
    for number, _ in enumerate(train_field(config, QUICK, Pace(report_s, checkpoint_s, clock))):
        assert number < 40  # else it goes on for ever
        clock.now_s += 100.0  # whoever is told takes time
    assert metrics(config)["iterations"] == 12  # of a quarter of a second, in three seconds
    assert metrics(config)["minutes"] == 0.05


def test_a_broken_checkpoint_is_passed_over(block_set, tmp_path):
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=10, device="cpu")
    config.out.with_suffix(".partial").write_bytes(b"PK\x03\x04 cut short")
    assert run(config)[1].progress.note == "Carving the silhouettes"
    assert config.out.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"minutes": 0.0}, "minutes is 0.0, but it must be between 0.05 and 1440"),
        ({"minutes": float("nan")}, "minutes is nan"),
        ({"minutes": 1e9}, "minutes"),
        ({"seed": -1}, "seed is -1, but it must be between 0 and"),
        ({"seed": 2**63}, "seed is 9223372036854775808, but it must be between 0 and"),
        ({"seed": 10**30}, "seed"),
        ({"iterations": 9}, "iterations is 9, but it must be between 10"),
        ({"iterations": 10**9}, "iterations"),
        ({"device": "tpu"}, "device is tpu, but it must be auto, cpu or cuda"),
        ({"recipe": "magic"}, "recipe is magic"),
    ],
)
def test_settings_out_of_range_are_told_before_anything_is_read(change, message, tmp_path):
    config = replace(TrainField(tmp_path / "nothing", tmp_path / "a.safetensors"), **change)
    with pytest.raises(InvalidInput, match=message):
        next(train_field(config))


def test_an_output_of_another_kind_is_told(tmp_path):
    with pytest.raises(InvalidInput, match="output file is .*a.pt, but it must be a path that ends in .safetensors"):
        next(train_field(TrainField(tmp_path, tmp_path / "a.pt")))


def test_places_are_tried_before_anything_is_read(tmp_path):
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "mine.json").write_text('{"people": ["Ada"]}')
    for name, error, words in (
        ("folder.safetensors", CannotWrite, "it is a folder"),
        ("file/a.safetensors", CannotWrite, "Not a directory"),
        (f"{'x' * 300}.safetensors", CannotWrite, "too long"),
        ("mine.safetensors", InvalidInput, "mine.json beside it"),
    ):
        with pytest.raises(error, match=words):
            next(train_field(TrainField(tmp_path / "nothing", tmp_path / name)))
    assert (tmp_path / "mine.json").read_text() == '{"people": ["Ada"]}'
    assert len(list(tmp_path.iterdir())) == 3


def test_sets_that_are_not_there_or_show_no_object_are_told(tmp_path):
    with pytest.raises(CorruptFile, match="anno.json"):
        run(TrainField(tmp_path, tmp_path / "a.safetensors", iterations=10))
    opaque = write_table_set(tmp_path / "table", plain_table(), train=8, test=1, size=16)
    with pytest.raises(CorruptFile, match="opaque all over; an object before a transparent background is expected"):
        run(TrainField(opaque, tmp_path / "a.safetensors", iterations=10))
    assert not (tmp_path / "a.safetensors").exists()


def test_a_place_that_cannot_be_written_is_told(block_set, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="file"):
        run(TrainField(block_set, tmp_path / "file" / "a.safetensors", iterations=10))
