import io

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from app.api.models import LightIn
from app.api.scenes import SceneIn, SceneOut, scene_out
from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.workspace import STEP_S
from osfcore.io.scene_file import CameraJson
from tests.app.api.test_problems import is_problem
from tests.app.conftest import running
from tests.app.storage.test_database import record
from tests.support.errors import about

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"
UPRIGHT = [1.0, 0.0, 0.0, 0.0]


def pixels(answer):
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "image/png"
    return np.array(Image.open(io.BytesIO(answer.content)))


def resting(service, name, x=0.0, y=0.0):
    """A pose in which an object stands on the table."""
    half_height = service.get(f"/api/objects/{name}").json()["size_m"][2] / 2
    return {"name": name, "position": [x, y, half_height], "quaternion": UPRIGHT}


def test_the_same_seed_makes_the_same_scene(service):
    first, second = (service.post("/api/scenes", json={"seed": 4, "count": 2}) for _ in range(2))
    assert first.status_code == 201
    assert service.get(first.headers["location"]).json() == {**first.json(), "is_current": False}
    for key in ("objects", "light", "pusher", "cameras", "seed"):
        assert first.json()[key] == second.json()[key]
    for answer in (first, second):
        assert service.delete(answer.headers["location"]).status_code == 204


def test_without_a_seed_one_is_drawn_and_told(service):
    made = service.post("/api/scenes", json={"count": 1})
    again = service.post("/api/scenes", json={"count": 1, "seed": made.json()["seed"]})
    assert again.json()["objects"] == made.json()["objects"]
    for answer in (made, again):
        service.delete(answer.headers["location"])


def test_exact_poses_and_light_are_taken(service):
    poses = [resting(service, BOX, 0.1), resting(service, BOTTLE, -0.1)]
    made = service.post("/api/scenes", json={"poses": poses, "light": {"position": [0, 2, 2]}, "seed": 0}).json()
    assert [o["name"] for o in made["objects"]] == [BOX, BOTTLE]
    for told, wanted in zip(made["objects"], poses, strict=True):
        assert np.allclose(told["position"], wanted["position"], atol=1e-9)
        assert np.allclose(told["quaternion"], UPRIGHT, atol=1e-9)
    assert np.allclose(made["light"]["position"], [0, 0.5**0.5, 0.5**0.5])
    service.delete(f"/api/scenes/{made['id']}")


def test_the_simulator_that_was_chosen_moves_things_and_is_told(library, tmp_path):
    with running(library, tmp_path, simulator="mujoco") as client:
        made = client.post("/api/scenes", json={"seed": 4, "count": 1}).json()
        pushed = client.post(f"/api/scenes/{made['id']}/actions", json={"actions": [[0.1, 0.0, 0.0]]}).json()
    assert made["simulator"] == "mujoco"
    assert pushed["time_s"] > 0


