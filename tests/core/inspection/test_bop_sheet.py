"""A scene of BOP is judged as a whole: numbers that fit, and one sentence for those that do not."""

import json

import cv2
import numpy as np
import pytest

from osfcore.errors import CorruptFile
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation, SceneState
from osfcore.inspection.check import check_path, draw_overlay
from tests.core.photo.other_programs.bop_scenes import write_bop_scene

NAMES = ("003_cracker_box", "025_mug")
PLACES = np.array([[0.05, 0.1, 0.08], [-0.1, -0.05, 0.04]])


@pytest.fixture
def folder(tmp_path):
    """Two objects, whose masks are squares around their centres."""
    cameras = default_cameras(64)
    masks = np.zeros((4, 2, 64, 64), bool)
    for view, camera in enumerate(cameras):
        for number, (u, v) in enumerate(camera.project(PLACES).astype(int)):
            masks[view, number, v - 4 : v + 4, u - 4 : u + 4] = True
    state = SceneState(NAMES, Pose(PLACES, np.tile([1.0, 0, 0, 0], (2, 1))), Light(np.array([0, 0, 1.0])), None)
    observation = Observation(cameras, np.full((4, 64, 64, 3), 0.4), NAMES, masks, None, 0.0)
    return write_bop_scene(tmp_path / "000001", observation, state)


def edit(path, change):
    content = json.loads(path.read_text())
    for entry in content.values():
        change(entry)
    path.write_text(json.dumps(content))


def test_a_good_scene_passes_and_its_overlay_shows_the_objects(folder, tmp_path):
    report = check_path(folder)
    assert report.kind == "scene of BOP"
    assert report.summary == "4 images of 2 objects, 8 masks, cameras in one world"
    draw_overlay(folder, tmp_path / "overlay.png")
    picture = cv2.imread(str(tmp_path / "overlay.png"))
    assert picture.shape == (288, 4 * 384, 3)
    for colour in ((0, 0, 255), (0, 255, 0), (255, 0, 0)):
        assert np.all(picture == colour, axis=-1).sum() > 50


def test_a_scene_without_places_of_its_cameras_is_still_one(folder):
    edit(folder / "scene_camera.json", lambda entry: entry.pop("cam_R_w2c"))
    assert "cameras without a common world" in check_path(folder).summary


def metres(entries):
    for entry in entries:
        entry["cam_t_m2c"] = [value / 1000 for value in entry["cam_t_m2c"]]


@pytest.mark.parametrize(
    ("file", "change", "sentence"),
    [
        ("scene_gt.json", metres, "before the camera; it is read as mm"),
        ("scene_camera.json", lambda entry: entry.pop("cam_K"), "'cam_K' of 3 is missing"),
        ("scene_camera.json", lambda e: e.update(cam_K=[8 * k for k in e["cam_K"][:8]] + [1.0]), "another image size"),
    ],
)
def test_what_does_not_fit_is_told_in_one_sentence(folder, file, change, sentence):
    edit(folder / file, change)
    with pytest.raises(CorruptFile, match=sentence):
        check_path(folder)
