import shutil

import numpy as np
import pytest

from app.processes.messages.neural_messages import DrawView, Predicted, PredictPushes
from app.processes.predict_process import PushPredictor
from osfcore.dynamics import rollout
from osfcore.dynamics.rollout import PushModel
from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from tests.app.processes.conftest import BOX, SIZE_M
from tests.app.processes.fields import write_box
from tests.support.errors import about

TOWARD = np.tile([0.3, 0.0, 0.0], (1, 6, 1))  # the pusher of `state` passes the box, whose half is 3 cm, at 12 cm


@pytest.fixture(scope="module")
def oracle(fields_dir):
    return PushPredictor(fields_dir)


def beside(state):
    """The same with the pusher in line with the box."""
    return SceneState(state.names, state.poses, state.light, np.array([-0.1, -0.02, state.pusher[2]]))


def test_a_push_moves_what_is_in_its_way_and_nothing_else(oracle, state):
    missed = oracle.answer(PredictPushes("a", state, TOWARD))
    assert isinstance(missed, Predicted)
    np.testing.assert_array_equal(missed.rollouts.positions, np.tile(state.poses.position, (1, 7, 1, 1)))
    hit = oracle.answer(PredictPushes("a", beside(state), TOWARD))
    assert hit.rollouts.positions[0, -1, 0, 0] > state.poses.position[0, 0] + 0.05
    assert hit.took_s > 0


def test_what_nobody_waits_for_is_left_out(oracle, state):
    assert oracle.answer(PredictPushes("a", state, TOWARD), lambda: True) is None


def test_refusals(oracle, state):
    with pytest.raises(UnknownName, check=about("teapot")):
        oracle.answer(PredictPushes("a", SceneState(("teapot",), state.poses, state.light, state.pusher), TOWARD))
    with pytest.raises(InvalidInput, check=about("action 0 of sequence 0")):
        oracle.answer(PredictPushes("a", state, 2 * TOWARD))
    with pytest.raises(TypeError):
        oracle.answer(DrawView("a", state, goal_camera(16), is_sharp=False))


def test_what_is_not_finite_is_not_told(oracle, state, monkeypatch):
    def wild(_model, state, _actions, _before):
        return Rollouts(state.names, np.full((1, 7, 1, 3), np.nan), np.zeros((1, 7, 1, 4)), np.zeros((1, 7, 3)))

    monkeypatch.setattr(PushModel, "rollout", wild)
    with pytest.raises(OsfError, match="out of all bounds"):
        oracle.answer(PredictPushes("a", state, TOWARD))


def test_models_are_kept_until_a_field_changes_and_order_does_not_matter(fields_dir, state, tmp_path, monkeypatch):
    loads, real = [], rollout.load_push_model
    monkeypatch.setattr(rollout, "load_push_model", lambda *args: (loads.append(args), real(*args))[1])
    shutil.copytree(fields_dir, tmp_path / "own")
    other = "006_mustard_bottle"
    write_box(tmp_path / "own", other, SIZE_M, (0.1, 0.1, 0.1))
    oracle = PushPredictor(tmp_path / "own")
    poses = Pose(np.array([[0.05, -0.02, 0.04], [0.05, 0.2, 0.04]]), np.tile([1.0, 0, 0, 0], (2, 1)))
    both = beside(SceneState((BOX, other), poses, state.light, state.pusher))
    swapped = SceneState((other, BOX), poses[::-1], state.light, both.pusher)
    for asked in (both, swapped):
        assert oracle.answer(PredictPushes("a", asked, TOWARD)).rollouts.names == asked.names
    assert len(loads) == 1
    write_box(tmp_path / "own", BOX, 2 * SIZE_M, (0.1, 0.1, 0.1))
    oracle.answer(PredictPushes("a", both, TOWARD))
    assert len(loads) == 2
    (tmp_path / "own" / "dynamics").mkdir(exist_ok=True)
    (tmp_path / "own" / "dynamics" / "pushes.safetensors").write_bytes(b"broken")
    with pytest.raises(CorruptFile):
        oracle.answer(PredictPushes("a", both, TOWARD))
