import contextlib
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from osfcore.errors import CannotWrite, CorruptFile, OsfError
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.scene_file import (
    Scene,
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
from tests.support.errors import about
from tests.support.json_edits import edited, json_values_with
from tests.support.same import assert_same

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
    assert_same(read_scene(path), Scene(STATE, default_cameras()), atol=1e-9)


@pytest.mark.parametrize(
    ("datum", "path", "values"),
    [
        ("object 006_mustard_bottle", ("objects", 0, "position"), [[0, 0], [10**400, 0, 0]]),
        ("quaternion", ("objects", 0, "quaternion"), [[1, 1, 0, 0]]),
        ("list of objects", ("objects", 1, "name"), ["006_mustard_bottle"]),
        ("light", ("light",), [..., {"position": [0, 1, -1]}]),
        ("pusher", ("pusher",), [[0, 0, 0]]),
        ("K of camera 0", ("cameras", 0, "K"), [[[1, 0, 0]], [[100, 0, 64], [0, 100, 64], [0, 0, 0]]]),
        ("T_world_camera of camera 0", ("cameras", 0, "T_world_camera"), [[[1, 0], [0]], (2 * np.eye(4)).tolist()]),
        ("T_world_camera of camera 0", ("cameras", 0, "T_world_camera", 3), [[5, 5, 5, 5]]),
        ("names of the cameras", ("cameras", 1, "name"), ["0"]),
        ("camera 0", ("cameras", 0, "width"), [1.5, 5000]),
    ],
)
def test_mistakes_are_refused_with_their_place(tmp_path, datum, path, values):
    file = tmp_path / "scene.json"
    for value in values:
        file.write_text(json.dumps(edited(GOOD, path, value)))
        with pytest.raises(CorruptFile, check=about(datum)):
            read_scene(file)


json_values = json_values_with("objects", "light", "name", "position", "uncertainty", "doubt")
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


@given(estimated=states())
@settings(max_examples=40)
def test_a_state_survives_its_file_and_reads_as_a_scene(tmp_path_factory, estimated):
    path = tmp_path_factory.mktemp("states") / "state.json"
    write_estimated(path, estimated)
    assert_same(read_estimated(path), estimated, atol=1e-12)
    assert estimated.trusted == json.loads(path.read_text(), parse_constant=pytest.fail)["trusted"]
    assert_same(read_scene(path), Scene(estimated.state, ()), atol=1e-12)


ESTIMATED = EstimatedState(STATE, np.array([0.001, 0.002]), np.array([0.01, 0.02]), 0.03, ("", "it hides"), "it hides")
GOOD_STATE = estimated_to_json(ESTIMATED)


def test_a_plain_scene_is_a_trusted_state_without_uncertainty(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(GOOD))
    assert_same(read_estimated(path), EstimatedState(STATE, np.zeros(2), np.zeros(2), 0.0, ("", ""), ""), atol=1e-12)
    assert [is_estimated(data) for data in (GOOD, GOOD_STATE, ["trusted"])] == [False, True, False]


@pytest.mark.parametrize(
    ("datum", "path", "values"),
    [
        ("position_std_m of object 035_power_drill", ("objects", 1, "uncertainty", "position_std_m"), [-1, True]),
        ("rotation_std_rad of", ("objects", 1, "uncertainty", "rotation_std_rad"), [float("nan"), 10**400]),
        ("direction_std_rad of light", ("light", "uncertainty", "direction_std_rad"), ["1"]),
        ("light", ("light", "position"), [[0, 0, -1]]),
        ("reason", ("trusted",), [True]),
        ("reason", ("reason",), ["", 7]),
    ],
)
def test_mistakes_in_a_state_are_refused_with_their_place(tmp_path, datum, path, values):
    file = tmp_path / "state.json"
    for value in values:
        file.write_text(json.dumps(edited(GOOD_STATE, path, value)))
        with pytest.raises(CorruptFile, check=about(datum)):
            read_estimated(file)


@given(key=st.sampled_from(["objects", "light", "pusher", "trusted", "reason"]), value=json_values)
@settings(max_examples=40)
def test_whatever_comes_it_is_a_state_or_a_clear_error(key, value):
    with contextlib.suppress(OsfError):
        scene_from_json(value)
    try:
        estimated_from_json({**GOOD_STATE, key: value})
    except OsfError as error:
        assert len(str(error)) < 400


GOOD_ACTIONS = {"actions": [[[0.1, -0.2, 0.0], [0.3, 0.0, 0.0]]], "step_s": 0.2}


def test_rollouts_survive_their_file_to_the_nanometre(tmp_path):
    rng = np.random.default_rng(0)
    arrays = (rng.normal(size=(3, 5, 2, 3)), rng.normal(size=(3, 5, 2, 4)), rng.normal(size=(3, 5, 3)))
    rollouts = Rollouts(("box", "can"), *arrays)
    write_rollouts(tmp_path / "rollouts.json", rollouts)
    stored = json.loads((tmp_path / "rollouts.json").read_text(), parse_constant=pytest.fail)
    assert (set(stored), stored["step_s"]) == ({"names", "positions", "quaternions", "pusher", "step_s"}, 0.2)
    assert rollouts_to_json(rollouts) == stored
    assert_same(rollouts_from_json(stored), rollouts, atol=1e-9)
    with pytest.raises(OsfError, check=about("positions")):
        rollouts_from_json({**stored, "positions": "somewhere"})
    with pytest.raises(CannotWrite):
        write_rollouts(tmp_path / "rollouts.json" / "a.json", rollouts)


@pytest.mark.parametrize(
    ("datum", "contents"),
    [
        ("'actions'", [{}, {"step_s": 0.2}]),
        ("step_s", [GOOD_ACTIONS | {"step_s": value} for value in (0.1, "0.2", None, True, float("nan"))]),
        ("action 0 of sequence 0", [GOOD_ACTIONS | {"actions": [[[v, 0, 0]]]} for v in (0.31, float("nan"))]),
        ("actions", [GOOD_ACTIONS | {"actions": v} for v in ([[[0.1, 0, 0]], []], [[0.1, 0, 0]], [], "north", None)]),
        ("actions file", [[], "text"]),
    ],
)
def test_mistakes_in_actions_are_refused_in_a_short_line(tmp_path, datum, contents):
    path = tmp_path / "actions.json"
    for content in contents:
        path.write_text(json.dumps(content))
        with pytest.raises(CorruptFile, check=about(datum)) as caught:
            read_actions(path)
        assert len(str(caught.value)) < 600
