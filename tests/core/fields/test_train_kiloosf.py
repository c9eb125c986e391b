"""Train kiloosf: kiloosf training, distillation."""

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
from osfcore.fields.kiloosf import FLOOR_G, read_field
from osfcore.fields.kiloosf_query import KiloQuery, Scatter
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RaySource, first_shell
from osfcore.fields.train_kiloosf import Distillation, Pace, Recipe, TrainField, first_student, train_field
from osfcore.fields.train_osf import Checkpoint, corners, read_checkpoint, write_checkpoint
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.image_set import read_image_set
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.core.fields.rendered_sets import QUICK, painted_ball, painted_block, write_object_set, write_table_set
from tests.core.fields.sets import CENTRE, HALF
from tests.core.render.scenes import plain_table

# Kiloosf training


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


# Distillation


CPU = torch.device("cpu")
SIZE = OSFSize(2, 16)
ALBEDO = torch.tensor([0.8, 0.5, 0.3])
WALL = 60.0  # density inside the ellipsoid [1/m]
TINY = Recipe(coarse_across=16, fine_across=24, cells=2, hidden=8, rays=512)


class Ellipsoid(OSF):
    """A teacher that knows the ellipsoid of the test sets: Lambert, with a soft rim."""

    def material_at(self, x):
        depth = 1 - ((x - torch.tensor(CENTRE, dtype=x.dtype)) / torch.tensor(HALF, dtype=x.dtype)).norm(dim=-1)
        return WALL * torch.sigmoid(40 * depth), ALBEDO.expand(len(x), 3)

    def density(self, x):
        return self.material_at(x)[0]

    def forward(self, x, light, view):
        normal = (x - torch.tensor(CENTRE, dtype=x.dtype)) / torch.tensor(HALF**2, dtype=x.dtype)
        shade = torch.relu((torch.nn.functional.normalize(normal, dim=-1) * light).sum(-1, keepdim=True))
        return Scatter(ALBEDO * 0.25 * torch.ones(len(x), 1), 0.75 * ALBEDO * shade, self.density(x))


@pytest.fixture(scope="module")
def teacher(images):
    return Ellipsoid(silhouette_box(images), SIZE)


@pytest.fixture(scope="module")
def student(images, teacher):
    rng = np.random.default_rng(0)
    fog = first_shell(images, silhouette_box(images), across=24, cells=1, hidden=8, inside_g=-2.0, rng=rng)
    return first_student(teacher, fog, images, across=32, cells=2, hidden=8, rng=rng)


def surface(count, rng, outward=0.0):
    """Points on the ellipsoid or away from it, random lights, and views from outside."""
    n, light = rng.normal(size=(2, count, 3))
    n, light = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (n, light))
    return [torch.from_numpy(a.astype(np.float32)) for a in (CENTRE + (1 + outward) * HALF * n, light, -n)]


@pytest.mark.usefixtures("one_thread")
def test_a_student_begins_with_the_teachers_density_and_albedo(student, teacher):
    query, kept = KiloQuery(student), student.index > 0
    x = torch.from_numpy(corners(student)[kept])
    with torch.no_grad():
        mine, right = (1 - torch.exp(-field.density(x) * student.voxel) for field in (query, teacher))
    # What is next to nothing becomes nothing, and the hull bounds all.
    assert torch.quantile((mine - right).abs(), 0.9) < 0.011
    assert (mine > 0.5).sum() > 100
    np.testing.assert_allclose(student.rows[1:, 1:4], ALBEDO.expand(len(x), 3), atol=1e-5)


@pytest.mark.usefixtures("one_thread")
def test_dipoles_point_out_of_the_surface(student):
    x, _, view = surface(500, np.random.default_rng(2))
    with torch.no_grad():
        normals = torch.nn.functional.normalize(KiloQuery(student).features(x)[:, 4:7], dim=-1)
    right = torch.nn.functional.normalize(
        (x - torch.tensor(CENTRE, dtype=x.dtype)) / torch.tensor(HALF**2, dtype=x.dtype), dim=-1
    )
    assert torch.quantile((normals * right).sum(-1), 0.1) > 0.9
    assert len(view) == 500


