import numpy as np
import pytest

from osfcore.dynamics.motion import SUBSTEPS, pusher_path
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.paper.dynamics import WEIGHTS_FILE, GraphNetwork, PaperPushModel, load_paper_push_model, write_network
from tests.core.paper.dynamics.scenes import BOX, CAN, KAPPAS, NAMES, network, state

KNOWN = {**KAPPAS, "teapot": 0.2}


@pytest.fixture(scope="module")
def model():
    return PaperPushModel(network(), KNOWN)


def plans(count: int, horizon: int = 4, seed: int = 0) -> np.ndarray:
    velocity = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, horizon, 2))
    return np.concatenate([velocity, np.zeros((count, horizon, 1))], axis=2)


def test_shapes_and_beginnings(model):
    begin, actions = state(), plans(5)
    found = model.rollout(begin, actions)
    assert (found.names, model.names) == (NAMES, tuple(sorted(KNOWN)))
    assert found.positions.shape == (5, 5, 2, 3)
    assert found.quaternions.shape == (5, 5, 2, 4)
    np.testing.assert_array_equal(found.positions[:, 0], np.stack([begin.poses.position] * 5))
    np.testing.assert_array_equal(found.quaternions[:, 0], np.stack([begin.poses.quaternion] * 5))
    np.testing.assert_allclose(np.linalg.norm(found.quaternions, axis=-1), 1, atol=1e-9)
    path = pusher_path(begin.pusher[:2], actions[..., :2])[:, ::SUBSTEPS]
    np.testing.assert_array_equal(found.pusher[..., :2], path)
    np.testing.assert_array_equal(found.pusher[..., 2], np.full((5, 5), begin.pusher[2]))


def test_the_order_of_objects_never_matters(model):
    begin = state(names=(CAN, BOX, "teapot"))
    names = ("teapot", CAN, BOX)
    here, there = (model.rollout(s, plans(3)) for s in (begin, begin.reordered(names)))
    assert there.names == names
    np.testing.assert_array_equal(there.positions, here.positions[:, :, [2, 0, 1]])
    np.testing.assert_array_equal(there.quaternions, here.quaternions[:, :, [2, 0, 1]])


def test_sequences_do_not_depend_on_their_neighbours(model):
    actions = plans(600, 2)
    many = model.rollout(state(), actions)
    for k in (0, 511, 512, 599):
        alone = model.rollout(state(), actions[k : k + 1])
        np.testing.assert_allclose(alone.positions[0], many.positions[k], atol=1e-6)
        np.testing.assert_allclose(alone.quaternions[0], many.quaternions[k], atol=1e-6)


def test_what_the_pusher_does_far_away_is_not_felt(model):
    begin = state(pusher=(-0.34, -0.34))
    still = model.rollout(begin, np.zeros((1, 1, 3)))
    pushed = model.rollout(begin, np.array([[[-0.3, -0.3, 0.0]]]))
    np.testing.assert_array_equal(pushed.positions, still.positions)
    near = model.rollout(state(), np.array([[[-0.3, -0.3, 0.0]]]))
    assert (near.positions != model.rollout(state(), np.zeros((1, 1, 3))).positions).any()


def test_a_network_that_has_learned_nothing_predicts_that_nothing_moves():
    begin = state()
    found = PaperPushModel(GraphNetwork(NAMES, 8), KAPPAS).rollout(begin, plans(2))
    np.testing.assert_allclose(found.positions, np.broadcast_to(begin.poses.position, found.positions.shape), atol=1e-7)


def test_what_was_before_plays_no_part(model):
    begin = state()
    before = SceneState(begin.names, Pose(begin.poses.position - 0.03, begin.poses.quaternion), begin.light, None)
    np.testing.assert_array_equal(
        model.rollout(begin, plans(2), before).positions, model.rollout(begin, plans(2)).positions
    )


def test_objects_that_the_network_never_met_are_predicted(model):
    begin = state(names=("teapot", CAN))
    assert np.isfinite(model.rollout(begin, plans(2)).positions).all()


def test_the_shipped_model_moves_what_is_pushed_more_than_what_is_not():
    shipped = load_paper_push_model(None, FieldLibrary(None), NAMES)
    begin = state()
    toward = np.array([[[0.3, 0.0, 0.0]] * 2])
    pushed, left = (shipped.rollout(begin, actions).positions for actions in (toward, 0 * toward))
    assert pushed[0, -1, 0, 0] - left[0, -1, 0, 0] > 0.01
    assert np.linalg.norm(left[0, -1] - left[0, 0], axis=-1).max() < 0.02


def test_mistakes_are_told(model):
    with pytest.raises(InvalidInput, match="number of objects is 0"):
        model.rollout(state(names=()), plans(1))
    with pytest.raises(UnknownName, match="kettle"):
        model.rollout(state(names=(CAN, "kettle")), plans(1))
    unseen = SceneState(NAMES, state().poses, state().light, None)
    with pytest.raises(InvalidInput, match="pusher of the state"):
        model.rollout(unseen, plans(1))
    with pytest.raises(InvalidInput, match=r"0\.3"):
        model.rollout(state(), np.full((1, 1, 3), [0.31, 0, 0]))
    with pytest.raises(InvalidInput, match="number of objects is 0"):
        PaperPushModel(network(), {})


def test_a_model_is_loaded_for_the_objects_asked_for(tmp_path):
    own = tmp_path / "dynamics" / WEIGHTS_FILE
    write_network(own, network())
    model = load_paper_push_model(tmp_path, FieldLibrary(None), [BOX, CAN])
    assert model.names == (CAN, BOX)
    assert model.rollout(state(), plans(1)).positions.shape == (1, 5, 2, 3)
    with pytest.raises(UnknownName, match="teapot"):
        load_paper_push_model(tmp_path, FieldLibrary(None), ["teapot"])
    own.write_bytes(b"broken")
    with pytest.raises(CorruptFile, match=WEIGHTS_FILE):
        load_paper_push_model(tmp_path, FieldLibrary(None), [CAN])
