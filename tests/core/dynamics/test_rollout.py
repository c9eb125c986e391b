"""Rollout: rollout, push models."""

import hashlib
import itertools
from dataclasses import replace

import numpy as np
import pytest

from osfcore.dynamics.graph import shipped, write_network
from osfcore.dynamics.motion import SUBSTEPS, pusher_path
from osfcore.dynamics.rollout import NETWORK_FILE, PushModel, load_push_model, load_shapes, network_path
from osfcore.dynamics.shapes import read_parts
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.fields.field_library import FIELD_FILE, FieldLibrary
from osfcore.fields.kiloosf import write_field
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate, rotation_angle
from osfcore.geometry.states import SceneState
from tests.core.dynamics.scenes import (
    APPLE,
    BOX,
    CAN,
    GELATIN,
    bracket,
    crowd,
    hull,
    moved_state,
    network,
    picked,
    scene,
)
from tests.support.errors import about
from tests.support.rendered_scenes import ball

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


def test_rollouts_begin_at_the_state_and_the_pusher_goes_its_path(model, state):
    actions = plans(3, 5)
    found = model.rollout(state, actions)
    assert (found.names, model.names) == (state.names, tuple(sorted(state.names)))
    assert found.positions.shape == (3, 6, 4, 3)
    assert np.all(found.positions[:, 0] == state.poses.position)
    assert np.all(found.quaternions[:, 0] == state.poses.quaternion)
    np.testing.assert_allclose(np.linalg.norm(found.quaternions, axis=-1), 1, atol=1e-9)
    assert np.abs(found.positions[:, -1, 0] - state.poses.position[0]).max() > 0.01  # something was pushed
    path = pusher_path(state.pusher[:2], actions[..., :2])[:, ::SUBSTEPS]
    np.testing.assert_array_equal(found.pusher[..., :2], path)
    assert np.all(found.pusher[..., 2] == state.pusher[2])


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
    for actions in (np.array([[[-0.3, 0, 0], [-0.3, 0.0, 0], [0.3, 0.1, 0]]]), np.zeros((2, 3, 3))):
        found = model.rollout(state, actions)
        assert np.all(found.positions == state.poses.position)
        assert np.all(found.quaternions == state.poses.quaternion)


def test_the_order_of_the_objects_permutes_rollouts_exactly(model, state):
    actions = plans(4)
    whole = model.rollout(state, actions)
    for order in itertools.islice(itertools.permutations(range(4)), 1, None, 5):
        found = model.rollout(picked(state, order), actions)
        assert found.names == tuple(state.names[i] for i in order)
        assert np.array_equal(found.positions, whole.positions[:, :, list(order)])
        assert np.array_equal(found.quaternions, whole.quaternions[:, :, list(order)])


@pytest.mark.parametrize(("angle", "shift"), [(0.5, (0, 0)), (-2.2, (0.03, -0.05)), (np.pi / 2, (0.01, 0.02))])
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


@pytest.mark.parametrize("seed", range(2))
def test_nothing_sinks(shapes, state, seed):
    """Not below the table, nor below where it was estimated to begin with."""
    sunk = replace(state, poses=Pose(state.poses.position - [0, 0, 0.002], state.poses.quaternion))
    for begin, floor in ((state, 0.0), (sunk, -0.002)):
        found = PushModel(network(seed), shapes).rollout(begin, plans(10, 5, seed))
        for slot, name in enumerate(begin.names):
            points = hull(shapes[name]) + shapes[name].centre
            q = found.quaternions[:, :, slot].reshape(-1, 4)
            heights = rotate(q[:, None], points[None])[..., 2].min(axis=1) + found.positions[:, :, slot, 2].ravel()
            assert heights.min() > floor - 1e-3


def test_before_in_another_order_is_the_same(model, state, shapes):
    first = model.rollout(state, PUSH[None, :1])
    poses = Pose(first.positions[0, -1], first.quaternions[0, -1])
    now = SceneState(state.names, poses, state.light, first.pusher[0, -1])
    here, there = (model.rollout(now, plans(2), before) for before in (state, picked(state, [3, 1, 0, 2])))
    assert_same(here, there)
    assert_same(model.rollout(now, plans(2), now), model.rollout(now, plans(2)))
    with pytest.raises(InvalidInput, check=about("objects one action ago")):
        model.rollout(now, plans(1), scene(shapes, {CAN: (0.06, 0.0)}))


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


