"""Rollout: rollout, push models."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

import osfcore.dynamics.rollout as module
from osfcore.dynamics.graph import shipped, write_network
from osfcore.dynamics.motion import SUBSTEPS, pusher_path
from osfcore.dynamics.rollout import NETWORK_FILE, PushModel, load_push_model, load_shapes, network_path
from osfcore.dynamics.shapes import field_parts, object_shape
from osfcore.errors import CorruptFile, InvalidInput, OsfError, UnknownName
from osfcore.fields.field_library import FIELD_FILE, FieldLibrary
from osfcore.fields.kiloosf import write_field
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import SceneState
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, crowd, hull, moved_state, network, picked, scene
from tests.core.dynamics.solids import bracket
from tests.core.render.scenes import ball

# Rollout


PUSH = np.array([[0.3, 0.0, 0], [0.2, 0.05, 0], [0.1, -0.1, 0]])


@pytest.fixture(scope="module", params=["first guess", "random"])
def model(request, shapes):
    return PushModel(network(silent=request.param == "first guess"), shapes)


@pytest.fixture(scope="module")
def state(shapes):
    return crowd(shapes)


def plans(count: int, horizon: int = 4, seed: int = 0) -> np.ndarray:
    velocity = np.random.default_rng(seed).uniform(-0.15, 0.3, (count, horizon, 2))
    return np.concatenate([velocity, np.zeros((count, horizon, 1))], axis=2)


def assert_same(a, b, positions=0.0) -> None:
    np.testing.assert_allclose(a.positions, b.positions, atol=positions, rtol=0)
    np.testing.assert_allclose(a.quaternions, b.quaternions, atol=20 * positions, rtol=0)
    np.testing.assert_array_equal(a.pusher, b.pusher)


def test_shapes_and_beginnings(model, state):
    found = model.rollout(state, plans(5))
    assert found.names == state.names
    assert found.positions.shape == (5, 5, 4, 3)
    assert found.quaternions.shape == (5, 5, 4, 4)
    assert found.pusher.shape == (5, 5, 3)
    for k in range(5):
        np.testing.assert_array_equal(found.positions[k, 0], state.poses.position)
        np.testing.assert_array_equal(found.quaternions[k, 0], state.poses.quaternion)
    np.testing.assert_allclose(np.linalg.norm(found.quaternions, axis=-1), 1, atol=1e-9)
    assert np.abs(found.positions[:, -1, 0] - state.poses.position[0]).max() > 0.01  # something was pushed


def test_the_pusher_goes_its_path_at_its_height(model, state):
    actions = plans(5, 8)
    found = model.rollout(state, actions)
    path = pusher_path(state.pusher[:2], actions[..., :2])[:, ::SUBSTEPS]
    np.testing.assert_array_equal(found.pusher[..., :2], path)
    np.testing.assert_array_equal(found.pusher[..., 2], np.full((5, 9), state.pusher[2]))


def test_sequences_from_several_places_are_the_same_as_from_each(model, state):
    actions, places = plans(4), state.pusher[:2] + np.array([[0.0, 0.0], [-0.02, 0.01], [0.0, 0.03], [-0.05, -0.05]])
    together = model.rollout(state, actions, pushers=places)
    for k, place in enumerate(places):
        alone = model.rollout(replace(state, pusher=np.array([*place, state.pusher[2]])), actions[k : k + 1])
        assert_same(together[k], alone, positions=1e-6)


def test_what_nothing_can_touch_keeps_its_pose_bit_by_bit(model, state):
    found = model.rollout(state, plans(20))
    box = state.names.index(BOX)
    assert np.all(found.positions[:, :, box] == state.poses.position[box])
    assert np.all(found.quaternions[:, :, box] == state.poses.quaternion[box])


def test_nothing_moves_before_it_can_be_reached(model, state):
    found = model.rollout(state, np.array([[[-0.3, 0, 0], [-0.3, 0.0, 0], [0.3, 0.1, 0]]]))
    assert np.all(found.positions == state.poses.position)


@pytest.mark.parametrize("horizon", [1, 7])
def test_standing_still_from_rest_changes_nothing(model, state, horizon):
    found = model.rollout(picked(state, [0, 1, 2, 3]), np.zeros((2, horizon, 3)))
    assert np.all(found.positions == state.poses.position)
    assert np.all(found.quaternions == state.poses.quaternion)
    assert np.all(found.pusher == state.pusher)


def test_the_order_of_the_objects_permutes_rollouts_exactly(model, state):
    actions = plans(4)
    whole = model.rollout(state, actions)
    for order in itertools.islice(itertools.permutations(range(4)), 1, None, 5):
        found = model.rollout(picked(state, order), actions)
        assert found.names == tuple(state.names[i] for i in order)
        assert np.array_equal(found.positions, whole.positions[:, :, list(order)])
        assert np.array_equal(found.quaternions, whole.quaternions[:, :, list(order)])


@pytest.mark.parametrize(
    ("angle", "shift"), [(0.5, (0, 0)), (-2.2, (0.03, -0.05)), (np.pi / 2, (0.01, 0.02)), (0, (-0.06, 0.07))]
)
def test_turning_and_shifting_the_scene_turns_and_shifts_the_rollout(model, state, angle, shift):
    actions = PUSH[None] * 0.7
    here = model.rollout(state, actions)
    turn = quaternion_exp(np.array([0.0, 0, angle]))
    there = model.rollout(moved_state(state, angle, shift), rotate(turn, actions) * [1, 1, 0])
    expected = rotate(turn, here.positions) + [*shift, 0]
    assert np.linalg.norm(there.positions - expected, axis=-1).max() < 1e-5
    turned = quaternion_multiply(np.broadcast_to(turn, here.quaternions.shape), here.quaternions)
    assert np.rad2deg(rotation_angle(turned, there.quaternions)).max() < 0.01
    np.testing.assert_allclose(there.pusher, rotate(turn, here.pusher) + [*shift, 0], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_nothing_sinks(shapes, state, seed):
    """Not below the table, nor below where it was estimated to begin with."""
    sunk = SceneState(
        state.names, Pose(state.poses.position - [0, 0, 0.002], state.poses.quaternion), state.light, state.pusher
    )
    for begin, floor in ((state, 0.0), (sunk, -0.002)):
        found = PushModel(network(seed), shapes).rollout(begin, plans(10, 5, seed))
        for slot, name in enumerate(begin.names):
            points = hull(shapes[name]) + shapes[name].centre
            q = found.quaternions[:, :, slot].reshape(-1, 4)
            heights = rotate(q[:, None], points[None])[..., 2].min(axis=1) + found.positions[:, :, slot, 2].ravel()
            assert heights.min() > floor - 1e-3


def test_many_sequences_at_once_are_the_same_as_one_by_one(model, state):
    actions = plans(12, 5)
    together = model.rollout(state, actions)
    for k in range(12):
        alone = model.rollout(state, actions[k : k + 1])
        np.testing.assert_allclose(together.positions[k], alone.positions[0], atol=1e-5)
        assert rotation_angle(together.quaternions[k], alone.quaternions[0]).max() < 1e-3


def test_chunks_do_not_show(model, state, monkeypatch):
    actions = plans(7)
    whole = model.rollout(state, actions)
    monkeypatch.setattr(module, "_CHUNK", 3)
    assert_same(model.rollout(state, actions), whole, positions=1e-5)


def test_the_same_question_gets_the_same_answer(model, state):
    assert_same(model.rollout(state, plans(3)), model.rollout(state, plans(3)))


def test_a_longer_plan_begins_as_a_shorter_one(model, state):
    actions = plans(3, 6)
    long, short = model.rollout(state, actions), model.rollout(state, actions[:, :2])
    np.testing.assert_array_equal(long.positions[:, :3], short.positions)


def test_the_state_and_the_actions_are_left_alone(model, state):
    actions, positions = plans(3), state.poses.position.copy()
    copy = actions.copy()
    model.rollout(state, actions)
    np.testing.assert_array_equal(actions, copy)
    np.testing.assert_array_equal(state.poses.position, positions)


def test_before_without_any_motion_changes_nothing(model, state):
    actions = plans(3)
    assert_same(model.rollout(state, actions, state), model.rollout(state, actions))


def test_before_in_another_order_is_the_same(model, state):
    first = model.rollout(state, PUSH[None, :1])
    poses = Pose(first.positions[0, -1], first.quaternions[0, -1])
    now = SceneState(state.names, poses, state.light, first.pusher[0, -1])
    here = model.rollout(now, plans(2), state)
    there = model.rollout(now, plans(2), picked(state, [3, 1, 0, 2]))
    assert_same(here, there)


def test_what_moved_goes_on_moving(shapes, state):
    """Nothing touches the can any more, but it was moving a moment ago, so the network is asked."""
    model = PushModel(network(), shapes)
    still = np.zeros((1, 1, 3))
    number = state.names.index(CAN)
    poses = Pose(state.poses.position.copy(), state.poses.quaternion)
    poses.position[number, 0] -= 0.02
    before = SceneState(state.names, poses, state.light, None)  # where the pusher was plays no part
    resting, moving = model.rollout(state, still), model.rollout(state, still, before)
    np.testing.assert_array_equal(resting.positions[0, 1], state.poses.position)
    assert np.abs(moving.positions[0, 1, number] - state.poses.position[number]).max() > 1e-4


def test_before_is_checked(model, state, shapes):
    other = scene(shapes, {CAN: (0.06, 0.0)})
    with pytest.raises(InvalidInput, match="objects one action ago"):
        model.rollout(state, plans(1), other)


def bad(where, value) -> np.ndarray:
    actions = plans(3)
    actions[where] = value
    return actions


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (bad((1, 2, 0), np.nan), "action 2 of sequence 1 .*nan"),
        (bad((2, 0, 1), np.inf), "action 0 of sequence 2 .*inf"),
        (bad((0, 1, 0), 0.31), "action 1 of sequence 0 .*0.31.*at most 0.3"),
        (bad((0, 0, 1), -0.31), "action 0 of sequence 0"),
        (bad((0, 3, 2), 0.01), r"action 3 of sequence 0 .*\(vx, vy, 0\)"),
        (np.zeros((4, 3)), "shape of the actions is \\(4, 3\\)"),
        (np.zeros((2, 4, 2)), "shape of the actions"),
        (np.zeros((1, 2, 4, 3)), "shape of the actions"),
        (np.zeros(3), "shape of the actions"),
        (np.zeros((0, 4, 3)), "number of action sequences is 0"),
        (np.zeros((20_001, 1, 3)), "number of action sequences is 20001"),
        (np.zeros((2, 0, 3)), "horizon .* is 0"),
        (np.zeros((1, 10_000, 3)), "horizon .* is 10000"),
        ([[[0, 0, 0]], [[0, 0, 0], [0, 0, 0]]], "actions"),
        ([[["a", "b", "c"]]], "actions"),
        ("north", "actions"),
        (None, "actions"),
        ([[[10**400, 0, 0]]], "actions"),
    ],
)
@pytest.mark.wrong_arrays
def test_actions_that_cannot_be_rolled_out_are_told_in_one_sentence(model, state, actions, words):
    with pytest.raises(InvalidInput, match=words) as caught:
        model.rollout(state, actions)
    sentence = str(caught.value)
    assert len(sentence) < 400
    assert sentence.endswith(".")
    assert "\n" not in sentence


def test_scenes_that_cannot_be_predicted_are_told(model, state, shapes):
    with pytest.raises(InvalidInput, match="number of objects is 0"):
        model.rollout(scene(shapes, {}), plans(1))
    with pytest.raises(InvalidInput, match="pusher of the state is missing"):
        model.rollout(SceneState(state.names, state.poses, state.light, None), plans(1))
    with pytest.raises(UnknownName, match="no shape named 'teapot'"):
        model.rollout(SceneState(("teapot",), state.poses[[0]], state.light, state.pusher), plans(1))
    with pytest.raises(OsfError, match="unit quaternion"):
        SceneState(state.names, Pose(state.poses.position, 1.1 * state.poses.quaternion), state.light, state.pusher)


def test_a_single_object_and_all_known_ones(model, shapes):
    assert model.names == tuple(sorted(shapes))
    alone = model.rollout(scene(shapes, {APPLE: (0.06, 0.0)}), PUSH[None])
    assert alone.positions[0, -1, 0, 0] > 0.07
    assert alone.positions.shape == (1, 4, 1, 3)


def test_a_pushed_object_moves_with_the_pusher(shapes):
    """The first guess alone: a box pushed at its middle goes as far as the pusher goes after contact."""
    model = PushModel(network(silent=True), shapes)
    begin = scene(shapes, {GELATIN: (0.08, 0.0, (0.0, 0.0, 0.02))})
    found = model.rollout(begin, np.array([[[0.2, 0.0, 0.0]] * 4]))
    gap = 0.08 - shapes[GELATIN].half_extents[0] - 0.015
    assert found.positions[0, -1, 0, 0] - begin.poses.position[0, 0] == pytest.approx(0.16 - gap, abs=1e-2)
    assert abs(found.positions[0, -1, 0, 1] - begin.poses.position[0, 1]) < 1e-2


def test_extreme_places_give_finite_answers(model, shapes):
    """The pusher inside an object, objects inside each other, far away, upside down."""
    begin = scene(shapes, {BOX: (0.01, 0.0, (3.0, 0.3, 0)), CAN: (0.02, 0.01), APPLE: (40.0, 0.0)})
    found = model.rollout(begin, plans(5, 6))
    assert np.isfinite(found.positions).all()
    np.testing.assert_allclose(np.linalg.norm(found.quaternions, axis=-1), 1, atol=1e-9)


def test_no_gradients_are_kept(shapes, state):
    trained = network()
    PushModel(trained, shapes).rollout(state, plans(1))
    assert all(p.grad is None for p in trained.parameters())
    assert torch.is_grad_enabled()


# Push models


FIELDS = FieldLibrary(None)
BANANA = "011_banana"
HOLLOW = {BANANA, "019_pitcher_base", "022_windex_bottle", "024_bowl", "025_mug", "035_power_drill"}


def test_a_network_of_this_machine_comes_first(tmp_path):
    assert network_path(None) == network_path(tmp_path) == shipped()
    own = tmp_path / "dynamics" / NETWORK_FILE
    write_network(own, network())
    assert network_path(tmp_path) == own


def test_the_model_knows_the_objects_asked_for_and_predicts(tmp_path, shapes):
    write_network(tmp_path / "dynamics" / NETWORK_FILE, network(silent=True))
    model = load_push_model(tmp_path, FIELDS, [CAN, APPLE])
    assert model.names == (CAN, APPLE)
    found = model.rollout(scene(shapes, {CAN: (0.06, 0.0)}), np.array([[[0.3, 0.0, 0.0]]]))
    assert found.positions[0, 1, 0, 0] > 0.07


@pytest.fixture
def trained(tmp_path):
    """A field trained on this machine, of a bracket."""
    path = tmp_path / "fields" / "bracket" / FIELD_FILE
    write_field(path, bracket())
    return FieldLibrary(tmp_path)


@pytest.mark.slow
def test_shipped_parts_are_those_of_the_shipped_fields(monkeypatch):
    monkeypatch.setattr("osfcore.dynamics.rollout.field_parts", lambda _: pytest.fail("parts do not fit their field"))
    counts = {name: len(shape.parts) for name, shape in load_shapes(None, FIELDS, FIELDS.names()).items()}
    assert {name for name, count in counts.items() if count} == HOLLOW


@pytest.mark.slow
def test_shipped_parts_can_be_made_again():
    kept = load_shapes(None, FIELDS, [BANANA])[BANANA].parts
    parts = field_parts(FIELDS.load(BANANA))
    made = object_shape(FIELDS.load(BANANA), parts).parts
    for a, b in zip(kept, made, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_parts_of_an_own_field_are_made_once(tmp_path, trained, monkeypatch):
    first = load_shapes(tmp_path, trained, ["bracket"])["bracket"]
    assert len(first.parts) >= 2
    monkeypatch.setattr("osfcore.dynamics.rollout.field_parts", lambda _: pytest.fail("made again"))
    again = load_shapes(tmp_path, trained, ["bracket"])["bracket"]
    assert all(np.array_equal(a, b) for a, b in zip(first.parts, again.parts, strict=True))


def test_a_field_that_was_trained_again_gets_new_parts(tmp_path, trained):
    load_shapes(tmp_path, trained, ["bracket"])
    write_field(trained.folder("bracket") / FIELD_FILE, ball(0.05, voxel=0.004))
    assert load_shapes(tmp_path, trained, ["bracket"])["bracket"].parts == ()


def test_where_nothing_can_be_kept_shapes_are_known_all_the_same(tmp_path, trained):
    (tmp_path / "dynamics").write_bytes(b"no folder")
    assert len(load_shapes(tmp_path, trained, ["bracket"])["bracket"].parts) >= 2
    assert len(load_shapes(None, trained, ["bracket"])["bracket"].parts) >= 2


def test_an_object_without_a_field_is_told():
    with pytest.raises(UnknownName, match="teapot"):
        load_push_model(None, FIELDS, ["teapot"])


def test_a_broken_network_is_told_rather_than_passed_over(tmp_path):
    (tmp_path / "dynamics").mkdir()
    (tmp_path / "dynamics" / NETWORK_FILE).write_bytes(b"broken")
    with pytest.raises(CorruptFile, match=NETWORK_FILE):
        load_push_model(tmp_path, FIELDS, [CAN])
