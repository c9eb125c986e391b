import numpy as np
import pytest

from app.services.disturber import Disturber
from osfcore.errors import UnknownName
from tests.app.conftest import until

OBJECTS = ["006_mustard_bottle", "005_tomato_soup_can"]


@pytest.fixture
def scene(service):
    made = service.post("/api/scenes", json={"objects": OBJECTS, "seed": 4}).json()
    yield made
    service.delete(f"/api/scenes/{made['id']}")


@pytest.fixture
def disturb(service, scene):
    def disturb(kind):
        answer = service.post(f"/api/scenes/{scene['id']}/disturbances", json={"kind": kind})
        assert answer.status_code == 200, answer.json()
        return answer.json()

    return disturb


def seen(services, scene):
    """What the robot's cameras report."""
    return services.runner.scenes.observe(scene["id"], goal=False, masks=False).observation.images


def test_a_turned_lamp_is_as_far_away_as_is_told(disturb, scene):
    done = disturb("turn lamp")
    before, after = np.array(scene["light"]["position"]), np.array(done["scene"]["light"]["position"])
    angle_deg = np.rad2deg(np.arccos(np.clip(before @ after, -1, 1)))
    assert done["text"] == f"The lamp was moved by {angle_deg:.0f}°."
    assert angle_deg > 20


def test_one_object_is_nudged_by_as_much_as_is_told(disturb, scene):
    done = disturb("nudge object")
    shifts = {
        b["name"]: np.linalg.norm(np.subtract(a["position"], b["position"])[:2])
        for a, b in zip(scene["objects"], done["scene"]["objects"], strict=True)
    }
    (moved,) = [name for name, shift in shifts.items() if shift > 0.02]
    assert done["text"].startswith(moved)
    assert shifts[moved] == pytest.approx(0.055, abs=0.03)


def test_dimming_and_covering_change_what_cameras_see_until_asked_again(disturb, scene, services):
    before = seen(services, scene)
    assert "45 %" in disturb("dim light")["text"]
    np.testing.assert_allclose(seen(services, scene), 0.45 * before, atol=0.01)
    text = disturb("cover camera")["text"]
    dark = [view for view, image in enumerate(seen(services, scene)) if image.max() == 0]
    assert text == f"Camera {dark[0]} is covered."
    assert len(dark) == 1
    disturb("cover camera")
    disturb("dim light")
    np.testing.assert_array_equal(seen(services, scene), before)


def test_putting_the_scene_back_ends_it(disturb, service, scene, services):
    before = seen(services, scene)
    disturb("dim light")
    service.post(f"/api/scenes/{scene['id']}/reset")
    np.testing.assert_array_equal(seen(services, scene), before)
    assert "45 %" in disturb("dim light")["text"]  # not undone: it was over already


def test_the_end_of_an_episode_ends_it(disturb, scene, services):
    jobs = services.runner.jobs
    before = seen(services, scene)
    disturb("dim light")
    episode = jobs.submit("episode", {"scene": scene["id"]})
    jobs.cancel(episode.id)
    until(lambda: np.array_equal(seen(services, scene), before))
    until(lambda: jobs.get(episode.id).is_finished)
    jobs.forget(episode.id)


def test_what_does_not_exist_is_told(services, service, scene):
    with pytest.raises(UnknownName):
        Disturber(services.runner.scenes, np.random.default_rng(0)).disturb("nobody", "dim light")
    assert service.post("/api/scenes/nobody/disturbances", json={"kind": "dim light"}).status_code == 404
    assert service.post(f"/api/scenes/{scene['id']}/disturbances", json={"kind": "shout"}).status_code == 422
