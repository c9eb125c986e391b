import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.fields import train_kiloosf as training
from osfcore.fields.kiloosf import FLOOR_G, read_field
from osfcore.fields.kiloosf_query import KiloQuery, Scatter
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RaySource, first_shell
from osfcore.fields.train_kiloosf import Distillation, TrainField, first_student, train_field
from osfcore.fields.train_osf import Pace, corners
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.image_set import read_image_set
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.support.ellipsoid_sets import CENTRE, HALF
from tests.support.errors import about
from tests.support.rendered_scenes import plain_table
from tests.support.rendered_sets import QUICK, painted_ball, painted_block, write_object_set, write_table_set

pytestmark = pytest.mark.usefixtures("one_thread")
OFTEN = Pace(0.0, 0.0)


@pytest.fixture(scope="module")
def block_set(tmp_path_factory):
    return write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block())


def run(config: TrainField, pace: Pace | None = None):
    return list(train_field(config, QUICK, pace))


def metrics(config: TrainField) -> dict:
    return json.loads(config.out.with_suffix(".json").read_text())


def begin(config: TrainField) -> str:
    """Train until a checkpoint of the first step is written, and return how the training began."""
    _, began, *_ = islice(train_field(config, QUICK, OFTEN), 4)
    return began.progress.note


@pytest.mark.slow
def test_a_field_learns_shape_colour_and_light_from_images(block_set, tmp_path):
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=150, device="cpu")
    steps = run(config)
    last, found = steps[-1], metrics(config)
    assert last.psnr_full > 33
    assert last.psnr_mask > 31
    assert last.progress.done == last.progress.total == 150
    assert [s.progress.done for s in steps] == sorted(s.progress.done for s in steps)
    assert found["psnr_full"] == pytest.approx(last.psnr_full, abs=1e-3)
    assert found["psnr_mask"] == pytest.approx(last.psnr_mask, abs=1e-3)
    assert (found["train_images"], found["test_images"], found["image_size"]) == (24, 4, [32, 32])
    assert (found["iterations"], found["seed"], found["data"], found["device"]) == (150, 0, "block", "cpu")
    assert found["bytes"] == config.out.stat().st_size < 2_000_000
    assert last.preview.shape == (32, 96, 3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.safetensors"]
    np.testing.assert_allclose(
        np.ptp(read_field(config.out).extent, axis=0), np.ptp(painted_block().extent, axis=0), atol=0.02
    )
    unlit = replace(config, out=tmp_path / "unlit.safetensors", lit=False)
    assert run(unlit)[-1].psnr_full < last.psnr_full - 3
    scene = SceneBatch(("it",), np.zeros((2, 1, 3)), np.tile([1.0, 0, 0, 0], (2, 1, 1)), np.eye(3)[1:], None)
    renderer, cameras = (
        SceneRenderer({"it": read_field(unlit.out)}, None),
        read_image_set(block_set, "test").cameras[:1],
    )
    seen = renderer.render(scene, cameras).rgb
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


_KILLED = """
import sys
from pathlib import Path
from osfcore.fields.train_kiloosf import TrainField, train_field
from osfcore.fields.train_osf import Pace
from tests.support.rendered_sets import QUICK
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
    steps = run(config, pace=OFTEN)
    assert 20 < steps[1].progress.done <= done + 100
    assert not partial.exists()
    assert metrics(config)["iterations"] == 240
    undisturbed = run(replace(config, out=tmp_path / "b.safetensors"))[-1]
    assert abs(steps[-1].psnr_full - undisturbed.psnr_full) < 1


def test_only_a_checkpoint_of_the_same_settings_and_images_is_gone_on_from(block_set, tmp_path):
    data = shutil.copytree(block_set, tmp_path / "set")
    config = TrainField(data, tmp_path / "a.safetensors", iterations=40, device="cpu")
    new, going_on = begin(config), begin(config)
    assert new != going_on
    assert begin(replace(config, seed=9)) == new
    assert begin(replace(config, seed=9)) == going_on
    anno = data / "train" / "anno.json"
    entries = json.loads(anno.read_text())
    entries[3]["light_pos"] = [0, 0, 1]
    anno.write_text(json.dumps(entries))
    assert begin(config) == new
    shutil.rmtree(data)
    write_object_set(data, painted_ball(), train=8, test=1, seed=1)
    assert begin(config) == new


def test_a_checkpoint_that_cannot_be_gone_on_from_ends_the_training_and_stays(block_set, tmp_path):
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=40, device="cpu")
    begin(config)
    partial = config.out.with_suffix(".partial")
    torch.save({**torch.load(partial), "optimiser": {"state": {}, "param_groups": []}}, partial)
    kept = partial.read_bytes()
    with pytest.raises(CorruptFile):
        run(config)
    assert partial.read_bytes() == kept


def test_a_field_that_cannot_be_read_back_leaves_the_older_one(block_set, tmp_path, monkeypatch):
    config = TrainField(block_set, tmp_path / "a.safetensors", iterations=10, device="cpu")
    config.out.write_bytes(b"older")
    monkeypatch.setattr(training, "field_bytes", lambda field: b"broken")
    with pytest.raises(CorruptFile):
        run(config)
    assert config.out.read_bytes() == b"older"
    assert not config.out.with_suffix(".json").exists()


class Clock:
    """A clock that goes on by a quarter of a second whenever it is read."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        self.now_s += 0.25
        return self.now_s


@pytest.mark.parametrize(("report_s", "checkpoint_s"), [(0.0, 1e9), (1e9, 0.0)])
def test_only_steps_of_descent_cost_the_budget(block_set, tmp_path, report_s, checkpoint_s):
    config = TrainField(block_set, tmp_path / "a.safetensors", minutes=0.05, device="cpu")
    clock = Clock()
    for number, _ in enumerate(train_field(config, QUICK, Pace(report_s, checkpoint_s, clock))):
        assert number < 40  # else it goes on for ever
        clock.now_s += 100.0  # whoever looks at the steps takes time
    assert metrics(config)["iterations"] == 12  # of a quarter of a second, in three seconds
    assert metrics(config)["minutes"] == 0.05


def test_settings_and_places_are_tried_before_anything_is_read(tmp_path):
    config = TrainField(tmp_path / "nothing", tmp_path / "a.safetensors")
    for name, values in {
        "minutes": (0.0, float("nan"), 1e9),
        "seed": (-1, 2**63, 10**30),
        "iterations": (9, 10**9),
        "device": ("tpu",),
        "recipe": ("magic",),
    }.items():
        for value in values:
            with pytest.raises(InvalidInput, check=about(name)):
                next(train_field(replace(config, **{name: value})))
    (tmp_path / "folder.safetensors").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "mine.json").write_text('{"people": ["Ada"]}')
    for name, error in (
        ("a.pt", InvalidInput),
        ("folder.safetensors", CannotWrite),
        ("file/a.safetensors", CannotWrite),
        (f"{'x' * 300}.safetensors", CannotWrite),
        ("mine.safetensors", InvalidInput),
    ):
        with pytest.raises(error):
            next(train_field(replace(config, out=tmp_path / name)))
    assert (tmp_path / "mine.json").read_text() == '{"people": ["Ada"]}'
    assert len(list(tmp_path.iterdir())) == 3


