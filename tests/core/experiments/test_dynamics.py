import json
from collections import defaultdict
from dataclasses import replace

import cv2
import numpy as np
import pytest

from osfcore.dynamics.graph import PropagationNetwork
from osfcore.dynamics.rollout import PushModel
from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments import bench_rollouts as bench_dynamics
from osfcore.experiments import dynamics
from osfcore.experiments.bench_rollouts import bench_rollouts
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.objects.asset import Symmetry
from osfcore.paper.dynamics import PaperPushModel
from tests.core.paper.scenes import KAPPAS, network
from tests.support.errors import about
from tests.support.push_episodes import NAMES as PUSHED
from tests.support.push_episodes import STEPS, episode, shapes

# Evaluation


NAMES = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle", "009_gelatin_box")
NO_SYMMETRIES = defaultdict(lambda: Symmetry("none", reason="label"))


def shorten(patch):
    """Let episodes be short and of few objects."""
    patch.setattr(dynamics, "_STEPS", 34)
    patch.setattr(dynamics, "COUNTS", (2, 3))
    patch.setattr(bench_dynamics, "SEQUENCES", 10)


@pytest.fixture(scope="module")
def evaluated(library, tmp_path_factory):
    config = dynamics.EvaluateDynamics(tmp_path_factory.mktemp("dynamics"), tasks=1, seed=4, names=NAMES)
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        steps = list(dynamics.evaluate_dynamics(config, FieldLibrary(None), library))
    return config, steps


@pytest.mark.slow
def test_an_evaluation_collects_its_episodes_once(evaluated, library, monkeypatch):
    shorten(monkeypatch)
    config, steps = evaluated
    folder, report = config.folder, steps[-1].report
    assert steps[-1].done == steps[-1].total
    assert set(report["by_objects"]) == {"2", "3"}
    assert report["windows"] > 0
    assert json.loads((folder / dynamics.REPORT_FILE).read_text()) == report
    assert (folder / "dynamics.svg").exists()
    assert (folder / "trajectories.png").exists()
    files = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    assert len(files) >= 4
    again = list(dynamics.evaluate_dynamics(config, FieldLibrary(None), library))[-1].report
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == files
    assert {**again, "rollout_steps_per_s": 0} == {**report, "rollout_steps_per_s": 0}


@pytest.mark.slow
def test_the_papers_model_is_measured_on_the_same_episodes(evaluated, library, monkeypatch):
    shorten(monkeypatch)
    config, steps = evaluated
    folder, ours = config.folder, steps[-1].report
    kept = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    paper = list(dynamics.evaluate_dynamics(replace(config, method="paper"), FieldLibrary(None), library))[-1].report
    assert {name: (folder / name).stat().st_mtime_ns for name in kept} == kept  # neither episodes nor results
    assert set(paper) == set(ours)
    assert json.loads((folder / "paper" / dynamics.REPORT_FILE).read_text()) == paper
    assert (folder / "paper" / "trajectories.png").exists()
    for key in ("windows", "constant_mm_4", "analytic_mm_4"):
        assert paper[key] == ours[key]
    assert paper["median_mm_4"] != ours["median_mm_4"]
    assert (paper["unseen_objects"], paper["unseen_pairs"]["windows"]) == ([], 0)


@pytest.mark.parametrize(
    ("changes", "error", "subject"),
    [
        ({"tasks": 0}, InvalidInput, "tasks"),
        ({"method": "theirs"}, InvalidInput, "method"),
        ({"names": ("003_cracker_box", "teapot")}, UnknownName, "teapot"),
        ({"names": ("003_cracker_box", "011_banana", "024_bowl")}, MissingAssets, "011_banana"),
        ({"names": ("003_cracker_box", "005_tomato_soup_can")}, InvalidInput, "objects"),
    ],
)
def test_a_mistake_is_found_before_anything_is_written(library, tmp_path, changes, error, subject):
    with pytest.raises(error, check=about(subject)):
        next(dynamics.evaluate_dynamics(dynamics.EvaluateDynamics(tmp_path, **changes), FieldLibrary(None), library))
    assert not list(tmp_path.iterdir())


# Methods


FIELDS = FieldLibrary(None)


@pytest.fixture(scope="module")
def windows():
    return dynamics.windows_of([episode(speed=0.005, turn=0.02), episode(speed=-0.002, names=PUSHED[::-1])])


def test_windows_are_predicted_as_rollouts_from_their_starts(windows):
    found = dynamics.as_published(network(), KAPPAS, windows)
    model = PaperPushModel(network(), KAPPAS)
    assert found.positions.shape == windows.positions[:, 2:].shape
    for w, names in enumerate(windows.names):
        pose = Pose(windows.positions[w, 1], windows.quaternions[w, 1])
        state = SceneState(names, pose, Light(np.array([0.0, 0, 1])), windows.pusher[w, 1])
        alone = model.rollout(state, windows.actions[w : w + 1])
        np.testing.assert_allclose(found.positions[w, :4], alone.positions[0, 1:5], atol=1e-4)
        np.testing.assert_allclose(found.quaternions[w, :4], alone.quaternions[0, 1:5], atol=1e-3)


