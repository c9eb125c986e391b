"""Scene file: scene file, state file, rollout file."""

import copy
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import CannotWrite, CorruptFile, OsfError
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.scene_file import (
    Scene,
    actions_from_json,
    estimated_from_json,
    estimated_to_json,
    is_estimated,
    read_actions,
    read_estimated,
    read_scene,
    rollouts_from_json,
    rollouts_to_json,
    scene_from_json,
    scene_to_json,
    write_estimated,
    write_rollouts,
)

# Scene file


STATE = SceneState(
    ("006_mustard_bottle", "035_power_drill"),
    Pose(np.array([[0.1, 0, 0.09], [-0.1, 0.05, 0.03]]), quaternion_exp(np.array([[0, 0, 0.5], [0.1, 0.2, 0.3]]))),
    Light.from_angles(0.3, 0.8),
    np.array([0.2, 0.1, 0.062]),
)
GOOD = scene_to_json(Scene(STATE, default_cameras()))


def test_scene_survives_its_file(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(GOOD))
    scene = read_scene(path)
    assert scene.state.names == STATE.names
    np.testing.assert_allclose(scene.state.poses.matrix(), STATE.poses.matrix(), atol=1e-12)
    np.testing.assert_allclose(scene.state.light.position, STATE.light.position, atol=1e-12)
    for a, b in zip(scene.cameras, default_cameras(), strict=True):
        np.testing.assert_allclose(a.T_world_camera.matrix(), b.T_world_camera.matrix(), atol=1e-9)
        np.testing.assert_allclose(a.intrinsics, b.intrinsics, atol=1e-12)


def test_pusher_and_cameras_may_be_missing():
    data = {key: GOOD[key] for key in ("objects", "light")}
    scene = scene_from_json(data)
    assert scene.state.pusher is None
    assert scene.cameras == ()


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("objects",), None, "objects"),
        (("objects", 0, "position"), [0, 0], "006_mustard_bottle"),
        (("objects", 0, "quaternion"), [1, 1, 0, 0], "unit"),
        (("objects", 1, "name"), "006_mustard_bottle", "repetition"),
        (("light", "position"), [0, 1, -1], "light"),
        (("light",), None, "light"),
        (("pusher",), [0, 0, 0], "pusher"),
        (("cameras", 0, "K"), [[1, 0, 0]], "K of camera 0"),
        (("cameras", 0, "K"), [[100, 0, 64], [0, 100, 64], [0, 0, 0]], "last row"),
        (("cameras", 0, "T_world_camera"), [[1, 0], [0]], "T_world_camera of camera 0"),
        (("cameras", 0, "T_world_camera"), [*np.eye(4)[:3].tolist(), [5, 5, 5, 5]], "rotation"),
        (("cameras", 1, "name"), "0", "all different"),
        (("objects", 0, "position"), [10**400, 0, 0], "006_mustard_bottle"),
        (("cameras", 0, "width"), 1.5, "camera 0"),
        (("cameras", 0, "width"), 5000, "between 16 and 1024"),
        (("cameras", 0, "T_world_camera"), (2 * np.eye(4)).tolist(), "rotation"),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path, path, value, words):
    data = copy.deepcopy(GOOD)
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is None:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    file = tmp_path / "scene.json"
    file.write_text(json.dumps(data))
    with pytest.raises(CorruptFile, match=words):
        read_scene(file)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\x00", "text"),
        (b'{"objects": [', "JSON"),
        (b"[]", "object"),
        (b"NaN", "object"),
        (b"1" * 5000, "JSON"),
        (b"[" * 100_000, "deep"),
    ],
)
def test_other_files_are_told_from_scenes(tmp_path, content, words):
    file = tmp_path / "scene.json"
    file.write_bytes(content)
    with pytest.raises(CorruptFile, match=words):
        read_scene(file)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(CorruptFile, match="No such file"):
        read_scene(tmp_path / "scene.json")


json_values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["objects", "light", "name", "position"]), inner)
    ),
    max_leaves=12,
)


@given(value=json_values)
def test_whatever_comes_it_is_a_scene_or_a_clear_error(value):
    try:
        scene_from_json(value)
    except OsfError as error:
        assert len(str(error)) < 300


# State file


numbers = st.floats(-10, 10)
deviations = st.floats(0, 10) | st.just(float("inf"))


@st.composite
def states(draw):
    names = tuple(draw(st.lists(st.text(min_size=1, max_size=8), max_size=4, unique=True)))
    count = len(names)
    positions = np.array(draw(st.lists(numbers, min_size=3 * count, max_size=3 * count))).reshape(-1, 3)
    turns = np.array(draw(st.lists(numbers, min_size=3 * count, max_size=3 * count))).reshape(-1, 3)
    pusher = draw(st.none() | st.tuples(numbers, numbers, numbers).map(np.array))
    light = Light.from_angles(draw(st.floats(-3.1, 3.1)), draw(st.floats(0.1, 1.5)))
    per_object = st.lists(deviations, min_size=count, max_size=count)
    doubts = tuple(draw(st.lists(st.text(max_size=8), min_size=count, max_size=count)))
    return EstimatedState(
        SceneState(names, Pose(positions, quaternion_exp(turns).reshape(-1, 4)), light, pusher),
        np.array(draw(per_object), float),
        np.array(draw(per_object), float),
        draw(deviations),
        doubts,
        draw(st.text(max_size=8)),
    )


