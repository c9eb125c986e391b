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
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.scene_file import (
    Scene,
    estimated_from_json,
    estimated_to_json,
    is_estimated,
    read_estimated,
    read_scene,
    scene_to_json,
    write_estimated,
)

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
def test_mistakes_are_told_with_their_place(tmp_path, path, value, words):
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


json_values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["uncertainty", "doubt", "name"]), inner)
    ),
    max_leaves=8,
)


@given(key=st.sampled_from(["objects", "light", "pusher", "trusted", "reason"]), value=json_values)
def test_whatever_comes_it_is_a_state_or_a_clear_error(key, value):
    try:
        estimated_from_json({**estimated_to_json(example()), key: value})
    except OsfError as error:
        assert len(str(error)) < 400