def bad(where, value) -> np.ndarray:
    actions = plans(3)
    actions[where] = value
    return actions


@pytest.mark.parametrize(
    "actions",
    [
        *(bad((1, 2, 0), value) for value in (np.nan, np.inf, 0.31, -0.31)),
        bad((0, 3, 2), 0.01),
        *(np.zeros(shape) for shape in ((4, 3), (2, 4, 2), (1, 2, 4, 3), (0, 4, 3), (20_001, 1, 3), (1, 10_000, 3))),
        [[[0, 0, 0]], [[0, 0, 0], [0, 0, 0]]],
        "north",
        None,
        [[[10**400, 0, 0]]],
    ],
)
@pytest.mark.wrong_arrays
def test_actions_that_cannot_be_rolled_out_are_refused(model, state, actions):
    with pytest.raises(InvalidInput) as caught:
        model.rollout(state, actions)
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)


def test_scenes_that_cannot_be_predicted_are_refused(model, state, shapes):
    with pytest.raises(InvalidInput, check=about("number of objects")):
        model.rollout(scene(shapes, {}), plans(1))
    with pytest.raises(InvalidInput, check=about("pusher of the state")):
        model.rollout(replace(state, pusher=None), plans(1))
    with pytest.raises(UnknownName, check=about("teapot")):
        model.rollout(SceneState(("teapot",), state.poses[[0]], state.light, state.pusher), plans(1))
    with pytest.raises(InvalidInput, check=about("number of objects")):
        PushModel(network(), {})


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


# Push models


FIELDS = FieldLibrary(None)
HOLLOW = {"011_banana", "019_pitcher_base", "022_windex_bottle", "024_bowl", "025_mug", "035_power_drill"}


def test_a_network_of_this_machine_comes_first_and_is_loaded_for_the_objects_asked_for(tmp_path, shapes):
    assert network_path(None) == network_path(tmp_path) == shipped()
    own = tmp_path / "dynamics" / NETWORK_FILE
    write_network(own, network(silent=True))
    assert network_path(tmp_path) == own
    model = load_push_model(tmp_path, FIELDS, [CAN, APPLE])
    assert model.names == (CAN, APPLE)
    found = model.rollout(scene(shapes, {CAN: (0.06, 0.0)}), np.array([[[0.3, 0.0, 0.0]]]))
    assert found.positions[0, 1, 0, 0] > 0.07
    with pytest.raises(UnknownName, check=about("teapot")):
        load_push_model(tmp_path, FIELDS, ["teapot"])
    own.write_bytes(b"broken")
    with pytest.raises(CorruptFile, check=about(NETWORK_FILE)):
        load_push_model(tmp_path, FIELDS, [CAN])


@pytest.fixture
def trained(tmp_path):
    """A field trained on this machine, of a bracket."""
    path = tmp_path / "fields" / "bracket" / FIELD_FILE
    write_field(path, bracket())
    return FieldLibrary(tmp_path)


def test_shipped_parts_are_those_of_the_shipped_fields():
    """A file of parts names the field that it was made from."""
    hollow = set()
    for name in FIELDS.names():
        digest = hashlib.sha256(FIELDS.info(name).path.read_bytes()).hexdigest()
        parts = read_parts(shipped().parent / "parts" / f"{name}.safetensors", digest)
        assert parts is not None, name
        hollow |= {name} if parts else set()
    assert hollow == HOLLOW


def test_parts_of_an_own_field_are_made_once_for_each_of_its_files(tmp_path, trained):
    first = load_shapes(tmp_path, trained, ["bracket"])["bracket"]
    assert len(first.parts) >= 2
    kept = tmp_path / "dynamics" / "parts" / "bracket.safetensors"
    made = kept.stat().st_mtime_ns
    again = load_shapes(tmp_path, trained, ["bracket"])["bracket"]
    assert all(np.array_equal(a, b) for a, b in zip(first.parts, again.parts, strict=True))
    assert kept.stat().st_mtime_ns == made
    write_field(trained.folder("bracket") / FIELD_FILE, ball(0.05, voxel=0.004))
    assert load_shapes(tmp_path, trained, ["bracket"])["bracket"].parts == ()


def test_where_nothing_can_be_kept_shapes_are_known_all_the_same(tmp_path, trained):
    (tmp_path / "dynamics").write_bytes(b"no folder")
    assert len(load_shapes(tmp_path, trained, ["bracket"])["bracket"].parts) >= 2
