import json

import numpy as np
import pytest
from pydantic import ValidationError

from app.api.predictions import MAX_POSES, PredictionIn, StateIn
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.states import EstimatedState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.io.scene_file import Scene, estimated_to_json, scene_to_json
from tests.app.conftest import running, until
from tests.app.processes.fields import write_box
from tests.app.storage.test_database import record
from tests.support.errors import about

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"
STATE = {
    "objects": [{"name": BOTTLE, "position": [0.0, 0.0, 0.095], "quaternion": [1.0, 0.0, 0.0, 0.0]}],
    "light": {"position": [0.3, -0.4, 0.8]},
    "pusher": {"position": [-0.12, 0.0, PUSHER_CENTRE_Z_M]},
}
PUSH = [[[0.3, 0.0, 0.0]] * 4]


def ask(service, **body):
    return service.post("/api/predictions", json=body)


def state(**changes):
    """The state with its object, or its other parts, changed."""
    placed = {key: changes.pop(key) for key in ("name", "position", "quaternion") if key in changes}
    return {**STATE, "objects": [STATE["objects"][0] | placed], **changes}


@pytest.mark.slow
def test_many_pushes_of_a_state_are_predicted_in_order(service):
    actions = [[[0.3, 0, 0]] * 4, [[0, 0, 0]] * 4, [[-0.3, 0, 0]] * 4]
    told = ask(service, state=STATE, actions=actions)
    assert told.status_code == 200, told.text
    told = told.json()
    assert told["names"] == [BOTTLE]
    positions, quaternions = np.array(told["positions"]), np.array(told["quaternions"])
    assert positions.shape == (3, 5, 1, 3)
    assert quaternions.shape == (3, 5, 1, 4)
    np.testing.assert_allclose(positions[:, 0, 0], np.tile([0, 0, 0.095], (3, 1)), atol=1e-9)
    assert positions[0, -1, 0, 0] > 0.05
    np.testing.assert_array_equal(positions[1:], np.tile([0, 0, 0.095], (2, 5, 1, 1)))
    np.testing.assert_allclose(np.array(told["pusher"])[0, -1], [0.12, 0, PUSHER_CENTRE_Z_M], atol=1e-6)
    assert told["step_s"] == 0.2
    assert told["took_s"] > 0
    assert told["scene"] is None


def test_what_was_moving_goes_on(service):
    stays = {"state": STATE, "actions": [[[0, 0, 0]]]}
    earlier = {**STATE, "objects": [STATE["objects"][0] | {"position": [-0.03, 0.0, 0.095]}]}
    assert ask(service, **stays).json()["positions"][0][1] == ask(service, **stays).json()["positions"][0][0]
    told = ask(service, **stays, before=earlier).json()["positions"][0]
    assert told[1][0][0] > told[0][0][0]


def test_the_scene_on_the_table_is_what_is_predicted_by_default(service, scene):
    told = ask(service, actions=PUSH).json()
    assert told["scene"] == scene["id"]
    assert told["revision"] == scene["revision"]
    assert told["names"] == [placed["name"] for placed in scene["objects"]]
    np.testing.assert_allclose(
        [placed[0] for placed in np.array(told["positions"])[0, :1]], [scene["objects"][0]["position"]], atol=1e-8
    )
    same = ask(service, actions=PUSH, state=scene).json()  # what was told of the scene can be sent as it is
    np.testing.assert_allclose(same["positions"], told["positions"], atol=1e-6)
    assert service.get(f"/api/scenes/{scene['id']}").json()["revision"] == scene["revision"]  # nothing has moved


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"actions": [[[0.4, 0, 0]]]}, "action 0 of sequence 0"),
        ({"actions": [[[0.1, 0, 0.1]]]}, "(vx, vy, 0)"),
        ({"actions": []}, "/actions"),
        ({"actions": [[]]}, "/actions/0"),
        ({"actions": [[[0, 0, 0]] * 10_000]}, "200"),
        ({"actions": [[[0, 0, 0]]] * 1001}, "1000"),
        ({"actions": [[[0, 0, 0]] * 2, [[0, 0, 0]]]}, "lengths of the sequences is [1, 2]"),
        ({"actions": [[[0, 0, 0]] * 199] * 520}, f"at most {MAX_POSES}"),
        ({"actions": [[[0, 0]]]}, "/actions/0/0"),
        ({"actions": [[0, 0, 0]]}, "/actions/0/0"),
        ({"actions": "left"}, "/actions"),
        ({}, "/actions"),
        ({"actions": PUSH, "state": {**STATE, "pusher": None}}, "pusher of the state is missing"),
        ({"actions": PUSH, "state": {**STATE, "objects": []}}, "/state/objects"),
        ({"actions": PUSH, "state": state(name="teapot")}, "no object with a field named 'teapot'"),
        ({"actions": PUSH, "state": state(quaternion=[1, 1, 0, 0])}, "quaternion"),
        ({"actions": PUSH, "state": state(quaternion=[1, 0, 0])}, "/quaternion"),
        ({"actions": PUSH, "state": state(position=[0, 0, 1000])}, "/position/2"),
        ({"actions": PUSH, "state": {**STATE, "light": {"position": [1, 0, -1]}}}, "light elevation"),
        ({"actions": PUSH, "colour": "red"}, "/colour"),
        ({"actions": PUSH, "before": state(name="teapot")}, "objects one action ago is teapot"),
        ({"actions": PUSH, "before": STATE, "state": None}, "state is missing"),
    ],
)
def test_mistakes_are_told_in_one_sentence(service, body, words):
    answer = service.post("/api/predictions", json={"state": STATE, **body})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert words in answer.text