def test_sets_that_are_not_there_or_show_no_object_are_refused(tmp_path):
    opaque = write_table_set(tmp_path / "table", plain_table(), train=8, test=1, size=16)
    for data in (tmp_path, opaque):
        with pytest.raises(CorruptFile, check=about(str(data))):
            run(TrainField(data, tmp_path / "a.safetensors", iterations=10))
    assert not (tmp_path / "a.safetensors").exists()


# By way of a teacher


SIZE = OSFSize(2, 16)
ALBEDO = torch.tensor([0.8, 0.5, 0.3])
WALL = 60.0  # density inside the ellipsoid [1/m]


def normals(x):
    normal = (x - torch.tensor(CENTRE, dtype=x.dtype)) / torch.tensor(HALF**2, dtype=x.dtype)
    return torch.nn.functional.normalize(normal, dim=-1)


class Ellipsoid(OSF):
    """A teacher that knows the ellipsoid of the test sets: Lambert, with a soft rim."""

    def material_at(self, x):
        depth = 1 - ((x - torch.tensor(CENTRE, dtype=x.dtype)) / torch.tensor(HALF, dtype=x.dtype)).norm(dim=-1)
        return WALL * torch.sigmoid(40 * depth), ALBEDO.expand(len(x), 3)

    def density(self, x):
        return self.material_at(x)[0]

    def forward(self, x, light, view):
        shade = torch.relu((normals(x) * light).sum(-1, keepdim=True))
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


