import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.fields.train_osf import FieldSettings, Pace, Rates, TeacherRecipe
from osfcore.paper.fields import read_field
from osfcore.paper.train_fields import PaperFieldRecipe, train_paper_field
from tests.support.rendered_sets import painted_block, write_object_set

pytestmark = pytest.mark.usefixtures("one_thread")
QUICK = PaperFieldRecipe(
    TeacherRecipe(across=20, rays=256, rebake=20, rates=Rates(1e-2, 3e-3)), across=2, width=16, rays=256,
    rates=Rates(1e-2, 2e-3),
)  # fmt: skip


@pytest.fixture(scope="module")
def block_set(tmp_path_factory):
    return write_object_set(tmp_path_factory.mktemp("sets") / "block", painted_block())


def config_in(folder, data, iterations=240, **kwargs):
    return FieldSettings(data, folder / "a.safetensors", iterations=iterations, device="cpu", teacher_width=32,
                           teacher_depth=2, **kwargs)  # fmt: skip


def test_teacher_distillation_and_fine_tuning_learn_a_block(block_set, tmp_path):
    config = config_in(tmp_path, block_set)
    last = list(train_paper_field(config, QUICK))[-1]
    metrics = json.loads(config.out.with_suffix(".json").read_text())
    assert last.psnr_full > 20
    assert metrics["psnr_full"] == pytest.approx(last.psnr_full, abs=1e-3)
    assert (metrics["iterations"], metrics["recipe"]["name"]) == (240, "paper")
    assert metrics["bytes"] == config.out.stat().st_size < 2_000_000
    assert last.progress.done == last.progress.total == 240
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.safetensors"]
    size = np.ptp(read_field(config.out).extent, axis=0)
    np.testing.assert_allclose(size, np.ptp(painted_block().extent, axis=0), atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("kept", ["teacher", "distil", "fine"])
def test_a_killed_training_goes_on_where_it_was(block_set, tmp_path, kept):
    """A run that is left within a phase and begun again ends with the weights of an unbroken one."""
    whole, parted = tmp_path / "whole", tmp_path / "parted"
    recipe = replace(QUICK, teacher_share=0.4, distil_share=0.2)
    list(train_paper_field(config_in(whole, block_set, 50), recipe))
    config = config_in(parted, block_set, 50)
    begin = {"teacher": 0, "distil": 20, "fine": 30}[kept]
    steps = train_paper_field(config, recipe, Pace(0.0, 0.0))
    for step in steps:
        if step.progress.done > begin + 3:
            break
    steps.close()
    assert config.out.with_suffix(".partial").exists()
    resumed = list(train_paper_field(config, recipe))
    assert begin < resumed[1].progress.done < 50
    ends = [read_field(folder / "a.safetensors").networks for folder in (whole, parted)]
    np.testing.assert_allclose(ends[0], ends[1], atol=0.05)


def test_settings_out_of_range_are_refused(block_set, tmp_path):
    for change in ({"minutes": 0.0}, {"iterations": 3}, {"teacher_depth": 1}, {"seed": -1}):
        with pytest.raises(InvalidInput):
            next(train_paper_field(replace(config_in(tmp_path, block_set), **change)))
