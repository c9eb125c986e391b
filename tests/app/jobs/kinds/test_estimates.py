import json
from dataclasses import replace

import numpy as np
import pytest

from app.jobs.context import JobContext
from app.jobs.job import INPUTS
from app.jobs.kinds.estimates import (
    STATE,
    STEPS,
    EstimateParams,
    Source,
    estimate_job,
    load_models,
    read_steps,
    state_of_step,
)
from osfcore.errors import CannotWrite, CorruptFile, UnknownName
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.io.observation_file import write_observation
from osfcore.io.scene_file import read_estimated, write_estimated
from osfcore.progress import Progress
from osfcore.random_streams import Stream, stream_rng
from tests.support.errors import about

MUSTARD = "006_mustard_bottle"
FIRST = EstimateParams(mode="first", seed=5, of=Source(scene=None), names=(MUSTARD,), cameras=("0",))


def state(x=0.1) -> SceneState:
    pose = Pose(np.array([[x, 0, 0.1]]), np.array([[1.0, 0, 0, 0]]))
    return SceneState((MUSTARD,), pose, Light(np.array([0.5, 0, 1])), None)


def believed(of: SceneState) -> EstimatedState:
    return EstimatedState(of, np.array([0.001]), np.array([np.inf]), 0.02, ("",), "")


@pytest.fixture
def place(tmp_path):
    """A job's folder with an observation of nothing."""
    cameras = default_cameras(16)
    seen = Observation(
        cameras, np.full((4, 16, 16, 3), 0.5), (MUSTARD,), np.ones((4, 1, 16, 16), bool), np.array([0.2, 0, 0.06]), 0.0
    )
    write_observation(tmp_path / "job" / INPUTS / "observation", seen)
    return JobContext(tmp_path, tmp_path / "job")


@pytest.fixture
def asked(monkeypatch):
    """Estimators that take three steps and keep what they were given."""
    asked = {}

    def steps(models, observation, *others, **_):
        asked.update(observation=observation, others=others)
        yield EstimateStep(Progress(1, 3, "Looking"), "orientations", state(0.3), losses=(0.5,))
        yield EstimateStep(Progress(2, 3, "Both"), "together", state(0.2), loss=0.25)
        yield EstimateStep(Progress(3, 3, "Done"), "done", state(), None, None, 1.0, (0.1,), 0.1, believed(state()))

    monkeypatch.setattr("osfcore.estimation.goal_image.estimate_goal", steps)
    for name in ("estimate_first", "estimate_next"):
        monkeypatch.setattr(f"osfcore.control.estimators.{name}", steps)
    return asked


def test_all_steps_are_told_and_kept_and_the_result_is_a_state_file(place, asked):
    loading, *told = estimate_job(FIRST, place)
    assert (loading.step, loading.stage, loading.view) == (0, None, None)
    assert [step.step for step in told] == [1, 2, 3]
    assert [step.losses for step in told] == [(0.5,), (), (0.1,)]
    assert [step.loss for step in told] == [None, 0.25, 0.1]  # JSON has no NaN
    assert [step.trusted for step in told] == [None, None, True]
    assert told[1].view.state.poses.position[0, 0] == 0.2
    kept = read_steps(place.folder / STEPS)
    assert [(k["step"], k["stage"], k["note"], k["loss"]) for k in kept] == [
        (t.step, t.stage, t.note, t.loss) for t in told
    ]
    np.testing.assert_allclose([state_of_step(k).poses.position[0, 0] for k in kept], [0.3, 0.2, 0.1], atol=1e-12)
    found = read_estimated(place.folder / STATE)
    np.testing.assert_allclose(found.state.poses.position, state().poses.position, atol=1e-12)
    assert not np.isfinite(found.rotation_std[0])


def test_steps_are_kept_while_the_work_goes_on(place, asked):
    steps = estimate_job(FIRST, place)
    next(steps)
    assert read_steps(place.folder / STEPS) == ()
    next(steps)
    assert len(read_steps(place.folder / STEPS)) == 1
    assert not (place.folder / STATE).exists()


def test_the_estimator_gets_the_observation_and_the_prior_but_never_the_truth(place, asked):
    inputs = place.folder / INPUTS
    (inputs / "truth.json").write_text("whoever reads this fails")
    list(estimate_job(FIRST, place))
    assert asked["observation"].names == (MUSTARD,)
    np.testing.assert_allclose(asked["observation"].pusher, [0.2, 0, 0.06], atol=1e-12)
    assert asked["others"][0].random() == stream_rng(5, Stream.FIRST_FRAME).random()
    write_estimated(inputs / "prior.json", believed(state(0.07)))
    for mode, count in (("next", 3), ("goal", 1)):
        list(estimate_job(FIRST.model_copy(update={"mode": mode}), place))
        assert asked["others"][0].poses.position[0, 0] == 0.07
        assert len(asked["others"]) == count


def test_missing_inputs_and_fields_are_told(place, asked):
    with pytest.raises(CorruptFile, check=about("prior.json")):
        list(estimate_job(FIRST.model_copy(update={"mode": "next"}), place))
    with pytest.raises(UnknownName, check=about("spoon")):
        load_models(place.data_dir, ("spoon",))
    with pytest.raises(CorruptFile):
        list(estimate_job(FIRST, replace(place, folder=place.data_dir)))
    (place.folder / STEPS).mkdir()
    with pytest.raises(CannotWrite, check=about(STEPS)):
        list(estimate_job(FIRST, place))


def test_a_step_in_the_making_is_left_out_and_a_damaged_list_is_told(tmp_path):
    path = tmp_path / STEPS
    assert read_steps(path) == ()
    path.write_text(json.dumps({"step": 1}) + '\n{"step": 2, "no')
    assert read_steps(path) == ({"step": 1},)
    path.write_text('{"step": 1\n')
    with pytest.raises(CorruptFile):
        read_steps(path)