def test_a_new_scene_is_shown_and_can_be_left_again(service, scene):
    other = service.post("/api/scenes", json={"count": 1, "seed": 2}).json()
    assert service.get("/api/scenes").json()["current"] == other["id"]
    assert service.post(f"/api/scenes/{scene['id']}/activate").json()["is_current"]
    assert service.get("/api/scenes").json()["current"] == scene["id"]
    service.post(f"/api/scenes/{other['id']}/activate")
    service.delete(f"/api/scenes/{other['id']}")
    assert service.get("/api/scenes").json()["current"] != other["id"]
    is_problem(service.get(f"/api/scenes/{other['id']}"), 404)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"objects": ["teapot"]}, "teapot"),
        ({"objects": [BOX, BOX]}, "without repetition"),
        ({"objects": [BOX], "poses": [{"name": BOTTLE, "position": [0, 0, 0.1], "quaternion": UPRIGHT}]}, "poses"),
        ({"light": {"position": [1, 0, -0.5]}}, "elevation"),
        ({"light": {"position": [0, 0, 0]}}, "away from"),
        ({"count": 8}, "at most 5"),
        ({"count": 9}, "count"),
        ({"image_size": 2000}, "image_size"),
        ({"poses": [{"name": BOX, "position": [0, 0, 0.2], "quaternion": [1, 1, 0, 0]}]}, "unit quaternion"),
        ({"poses": [{"name": BOX, "position": [0, 0, 0.03], "quaternion": UPRIGHT}]}, "overlap"),
        (
            {
                "poses": [
                    {"name": BOX, "position": [0, 0, 0.2], "quaternion": UPRIGHT},
                    {"name": BOTTLE, "position": [0, 0, 0.2], "quaternion": UPRIGHT},
                ]
            },
            "overlap",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_words(service, body, words):
    before = service.get("/api/scenes").json()
    assert words in str(is_problem(service.post("/api/scenes", json=body), 422))
    assert service.get("/api/scenes").json() == before


def test_pushing_moves_the_pusher_and_the_clock(service, scene):
    actions = [[0.1, 0.05, 0.0], [-0.1, 0.05, 0.0]]
    after = service.post(f"/api/scenes/{scene['id']}/actions", json={"actions": actions}).json()
    moved = np.subtract(after["pusher"]["position"], scene["pusher"]["position"])
    assert np.allclose(moved, [0, 0.1 * STEP_S, 0], atol=2e-3)
    assert after["time_s"] == pytest.approx(2 * STEP_S)
    assert after["revision"] > scene["revision"]
    assert service.get(f"/api/scenes/{scene['id']}").json() == after


def test_reset_brings_everything_back(service, scene):
    address = f"/api/scenes/{scene['id']}"
    service.post(f"{address}/actions", json={"actions": [[0.2, 0.2, 0.0]] * 3})
    service.patch(address, json={"light": {"position": [0, 0, 1]}})
    back = service.post(f"{address}/reset").json()
    for told, first in zip(back["objects"], scene["objects"], strict=True):
        assert np.allclose(told["position"], first["position"], atol=1e-9)
        assert np.allclose(told["quaternion"], first["quaternion"], atol=1e-9)
    for key in ("light", "pusher", "time_s"):
        assert back[key] == scene[key]


@pytest.mark.parametrize("actions", [[], [[0.4, 0, 0]], [[0.1, 0, 0.1]], [[0.1, 0]], [[0.1, 0, 0]] * 51])
def test_wrong_actions_move_nothing(service, scene, actions):
    is_problem(service.post(f"/api/scenes/{scene['id']}/actions", json={"actions": actions}), 422)
    assert service.get(f"/api/scenes/{scene['id']}").json() == scene


def test_objects_are_moved_all_or_nothing(service):
    poses = [resting(service, BOX, 0.1), resting(service, BOTTLE, -0.1)]
    made = service.post("/api/scenes", json={"poses": poses, "seed": 0}).json()
    address = f"/api/scenes/{made['id']}"
    swapped = [resting(service, BOX, -0.1), resting(service, BOTTLE, 0.1)]
    after = service.patch(address, json={"objects": swapped}).json()
    assert np.allclose([o["position"][0] for o in after["objects"]], [-0.1, 0.1], atol=1e-9)
    on_top = [resting(service, BOX, 0.1)]
    assert "overlap" in is_problem(service.patch(address, json={"objects": on_top}), 422)["detail"]
    both = [resting(service, BOX, 0.0, 0.15), resting(service, BOTTLE, 0.0, 0.15)]
    is_problem(service.patch(address, json={"objects": both}), 422)
    is_problem(service.patch(address, json={"objects": [resting(service, "009_gelatin_box")]}), 422)
    is_problem(service.patch(address, json={"objects": on_top * 2}), 422)
    assert service.get(address).json()["objects"] == after["objects"]
    service.delete(address)


def test_pictures_have_the_size_asked_for(service, scene):
    address = f"/api/scenes/{scene['id']}/images"
    assert pixels(service.get(f"{address}/0.png")).shape == (128, 128, 3)
    assert pixels(service.get(f"{address}/goal.png?size=40")).shape == (40, 40, 3)
    for query in ("size=15", "size=1025", "size=x", "masks=perhaps"):
        is_problem(service.get(f"{address}/0.png?{query}"), 422)
    is_problem(service.get(f"{address}/4.png"), 404)
    is_problem(service.get("/api/scenes/none/images/0.png"), 404)


def test_the_light_changes_the_picture_and_back(service, scene):
    address = f"/api/scenes/{scene['id']}"
    service.patch(address, json={"light": {"position": [1, 0, 0.3]}})
    first = pixels(service.get(f"{address}/images/0.png?size=64"))
    service.patch(address, json={"light": {"position": [-1, 0, 0.3]}})
    second = pixels(service.get(f"{address}/images/0.png?size=64"))
    assert not np.array_equal(first, second)
    service.patch(address, json={"light": {"position": [1, 0, 0.3]}})
    assert np.array_equal(first, pixels(service.get(f"{address}/images/0.png?size=64")))


def test_without_the_pusher_it_is_not_seen(service, scene):
    address = f"/api/scenes/{scene['id']}/images/goal.png?size=96"
    assert not np.array_equal(pixels(service.get(address)), pixels(service.get(f"{address}&pusher=false")))


def test_masks_are_binary_disjoint_and_drawn(service, scene):
    address = f"/api/scenes/{scene['id']}"
    names = [o["name"] for o in scene["objects"]]
    masks = [pixels(service.get(f"{address}/masks/1/{name}.png?size=96")) for name in names]
    for mask in masks:
        assert mask.shape == (96, 96)
        assert set(np.unique(mask)) == {0, 255}
    assert not np.any((masks[0] > 0) & (masks[1] > 0))
    plain = pixels(service.get(f"{address}/images/1.png?size=96"))
    drawn = pixels(service.get(f"{address}/images/1.png?size=96&masks=true"))
    assert np.array_equal(np.any(plain != drawn, axis=-1), (masks[0] > 0) | (masks[1] > 0))
    is_problem(service.get(f"{address}/masks/1/teapot.png"), 404)


@pytest.mark.parametrize(("method", "tail"), [("get", ""), ("delete", ""), ("post", "/reset"), ("post", "/activate")])
def test_missing_scenes_are_not_found(service, method, tail):
    is_problem(getattr(service, method)(f"/api/scenes/none{tail}"), 404)


def test_an_image_of_a_scene_deleted_meanwhile_is_not_found(service, services, scene, monkeypatch):
    async def gone(command):
        services.runner.delete_scene(command.id)
        raise UnknownName("scene", "a", [])

    monkeypatch.setattr(services.runner.scenes, "image", gone)
    is_problem(service.get(f"/api/scenes/{scene['id']}/images/0.png"), 404)


def test_a_scene_says_what_the_record_says():
    kept = record()
    out = SceneOut.of(kept, {"x": "Box"}, "mujoco", is_current=True)
    assert [o.label for o in out.objects] == ["Box", "y"]
    assert out.objects[1].position == [0.3, 0.0, 0.1]
    assert [c.name for c in out.cameras] == ["0", "1", "2", "3", "goal"]
    assert {(c.width, c.height) for c in out.cameras} == {(128, 128)}
    assert out.pusher is not None
    assert SceneOut.of(record(pusher=None), {}, "mujoco", is_current=False).pusher is None


def test_cameras_project_as_the_core_does():
    camera = goal_camera(64)
    out = CameraJson.of(camera)
    point = np.array([0.1, -0.05, 0.02, 1.0])
    pixel = np.array(out.K) @ (np.linalg.inv(np.array(out.T_world_camera)) @ point)[:3]
    assert np.allclose(pixel[:2] / pixel[2], camera.project(point[:3]))


def test_unknown_fields_are_mistakes():
    with pytest.raises(ValidationError):
        SceneIn.model_validate({"objekts": []})


def test_a_light_below_the_table_is_refused():
    with pytest.raises(InvalidInput, check=about("elevation")):
        LightIn(position=[1, 0, -0.1]).light()


def test_a_scene_knows_whether_it_is_shown(services, scene):
    record = services.runner.scenes.get(scene["id"])
    assert scene_out(services, record).is_current
    assert scene_out(services, record).objects[0].label == "Cracker box"