@pytest.mark.usefixtures("one_thread")
def test_the_grid_holds_all_density_and_drops_the_unseen_inside(student):
    low, high = student.box
    reach = 1.05 * HALF
    assert np.all(low < CENTRE - reach)
    assert np.all(high > CENTRE + reach)
    inner = np.round((CENTRE - student.origin) / student.voxel).astype(int)
    assert student.density[tuple(inner)] <= FLOOR_G, "no pixel sees the centre"
    assert 0.02 < (student.index > 0).mean() < 0.7


@pytest.mark.usefixtures("one_thread")
def test_distillation_brings_the_student_to_the_teacher(student, teacher, images):
    stage = Distillation(student, teacher, CPU)
    source, rng = RaySource(images), np.random.default_rng(3)
    pixels, generator = source.silhouette_pixels(), torch.Generator().manual_seed(0)
    x, light, view = surface(2000, np.random.default_rng(4), outward=-0.02)

    def error():
        with torch.no_grad():
            mine, right = KiloQuery(stage.snapshot())(x, light, view), teacher(x, light, view)
        return float((mine.direct - right.direct).abs().mean()), float((mine.ambient - right.ambient).abs().mean())

    before = error()
    losses = [stage.step(source.batch(rng.choice(pixels, 512)), k / 60, rng, generator) for k in range(60)]
    after = error()
    assert np.mean(losses[-10:]) < 0.3 * np.mean(losses[:3])
    assert after[0] < 0.5 * before[0]
    assert after[0] < 0.04
    assert after[1] < 0.02
    assert stage.snapshot().rows[0, 0] == student.rows[0, 0], "empty space stays empty"


@pytest.mark.usefixtures("one_thread")
def test_a_perfect_student_has_no_loss(student, images):
    """The loss compares like with like: a field that is its own teacher is right everywhere."""
    query = KiloQuery(student)
    stage = Distillation(student, query, CPU)
    points = surface(300, np.random.default_rng(5))
    generator = torch.Generator()
    with torch.no_grad():
        assert float(stage.loss(*points, generator)) < 1e-3
        query.ambient += 0.1
        assert float(stage.loss(*points, generator)) > 2e-3


@pytest.mark.usefixtures("one_thread")
def test_a_checkpoint_holds_the_teacher(student, images, tmp_path):
    osf = OSF(silhouette_box(images), SIZE, generator=torch.Generator().manual_seed(7))
    stage = Distillation(student, osf, CPU)
    path = tmp_path / "run.partial"
    write_checkpoint(path, Checkpoint("distil", stage.snapshot(), stage.state(), {}, {}), {"run": 1})
    saved = read_checkpoint(path, {"run": 1})
    assert saved is not None
    again = Distillation.restored(saved.field, saved.optimiser, SIZE, CPU)
    points = surface(100, np.random.default_rng(6))
    assert torch.equal(again.osf(*points).direct, osf(*points).direct)
    assert torch.equal(again.query(*points).direct, stage.query(*points).direct)


@pytest.fixture(scope="module")
def run_distillation(pristine_set, tmp_path_factory):
    """A whole training by way of a teacher, stopped once when the teacher is done, and gone on with."""
    out = tmp_path_factory.mktemp("distil") / "egg.safetensors"
    config = TrainField(
        pristine_set, out, iterations=60, device="cpu", recipe="distil", teacher_width=32, teacher_depth=2
    )
    notes = []
    steps = train_field(config, TINY)
    for step in steps:
        notes.append(step.progress.note)
        if "Refining" in step.progress.note:
            break
    steps.close()
    kept = out.with_suffix(".partial").exists()
    notes.append("killed")
    notes += [step.progress.note for step in train_field(config, TINY)]
    return out, kept, notes


@pytest.mark.usefixtures("one_thread")
def test_the_papers_way_leads_to_a_field(run_distillation):
    out, _, _ = run_distillation
    metrics = json.loads(out.with_suffix(".json").read_text())
    assert metrics["recipe"]["name"] == "distil"
    assert metrics["teacher"]["size"] == {"depth": 2, "width": 32}
    assert metrics["iterations"] == 60
    assert metrics["psnr_full"] > 15
    assert read_field(out).hidden == TINY.hidden


@pytest.mark.usefixtures("one_thread")
def test_a_killed_training_goes_on_from_the_phase_it_was_in(run_distillation):
    out, kept, notes = run_distillation
    assert kept
    assert not out.with_suffix(".partial").exists()
    after = notes[notes.index("killed") :]
    assert "Going on from a checkpoint" in after
    assert not any("Carving" in note or "Baking" in note for note in after)