def assert_same_scene(a: SceneState, b: SceneState):
    assert a.names == b.names
    np.testing.assert_allclose(a.poses.position, b.poses.position, atol=1e-12)
    assert np.all(rotation_angle(a.poses.quaternion, b.poses.quaternion) < 1e-7)
    np.testing.assert_allclose(a.light.position, b.light.position, atol=1e-12)
    assert (a.pusher is None) == (b.pusher is None)
    if a.pusher is not None:
        np.testing.assert_allclose(a.pusher, b.pusher, atol=1e-12)


@given(estimated=states())
def test_a_state_survives_its_file_and_reads_as_a_scene(tmp_path_factory, estimated):
    path = tmp_path_factory.mktemp("states") / "state.json"
    write_estimated(path, estimated)
    back = read_estimated(path)
    assert_same_scene(back.state, estimated.state)
    np.testing.assert_array_equal(back.position_std, estimated.position_std)
    np.testing.assert_array_equal(back.rotation_std, estimated.rotation_std)
    assert (back.light_std, back.doubts, back.reason) == (estimated.light_std, estimated.doubts, estimated.reason)
    assert back.trusted == estimated.trusted == json.loads(path.read_text(), parse_constant=pytest.fail)["trusted"]
    scene = read_scene(path)
    assert_same_scene(scene.state, estimated.state)
    assert scene.cameras == ()


def example() -> EstimatedState:
    names = ("006_mustard_bottle", "035_power_drill")
    poses = Pose(np.array([[0.1, 0, 0.09], [-0.1, 0.05, 0.03]]), np.tile([1.0, 0, 0, 0], (2, 1)))
    state = SceneState(names, poses, Light.from_angles(0.3, 0.8), np.array([0.2, 0.1, 0.062]))
    return EstimatedState(state, np.array([0.001, 0.002]), np.array([0.01, 0.02]), 0.03, ("", "it hides"), "it hides")


def test_a_plain_scene_is_a_trusted_state_without_uncertainty(tmp_path):
    path = tmp_path / "scene.json"
    data = scene_to_json(Scene(example().state, default_cameras()))
    path.write_text(json.dumps(data))
    back = read_estimated(path)
    assert_same_scene(back.state, example().state)
    assert back.trusted
    assert (back.light_std, back.doubts) == (0.0, ("", ""))
    assert not back.position_std.any()
    assert not back.rotation_std.any()
    assert not is_estimated(data)
    assert is_estimated(estimated_to_json(example()))
    assert not is_estimated(["trusted"])


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (
            ("objects", 0, "uncertainty"),
            3,
            "uncertainty of object 006_mustard_bottle is 3, but it must be a JSON object",
        ),
        (("objects", 1, "uncertainty", "position_std_m"), -1, "position_std_m of object 035_power_drill is -1"),
        (("objects", 1, "uncertainty", "position_std_m"), True, "position_std_m of object 035_power_drill is True"),
        (
            ("objects", 1, "uncertainty", "rotation_std_rad"),
            float("nan"),
            "rotation_std_rad of object 035_power_drill is nan",
        ),
        (
            ("objects", 1, "uncertainty", "rotation_std_rad"),
            10**400,
            "rotation_std_rad of object 035_power_drill is 1000",
        ),
        (("objects", 0, "doubt"), None, "doubt of object 006_mustard_bottle is None, but it must be a text"),
        (("objects", 0, "position"), [0, 0], "position of object 006_mustard_bottle"),
        (("light", "uncertainty", "direction_std_rad"), "1", "direction_std_rad of light is '1'"),
        (("light", "position"), [0, 0, -1], "light"),
        (("trusted",), "yes", "trusted is 'yes', but it must be true or false"),
        (("trusted",), True, "reason is 'it hides', but it must be empty where trusted is true"),
        (("reason",), "", "reason is '', but it must be .*a sentence where it is false"),
        (("reason",), 7, "reason is 7"),
    ],
)
def test_mistakes_are_told_with_their_place_state_file(tmp_path, path, value, words):
    data = copy.deepcopy(estimated_to_json(example()))
    at = data
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    file = tmp_path / "state.json"
    file.write_text(json.dumps(data))
    with pytest.raises(CorruptFile, match=f"state.json cannot be used: .*{words}"):
        read_estimated(file)


def test_files_that_are_not_there_or_cannot_be_written_are_told(tmp_path):
    with pytest.raises(CorruptFile, match="No such file"):
        read_estimated(tmp_path / "state.json")
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        write_estimated(tmp_path / "file" / "state.json", example())


estimate_json_values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["uncertainty", "doubt", "name"]), inner)
    ),
    max_leaves=8,
)


@given(key=st.sampled_from(["objects", "light", "pusher", "trusted", "reason"]), value=estimate_json_values)
def test_whatever_comes_it_is_a_state_or_a_clear_error(key, value):
    try:
        estimated_from_json({**estimated_to_json(example()), key: value})
    except OsfError as error:
        assert len(str(error)) < 400


