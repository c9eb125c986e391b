import json

import numpy as np
import pytest
import torch

from osfcore.fields.kiloosf import FLOOR_G, read_field
from osfcore.fields.kiloosf_query import KiloQuery, Scatter
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import RaySource, first_shell
from osfcore.fields.train_kiloosf import Distillation, Recipe, TrainField, first_student, train_field
from osfcore.fields.train_osf import Checkpoint, corners, read_checkpoint, write_checkpoint
from osfcore.fields.visual_hull import silhouette_box
from tests.core.fields.sets import CENTRE, HALF

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


pytestmark = pytest.mark.usefixtures("one_thread")


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


def test_a_student_begins_with_the_teachers_density_and_albedo(student, teacher):
    query, kept = KiloQuery(student), student.index > 0
    x = torch.from_numpy(corners(student)[kept])
    with torch.no_grad():
        mine, right = (1 - torch.exp(-field.density(x) * student.voxel) for field in (query, teacher))
    # What is next to nothing becomes nothing, and the hull bounds all.
    assert torch.quantile((mine - right).abs(), 0.9) < 0.011
    assert (mine > 0.5).sum() > 100
    np.testing.assert_allclose(student.rows[1:, 1:4], ALBEDO.expand(len(x), 3), atol=1e-5)


def test_dipoles_point_out_of_the_surface(student):
    x, _, view = surface(500, np.random.default_rng(2))
    with torch.no_grad():
        normals = torch.nn.functional.normalize(KiloQuery(student).features(x)[:, 4:7], dim=-1)
    right = torch.nn.functional.normalize(
        (x - torch.tensor(CENTRE, dtype=x.dtype)) / torch.tensor(HALF**2, dtype=x.dtype), dim=-1
    )
    assert torch.quantile((normals * right).sum(-1), 0.1) > 0.9
    assert len(view) == 500


def test_the_grid_holds_all_density_and_drops_the_unseen_inside(student):
    low, high = student.box
    reach = 1.05 * HALF
    assert np.all(low < CENTRE - reach)
    assert np.all(high > CENTRE + reach)
    inner = np.round((CENTRE - student.origin) / student.voxel).astype(int)
    assert student.density[tuple(inner)] <= FLOOR_G, "no pixel sees the centre"
    assert 0.02 < (student.index > 0).mean() < 0.7


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
def run(pristine_set, tmp_path_factory):
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


def test_the_papers_way_leads_to_a_field(run):
    out, _, _ = run
    metrics = json.loads(out.with_suffix(".json").read_text())
    assert metrics["recipe"]["name"] == "distil"
    assert metrics["teacher"]["size"] == {"depth": 2, "width": 32}
    assert metrics["iterations"] == 60
    assert metrics["psnr_full"] > 15
    assert read_field(out).hidden == TINY.hidden


def test_a_killed_training_goes_on_from_the_phase_it_was_in(run):
    out, kept, notes = run
    assert kept
    assert not out.with_suffix(".partial").exists()
    after = notes[notes.index("killed") :]
    assert "Going on from a checkpoint" in after
    assert not any("Carving" in note or "Baking" in note for note in after)