# Report


def scored(off_mm: float, names: tuple[str, ...] = PUSHED, *, without: bool = False) -> dynamics.Scored:
    """A predictor that is off by so much along y; the quasi-static model by twice as much."""
    windows = dynamics.windows_of([episode(speed=0.01, turn=0.02, names=names)])

    def off(mm: float) -> dynamics.Predicted:
        return dynamics.Predicted(windows.positions[:, 2:] + [0, 1e-3 * mm, 0], windows.quaternions[:, 2:])

    kinds = {"network": off(off_mm), "analytic": off(2 * off_mm), "constant": dynamics.constant(windows)}
    if without:
        kinds["without"] = off(3 * off_mm)
    found = {who: dynamics.errors(windows, predicted, NO_SYMMETRIES) for who, predicted in kinds.items()}
    return dynamics.Scored(windows, kinds["network"], found)


def report(**changes: object) -> dynamics.DynamicsReport:
    three = (*PUSHED, "004_sugar_box")
    sets = {"directed 2": scored(1.0), "paper 2": scored(1.0)}
    sets |= {"directed 3": scored(2.0, three), "paper 3": scored(4.0, three)}
    given = {"by_set": sets, "unseen": None, "unseen_names": (), "rollout_steps_per_s": 1e4}
    return dynamics.DynamicsReport(**(given | changes))


def test_figures_are_those_of_three_objects_that_moved():
    found = dynamics.report_json(report())
    assert found == json.loads(json.dumps(found, allow_nan=False))
    assert found["windows"] == 4  # one moved object in two windows of each policy
    assert found["median_mm_4"] == pytest.approx(3.0)  # half of them 2, half 4
    assert found["median_deg_4"] == pytest.approx(0, abs=1e-3)
    assert found["analytic_mm_4"] == pytest.approx(6.0)
    assert found["constant_mm_10"] == pytest.approx(100, rel=1e-3)
    assert found["still_drift_mm_30"] == pytest.approx(3.0)
    assert {count: row["median_mm_4"] for count, row in found["by_objects"].items()} == pytest.approx({"2": 1, "3": 3})
    assert found["by_policy"]["paper"]["median_mm_4"] == pytest.approx(4.0)
    assert found["by_name"]["005_tomato_soup_can"]["windows"] == 4
    assert found["by_name"]["009_gelatin_box"]["median_mm_4"] is None  # never moved


def test_objects_never_seen_are_scored_by_both_networks():
    found = dynamics.report_json(report(unseen=scored(1.0, without=True), unseen_names=PUSHED[:1]))
    assert found["unseen_objects"] == [PUSHED[0]]
    assert found["unseen_objects_mm_4"] == pytest.approx(3.0)
    assert found["seen_objects_mm_4"] == pytest.approx(1.0)
    nothing = dynamics.report_json(report(unseen=scored(1.0, without=True), unseen_names=PUSHED[1:]))
    assert nothing["unseen_objects_windows"] == 0
    assert dynamics.report_json(report())["unseen_objects_mm_4"] is None


def test_pairs_that_never_meet_in_training_are_scored_apart():
    pair = ("005_tomato_soup_can", "010_potted_meat_can")
    sets = {"directed 3": scored(1.0), "paper 3": scored(5.0, pair)}
    found = dynamics.report_json(report(by_set=sets))["unseen_pairs"]
    assert found == {"windows": 2, "median_mm_4": pytest.approx(5.0), "constant_mm_4": pytest.approx(40, rel=1e-3)}
    none = dynamics.report_json(report(by_set=sets, holds_out_pairs=False))["unseen_pairs"]
    assert none == {"windows": 0, "median_mm_4": None, "constant_mm_4": None}


# Plots


def test_curves_and_trajectories_are_drawn(tmp_path):
    two = report(by_set={"directed 3": scored(30.0), "paper 3": scored(1.0)})
    dynamics.write_plots(tmp_path, two)
    dynamics.write_gallery(tmp_path, two, shapes())
    curves, cells = (tmp_path / "dynamics.svg").read_text(), cv2.imread(str(tmp_path / "trajectories.png"))
    assert curves.count("median position error [mm]</text>") == 2
    assert curves.count("median rotation error [deg]</text>") == 1
    colours = (40, 39, 214), (44, 160, 44)
    red, green = ((np.abs(cells.astype(int) - colour) < 30).all(axis=-1).sum() for colour in colours)
    assert red > 200  # predicted
    assert green > 200  # true


# Scores