def test_a_push_is_tried_on_the_table_that_is_shown(service, scene):
    assert service.delete("/api/push").status_code == 204
    assert service.get("/api/push").status_code == 404
    assert service.post("/api/push/execute").status_code == 409
    x, y, _ = scene["pusher"]["position"]
    chosen = service.put("/api/push", json={"target": [x + 0.1, y], "speed": 0.25})
    assert chosen.status_code == 200, chosen.text
    assert chosen.json()["revision"] == scene["revision"]
    np.testing.assert_allclose(np.sum(chosen.json()["actions"], axis=0), [0.5, 0, 0], atol=1e-9)
    until(lambda: service.get("/api/push").json()["state"] == "predicted")
    assert [row["name"] for row in service.get("/api/push").json()["objects"]] == [o["name"] for o in scene["objects"]]
    done = service.post("/api/push/execute").json()
    assert done["state"] == "executed"
    assert all(row["off_mm"] is not None for row in done["objects"])
    moved = service.get(f"/api/scenes/{scene['id']}").json()
    assert moved["pusher"]["position"][0] == pytest.approx(x + 0.1, abs=0.01)


@pytest.mark.parametrize("body", [{"target": [0.1]}, {"target": ["a", 0]}, {"speed": 3}, {"speed": 0}, {"way": 1}])
def test_mistakes_in_a_push_are_refused(service, scene, body):
    assert service.put("/api/push", json=body).status_code == 422


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_no_number_but_finite_ones(service, number):
    text = json.dumps({"actions": [[[12345, 0, 0]]], "state": STATE}).replace("12345", number)
    answer = service.post("/api/predictions", content=text, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    assert "/actions/0/0/0" in answer.text


@pytest.mark.slow
def test_without_a_scene_or_with_an_object_that_has_no_field(library, tmp_path):
    library_name = "my_box"
    with running(library, tmp_path) as client:
        assert client.post("/api/predictions", json={"actions": PUSH}).status_code == 409
        (tmp_path / "objects" / library_name).mkdir()
        for file in (tmp_path / "objects" / BOX).iterdir():
            if file.is_file():
                (tmp_path / "objects" / library_name / file.name).write_bytes(
                    file.read_bytes().replace(BOX.encode(), library_name.encode())
                )
        made = client.post("/api/scenes", json={"seed": 1, "objects": [library_name]})
        assert made.status_code == 201, made.text
        answer = client.post("/api/predictions", json={"actions": PUSH})
        assert answer.status_code == 409
        assert "no field yet for my_box" in answer.json()["detail"]
        write_box(tmp_path, library_name, library.size_m(BOX), (0.4, 0.1, 0.1))
        assert client.post("/api/predictions", json={"actions": PUSH}).status_code == 200


@pytest.mark.slow
def test_a_broken_network_is_a_conflict_in_words(library, tmp_path):
    (tmp_path / "dynamics").mkdir()
    (tmp_path / "dynamics" / "pushes.safetensors").write_bytes(b"broken")
    with running(library, tmp_path) as client:
        answer = client.post("/api/predictions", json={"actions": PUSH, "state": STATE})
        assert answer.status_code == 409
        assert "pushes.safetensors" in answer.json()["detail"]


def test_the_model_as_published_predicts_when_it_is_asked_for(service):
    body = {"state": STATE, "actions": [[[0.3, 0, 0]] * 4, [[-0.3, 0, 0]] * 4]}
    ours, theirs = (np.array(ask(service, **body, method=method).json()["positions"]) for method in ("ours", "paper"))
    assert ours.shape == theirs.shape == (2, 5, 1, 3)
    np.testing.assert_allclose(theirs[:, 0], ours[:, 0], atol=1e-9)
    assert not np.allclose(theirs[0, -1], ours[0, -1], atol=1e-4)
    assert theirs[0, -1, 0, 0] > 0.01  # it was pushed
    refused = ask(service, **body, before=STATE, method="paper")
    assert refused.status_code == 422
    assert "left out with the method as published" in refused.json()["detail"]


RECORDED = record().state
OBJECT = {"name": "a", "position": [0, 0, 0.1], "quaternion": [1, 0, 0, 0]}


def test_files_can_be_sent_as_they_are():
    count = len(RECORDED.names)
    estimated = EstimatedState(RECORDED, np.full(count, 0.001), np.full(count, 0.01), 0.1, ("",) * count, "")
    for told in (scene_to_json(Scene(RECORDED, default_cameras())), estimated_to_json(estimated)):
        state = StateIn.model_validate(told).state()
        assert state.names == RECORDED.names
        np.testing.assert_allclose(state.poses.position, RECORDED.poses.position, atol=1e-12)
        np.testing.assert_allclose(state.light.position, RECORDED.light.position, atol=1e-12)


def test_light_and_pusher_may_be_missing():
    state = StateIn.model_validate({"objects": [OBJECT]}).state()
    assert state.pusher is None
    np.testing.assert_array_equal(state.light.position, [0, 0, 1])


@pytest.mark.parametrize(
    ("changed", "words"), [({"quaternion": [1, 1, 0, 0]}, "quaternion"), ({"quaternion": [0, 0, 0, 0]}, "quaternion")]
)
def test_quaternions_are_unit(changed, words):
    with pytest.raises(InvalidInput, match=words):
        StateIn.model_validate({"objects": [OBJECT | changed]}).state()


def test_an_object_is_there_once():
    with pytest.raises(InvalidInput, check=about("objects")):
        StateIn.model_validate({"objects": [OBJECT, OBJECT]}).state()


@pytest.mark.parametrize("actions", [[], [[]], [[0.1, 0, 0]], [[[0.1, 0]]], [[[float("nan"), 0, 0]]], [[[0, 0, "0"]]]])
def test_actions_have_three_levels_of_finite_numbers(actions):
    with pytest.raises(ValidationError):
        PredictionIn.model_validate({"actions": actions})
