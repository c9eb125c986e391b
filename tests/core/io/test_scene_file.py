import copy
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import CorruptFile, OsfError
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import Scene, read_scene, scene_from_json, scene_to_json

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