def test_windows_hold_the_step_before_their_start_and_all_that_follows():
    windows = dynamics.windows_of([episode(speed=0.01)])
    assert len(windows.names) == (STEPS - dynamics.LONGEST) // 4 + 1
    np.testing.assert_array_equal(windows.positions[0, 0], windows.positions[0, 1])  # nothing is known before
    np.testing.assert_allclose(np.diff(windows.positions[1, :, 0, 0]), 0.01, atol=1e-12)
    assert (windows.on_table == dynamics.LONGEST).all()


def test_what_leaves_the_table_is_not_scored():
    windows = dynamics.windows_of([episode(speed=0.04)])
    reached = -0.1 + 0.04 * np.arange(STEPS + 1)
    assert windows.on_table[0] == np.flatnonzero(reached >= 0.55)[0] - 1
    found = dynamics.errors(windows, dynamics.constant(windows), NO_SYMMETRIES)
    assert found.valid[dynamics.HORIZONS.index(4)].all()
    assert not found.valid[-1].any()


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_the_constant_pose_errs_by_the_whole_way(turn):
    windows = dynamics.windows_of([episode(speed=0.01, turn=turn)])
    found = dynamics.errors(windows, dynamics.constant(windows), NO_SYMMETRIES)
    for number, horizon in enumerate(dynamics.HORIZONS):
        np.testing.assert_allclose(found.mm[number, :, 0], 10 * horizon, rtol=1e-9)
        np.testing.assert_allclose(found.deg[number, :, 0], np.rad2deg(turn * horizon), atol=1e-6)
    np.testing.assert_allclose(found.of_moved(4), 40)
    np.testing.assert_allclose(found.of_moved(4, deg=True), np.rad2deg(4 * turn), atol=1e-6)
    assert len(found.of_moved(4, among=np.array([[False, True]]))) == 0
    assert (found.of_still(4) == 0).all()  # the second object


def test_moved_is_ten_millimetres_or_five_degrees():
    few, turned = (
        dynamics.errors(w := dynamics.windows_of([moved]), dynamics.constant(w), NO_SYMMETRIES)
        for moved in (episode(speed=0.002), episode(turn=np.deg2rad(1.3)))
    )
    assert not few.moved[dynamics.HORIZONS.index(4)].any()
    assert few.moved[dynamics.HORIZONS.index(6), :, 0].all()
    assert turned.moved[dynamics.HORIZONS.index(4), :, 0].all()
    assert not turned.moved[dynamics.HORIZONS.index(3)].any()
    assert not turned.moved[:, :, 1].any()


def test_the_truth_has_no_error_and_symmetric_turns_are_none():
    windows = dynamics.windows_of([episode(speed=0.01, turn=0.02)])
    truth = dynamics.Predicted(windows.positions[:, 2:], windows.quaternions[:, 2:])
    found = dynamics.errors(windows, truth, NO_SYMMETRIES)
    assert found.mm.max() < 1e-9
    assert found.deg.max() < 1e-5
    round_can = NO_SYMMETRIES | {PUSHED[0]: Symmetry("continuous", axis=(0.0, 0.0, 1.0), reason="plain")}
    assert dynamics.errors(windows, dynamics.constant(windows), round_can).deg.max() < 1e-5
    brick = NO_SYMMETRIES | {PUSHED[0]: Symmetry("discrete", ((0.0, 0.0, 0.0, 1.0),), reason="plain")}
    half_turned = dynamics.Predicted(truth.positions, truth.quaternions.copy())
    half_turned.quaternions[:] = quaternion_exp(np.array([0, 0, np.pi]))
    still = dynamics.windows_of([episode(speed=0.01)])
    assert dynamics.errors(still, half_turned, brick).deg[:, :, 0].max() < 1e-5
    assert dynamics.errors(still, half_turned, NO_SYMMETRIES).deg[:, :, 0].min() > 179


def test_predictors_leave_alone_what_nothing_touches():
    windows = dynamics.windows_of([episode()])
    network = PropagationNetwork(8, 1)
    for predicted in (dynamics.learned(network, shapes(), windows), dynamics.analytic(shapes(), windows)):
        assert predicted.positions.shape == (len(windows.names), dynamics.LONGEST, 2, 3)
        np.testing.assert_allclose(predicted.positions, windows.positions[:, 2:], atol=1e-6)
        np.testing.assert_allclose(predicted.quaternions, windows.quaternions[:, 2:], atol=1e-6)


# Benchmark


def test_rollouts_are_timed_in_a_scene_where_most_paths_meet_something(monkeypatch):
    monkeypatch.setattr(bench_dynamics, "SEQUENCES", 40)
    costs = bench_rollouts(PushModel(PropagationNetwork(8, 1), shapes()), shapes())
    assert costs.rollout_steps_per_s == pytest.approx(400 / costs.rollout_s)
    assert costs.touched_share > 0.3