# Rollout file


GOOD_ROLLOUTS = {"actions": [[[0.1, -0.2, 0.0], [0.3, 0.0, 0.0]]], "step_s": 0.2}


def example_rollouts(seed: int = 0) -> Rollouts:
    rng = np.random.default_rng(seed)
    return Rollouts(
        ("box", "can"), rng.normal(size=(3, 5, 2, 3)), rng.normal(size=(3, 5, 2, 4)), rng.normal(size=(3, 5, 3))
    )


@given(count=st.integers(1, 4), horizon=st.integers(1, 6), seed=st.integers(0, 10**6))
def test_actions_survive_their_file(tmp_path_factory, count, horizon, seed):
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, horizon, 3)) * [1, 1, 0]
    path = tmp_path_factory.mktemp("actions") / "actions.json"
    path.write_text(json.dumps({"actions": actions.tolist()}))
    np.testing.assert_array_equal(read_actions(path), actions)


def test_the_length_of_a_step_may_be_told():
    np.testing.assert_array_equal(actions_from_json(GOOD_ROLLOUTS), GOOD_ROLLOUTS["actions"])


def test_rollouts_survive_their_file_to_the_nanometre(tmp_path):
    rollouts = example_rollouts()
    write_rollouts(tmp_path / "rollouts.json", rollouts)
    back = json.loads((tmp_path / "rollouts.json").read_text(), parse_constant=pytest.fail)
    assert set(back) == {"names", "positions", "quaternions", "pusher", "step_s"}
    assert back["names"] == ["box", "can"]
    assert back["step_s"] == 0.2
    for key in ("positions", "quaternions", "pusher"):
        np.testing.assert_allclose(back[key], getattr(rollouts, key), atol=1e-9, rtol=0)
    assert rollouts_to_json(rollouts) == back


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({}, "'actions' of the actions file is missing"),
        ({"step_s": 0.2}, "'actions' of the actions file is missing"),
        (GOOD_ROLLOUTS | {"step_s": 0.1}, "step_s is 0.1, but it must be 0.2"),
        (GOOD_ROLLOUTS | {"step_s": "0.2"}, "step_s is '0.2'"),
        (GOOD_ROLLOUTS | {"step_s": None}, "step_s is None"),
        (GOOD_ROLLOUTS | {"step_s": True}, "step_s is True"),
        (GOOD_ROLLOUTS | {"step_s": float("nan")}, "step_s is nan"),
        (GOOD_ROLLOUTS | {"actions": [[[0.31, 0, 0]]]}, "action 0 of sequence 0"),
        (GOOD_ROLLOUTS | {"actions": [[[float("nan"), 0, 0]]]}, "action 0 of sequence 0"),
        (GOOD_ROLLOUTS | {"actions": [[[0.1, 0, 0]], []]}, "actions"),
        (GOOD_ROLLOUTS | {"actions": [[0.1, 0, 0]]}, "shape of the actions"),
        (GOOD_ROLLOUTS | {"actions": []}, "shape of the actions"),
        (GOOD_ROLLOUTS | {"actions": "north"}, "actions"),
        (GOOD_ROLLOUTS | {"actions": None}, "actions"),
        ([], "actions file is"),
        ("text", "actions file is"),
    ],
)
def test_mistakes_are_told_with_the_file_that_has_them(tmp_path, content, words):
    path = tmp_path / "actions.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CorruptFile, match=f"actions.json cannot be used: .*{words}") as caught:
        read_actions(path)
    assert len(str(caught.value)) < 600


def test_rollouts_are_read_as_they_were_written():
    given = example_rollouts()
    read = rollouts_from_json(json.loads(json.dumps(rollouts_to_json(given))))
    assert read.names == given.names
    for part in ("positions", "quaternions", "pusher"):
        np.testing.assert_allclose(getattr(read, part), getattr(given, part), atol=1e-9)
    with pytest.raises(OsfError, match="positions"):
        rollouts_from_json({**rollouts_to_json(given), "positions": "somewhere"})


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.95])
def test_files_cut_short_are_told(tmp_path, share):
    path, text = tmp_path / "actions.json", json.dumps(GOOD_ROLLOUTS)
    path.write_text(text[: int(share * len(text))])
    with pytest.raises(CorruptFile, match="not valid JSON"):
        read_actions(path)


def test_files_that_are_not_there_or_no_text_or_cannot_be_written_are_told(tmp_path):
    with pytest.raises(CorruptFile, match="No such file"):
        read_actions(tmp_path / "actions.json")
    (tmp_path / "file").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CorruptFile, match="not a text file"):
        read_actions(tmp_path / "file")
    with pytest.raises(CannotWrite):
        write_rollouts(tmp_path / "file" / "rollouts.json", example_rollouts())


values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(key=st.sampled_from(["actions", "step_s"]), value=values)
def test_whatever_comes_it_is_actions_or_a_clear_error(key, value):
    try:
        actions_from_json({**GOOD_ROLLOUTS, key: value})
    except OsfError as error:
        assert len(str(error)) < 600
