import numpy as np
import pytest

import osfcore.control.episode as core
from app.episode.job import Episoding, episode_job, settings_of
from app.job import INPUTS
from app.job_process import Place
from osfcore.control.events import Acted, Stepped
from osfcore.errors import InvalidInput
from osfcore.evaluate.images import as_bytes, write_png
from osfcore.poses import Pose
from osfcore.progress import Progress
from osfcore.scene import Light, SceneState, goal_camera
from tests.app.episode.test_remote import NAMES, Stage, stage  # noqa: F401  a fixture
from tests.core.control.scenes import sure

SMALL = {"steps": 3, "plan": {"samples": 16, "horizon": 6}}


class Told:
    """Orders of a service that changes its mind after some actions."""

    def __init__(self, stage: Stage) -> None:  # noqa: F811
        self.ask, self.told = stage, []

    def changes(self):
        told, self.told = self.told, []
        return told


@pytest.fixture
def place(data_dir, tmp_path, stage):  # noqa: F811
    folder = tmp_path / "job"
    folder.mkdir()
    return Place(data_dir, folder, Told(stage))


@pytest.fixture
def sighted(monkeypatch, stage):  # noqa: F811
    """Estimators that are told the truth: what they find is measured elsewhere."""

    def found(*_, **__):
        state = stage.world.truth()
        yield core.EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=sure(state))

    for name in ("estimate_first", "estimate_next"):
        monkeypatch.setattr(core, name, found)
    monkeypatch.setattr(core, "usual_residuals", lambda *_: np.zeros(len(NAMES)))


def params(stage, shift=0.06, settings=SMALL):  # noqa: F811
    state = stage.world.truth()
    poses = []
    for n, name in enumerate(state.names):
        position = state.poses.position[n] - [shift if n == 1 else 0.0, 0.0, 0.0]
        poses.append({"name": name, "position": position.tolist(), "quaternion": state.poses.quaternion[n].tolist()})
    return {"scene": "s1", "names": list(state.names), "seed": 0, "settings": settings, "goal": {"poses": poses}}


def test_an_episode_pushes_what_is_on_the_scene_and_leaves_its_files(place, stage, sighted):  # noqa: F811
    before = stage.world.truth()
    *steps, last = list(episode_job(params(stage), place))
    assert all(isinstance(step, Episoding) for step in steps)
    assert [step.seen.number for step in steps if isinstance(step.seen, Acted)] == [1, 2, 3]
    assert sum(step.ends_round for step in steps) == 4
    assert stage.world.time_s == pytest.approx(0.6)
    assert not np.array_equal(stage.world.truth().pusher, before.pusher)
    assert last.report["steps_done"] == 3
    files = {path.name for path in place.folder.iterdir()}
    assert {"report.json", "steps.csv", "goal.png", "video.mp4", "episode.viser", "frames"} <= files


def test_settings_may_change_on_the_way(place, stage, sighted):  # noqa: F811
    acted = 0
    for step in episode_job(params(stage), place):
        acted += isinstance(step.seen, Acted)
        if acted == 1:
            place.orders.told = [{"settings": {**SMALL, "steps": 2}}]
    assert acted == 2
    assert step.total == 2


def test_a_goal_image_is_read_from_the_inputs(place, stage, sighted, monkeypatch):  # noqa: F811
    camera = goal_camera(64)
    image = stage.world.render((camera,), with_pusher=False).images[0]
    write_png(place.folder / INPUTS / "goal.png", as_bytes(image))

    def explained(_models, observation, _prior):
        np.testing.assert_allclose(observation.images[0], image, atol=1 / 255)
        state = stage.world.truth()
        yield core.EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=sure(state))

    monkeypatch.setattr(core, "estimate_goal", explained)
    monkeypatch.setattr(core, "unmoved", lambda _models, _goal, found, _now: found)
    *_, last = list(episode_job({**params(stage), "goal": {"poses": None}}, place))
    assert last.report["outcome"] == "reached"
    assert stage.world.time_s == 0


def test_settings_in_json_are_checked_like_any(stage):  # noqa: F811
    assert settings_of({}).steps == 30
    assert settings_of(SMALL).plan.samples == 16
    with pytest.raises(InvalidInput, match="horizon"):
        settings_of({"plan": {"horizon": 0}})


def test_rounds_end_where_a_step_of_the_loop_does():
    state = sure(SceneState((), Pose(np.zeros((0, 3)), np.zeros((0, 4))), Light(np.array([0.0, 0, 1])), None))
    image = np.zeros((16, 16, 3))
    stepped = Stepped(1, 3, state, np.zeros(0), np.zeros(0), 0.0, image, {})
    assert Episoding(1, 3, "Looking", seen=stepped).ends_round
    assert not Episoding(1, 3, "Pushing", seen=Acted(1, np.zeros(3))).ends_round
    assert not Episoding(0, 3, "Loading").ends_round
