import numpy as np
import pytest
from pydantic import ValidationError

from app.api.schemas.common import LightIn, SceneIn, SceneOut
from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import goal_camera
from osfcore.io.scene_file import CameraJson
from tests.app.storage.test_database import record
from tests.support.errors import about


def test_a_scene_says_what_the_record_says():
    kept = record()
    out = SceneOut.of(kept, {"x": "Box"}, is_current=True)
    assert [o.label for o in out.objects] == ["Box", "y"]
    assert out.objects[1].position == [0.3, 0.0, 0.1]
    assert [c.name for c in out.cameras] == ["0", "1", "2", "3", "goal"]
    assert {(c.width, c.height) for c in out.cameras} == {(128, 128)}
    assert out.pusher is not None
    assert SceneOut.of(record(pusher=None), {}, is_current=False).pusher is None


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
