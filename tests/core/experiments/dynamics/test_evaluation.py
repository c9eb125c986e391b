import json
from dataclasses import replace

import pytest

from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments import bench_rollouts as bench_dynamics
from osfcore.experiments import dynamics
from osfcore.experiments.dynamics import REPORT_FILE, EvaluateDynamics, evaluate_dynamics
from osfcore.fields.field_library import FieldLibrary

NAMES = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "009_gelatin_box")


@pytest.fixture(scope="module")
def evaluated(library, tmp_path_factory):
    """Short episodes of few objects, with our predictions of them."""
    config = EvaluateDynamics(tmp_path_factory.mktemp("dynamics"), tasks=1, seed=4, names=NAMES)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dynamics, "_STEPS", 34)
        patch.setattr(dynamics, "COUNTS", (2, 3))
        patch.setattr(bench_dynamics, "SEQUENCES", 10)
        yield config, list(evaluate_dynamics(config, FieldLibrary(None), library))


@pytest.mark.slow
def test_an_evaluation_collects_once_and_tells_everything(evaluated, library):
    config, steps = evaluated
    folder, report = config.folder, steps[-1].report
    assert report is not None
    assert (steps[-1].done, steps[-1].total) == (steps[-1].total, steps[-1].total)
    assert set(report["by_objects"]) == {"2", "3"}
    assert report["windows"] > 0
    assert report["rollout_steps_per_s"] > 0
    assert json.loads((folder / REPORT_FILE).read_text()) == report
    for name in ("dynamics.png", "trajectories.png"):
        assert (folder / name).exists()
    files = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    assert len(files) >= 4
    again = list(evaluate_dynamics(config, FieldLibrary(None), library))[-1].report
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == files
    assert again is not None
    assert {**again, "rollout_steps_per_s": 0} == {**report, "rollout_steps_per_s": 0}


@pytest.mark.slow
def test_the_papers_model_is_measured_on_the_same_episodes(evaluated, library):
    config, steps = evaluated
    folder, ours = config.folder, steps[-1].report
    kept = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    paper = list(evaluate_dynamics(replace(config, method="paper"), FieldLibrary(None), library))[-1].report
    assert {name: (folder / name).stat().st_mtime_ns for name in kept} == kept  # neither episodes nor results
    assert ours is not None
    assert paper is not None
    assert set(paper) == set(ours)
    assert json.loads((folder / "paper" / REPORT_FILE).read_text()) == paper
    for name in ("dynamics.png", "trajectories.png"):
        assert (folder / "paper" / name).exists()
    for key in ("windows", "constant_mm_4", "analytic_mm_4"):
        assert paper[key] == ours[key]
    assert paper["median_mm_4"] != ours["median_mm_4"]
    assert (paper["unseen_objects"], paper["unseen_pairs"]["windows"]) == ([], 0)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"tasks": 0}, InvalidInput, "number of tasks"),
        ({"seed": -1}, InvalidInput, "seed"),
        ({"method": "theirs"}, InvalidInput, "method"),
        ({"names": ("003_cracker_box", "teapot")}, UnknownName, "teapot"),
        ({"names": ("003_cracker_box", "011_banana", "024_bowl")}, MissingAssets, "011_banana"),
        ({"names": ("003_cracker_box", "005_tomato_soup_can")}, InvalidInput, "at least 3"),
    ],
)
def test_a_mistake_is_one_sentence(library, tmp_path, changes, error, words):
    with pytest.raises(error, match=words):
        next(evaluate_dynamics(EvaluateDynamics(tmp_path, **changes), FieldLibrary(None), library))
    assert not list(tmp_path.iterdir())