def test_a_student_begins_with_the_teachers_density_and_albedo_and_dipoles_that_point_outward(student, teacher):
    query, kept = KiloQuery(student), student.index > 0
    x = torch.from_numpy(corners(student)[kept])
    with torch.no_grad():
        mine, right = (1 - torch.exp(-field.density(x) * student.voxel) for field in (query, teacher))
    # What is next to nothing becomes nothing, and the hull bounds all.
    assert torch.quantile((mine - right).abs(), 0.9) < 0.011
    assert (mine > 0.5).sum() > 100
    np.testing.assert_allclose(student.rows[1:, 1:4], ALBEDO.expand(len(x), 3), atol=1e-5)
    x, _, _ = surface(500, np.random.default_rng(2))
    with torch.no_grad():
        ours = torch.nn.functional.normalize(query.features(x)[:, 4:7], dim=-1)
    assert torch.quantile((ours * normals(x)).sum(-1), 0.1) > 0.9
    # The grid holds all density and drops the unseen inside.
    low, high = student.box
    assert np.all(low < CENTRE - 1.05 * HALF)
    assert np.all(high > CENTRE + 1.05 * HALF)
    inner = np.round((CENTRE - student.origin) / student.voxel).astype(int)
    assert student.density[tuple(inner)] <= FLOOR_G, "no pixel sees the centre"
    assert 0.02 < (student.index > 0).mean() < 0.7


def test_distillation_brings_the_student_to_the_teacher(student, teacher, images):
    stage = Distillation(student, teacher, torch.device("cpu"))
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
    assert after[0] < min(0.5 * before[0], 0.04)
    assert after[1] < 0.02
    assert stage.snapshot().rows[0, 0] == student.rows[0, 0], "empty space stays empty"


def test_a_perfect_student_has_no_loss(student):
    """The loss compares like with like: a field that is its own teacher is right everywhere."""
    query = KiloQuery(student)
    stage = Distillation(student, query, torch.device("cpu"))
    points, generator = surface(300, np.random.default_rng(5)), torch.Generator()
    with torch.no_grad():
        assert float(stage.loss(*points, generator)) < 1e-3
        query.ambient += 0.1
        assert float(stage.loss(*points, generator)) > 2e-3


@pytest.mark.slow
def test_a_training_by_way_of_a_teacher_goes_on_from_the_phase_it_was_in(pristine_set, tmp_path):
    config = TrainField(pristine_set, tmp_path / "egg.safetensors", iterations=60, device="cpu", recipe="distil",
                        teacher_width=32, teacher_depth=2)  # fmt: skip
    partial = config.out.with_suffix(".partial")
    steps = train_field(config, QUICK)
    for _ in steps:
        if partial.exists():  # the teacher is done
            break
    steps.close()
    share = QUICK.teacher_share
    assert all(step.progress.done >= share * 60 for step in run(config)[1:])
    assert not partial.exists()
    found = metrics(config)
    assert found["recipe"]["name"] == "distil"
    assert found["teacher"]["size"] == {"depth": 2, "width": 32}
    assert found["iterations"] == 60
    assert found["psnr_full"] > 15
    assert read_field(config.out).hidden == QUICK.hidden
