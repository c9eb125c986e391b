"""camera.json: what is written is read, and photographs of any size are taken as the calibrated camera's."""

import json

import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.board_views import board_photograph
from osfcore.geometry.cameras import Camera
from osfcore.io.files import write_json
from osfcore.io.scene_file import CameraJson, camera_from_json
from osfcore.photo.calibration import calibrated_camera, calibration_to_json, known_camera, read_camera, sight
from osfcore.photo.read_photograph import RawPhotograph
from osfcore.photo.summary import locate_calibrated
from tests.core.photo.seen_boards import RADIAL, SIZE, K, sighting, sightings

POSE = Camera.look_at("table", (0.0, -0.35, 0.4), (0.0, 0.0, 0.0)).T_world_camera


@pytest.fixture(scope="module")
def found():
    return calibrated_camera(sightings(), sighting("table.jpg", POSE.inverse()))


@pytest.fixture(scope="module")
def raw():
    """A photograph of the board on the table by that camera."""
    view = board_photograph(np.random.default_rng(0), SIZE, camera=(POSE, K), radial=RADIAL)
    return RawPhotograph(view.image, "srgb", (4 * SIZE[0], 4 * SIZE[1]), None, ())


def test_what_is_written_is_read(found, tmp_path):
    write_json(tmp_path / "camera.json", calibration_to_json(found, "phone"))
    camera = read_camera(tmp_path / "camera.json")
    np.testing.assert_allclose(camera.lens.intrinsics, found.lens.intrinsics, atol=1e-12)
    assert camera.lens.radial == found.lens.radial
    np.testing.assert_allclose(camera.T_world_camera.matrix(), found.T_world_camera.matrix(), atol=1e-12)
    assert camera.size == SIZE


def test_it_is_a_camera_as_in_a_scene(found):
    camera = camera_from_json(json.loads(json.dumps(calibration_to_json(found, "phone"))))
    assert (camera.name, camera.width, camera.height) == ("phone", *SIZE)
    entry = CameraJson.of(camera)
    assert known_camera(entry.model_dump()).lens.radial == 0


def test_a_reduced_photograph_is_that_of_the_camera_with_fewer_pixels(found):
    lens = known_camera(calibration_to_json(found, "phone")).lens_at((320, 240))
    np.testing.assert_allclose(lens.intrinsics[:2], K[:2] / 2, atol=1e-6)
    with pytest.raises(InvalidInput, match=r"size of the photo .* is 480 x 640.* 640 x 480, uncropped"):
        known_camera(calibration_to_json(found, "phone")).lens_at((480, 640))


def test_a_photograph_is_straightened_and_placed_as_calibrated(found, raw):
    fixed = known_camera(calibration_to_json(found, "phone"))
    located = locate_calibrated(raw, fixed)
    assert (located.source, located.T_world_camera) == ("given", fixed.T_world_camera)
    again = locate_calibrated(raw, known_camera({**calibration_to_json(found, "phone"), "T_world_camera": None}))
    np.testing.assert_allclose(again.T_world_camera.matrix(), POSE.matrix(), atol=2e-3)
    np.testing.assert_allclose(again.intrinsics, K, atol=1e-5)


def test_a_photograph_without_a_board_has_no_place_if_the_calibration_has_none(found, raw):
    blank = RawPhotograph(np.full_like(raw.encoded, 128), "srgb", SIZE, None, ())
    located = locate_calibrated(blank, known_camera({**calibration_to_json(found, "phone"), "T_world_camera": None}))
    assert located.T_world_camera is None
    assert "board" in located.missing


def test_a_photograph_without_a_board_is_named():
    blank = RawPhotograph(np.full((480, 640, 3), 128, np.uint8), "srgb", SIZE, None, ())
    with pytest.raises(CorruptFile, match=r"wall\.jpg cannot be used: .*board"):
        sight(blank, "wall.jpg")


def test_corners_are_told_in_pixels_of_the_photograph_as_it_was_sent(raw):
    seen = sight(raw, "table.jpg")
    expected = 4 * sighting("table.jpg", POSE.inverse()).points_px
    assert len(seen.points_px) == len(expected)
    assert np.abs(seen.points_px - expected).max() < 4 * 0.1


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"K": [[560, 5, 1], [0, 560, 1], [0, 0, 1]]}, "K of the camera"),
        ({"K": [[1.0, 0, 320], [0, 560, 240], [0, 0, 1]]}, "focal length of the camera"),
        ({"K": [[560, 0, 9999], [0, 560, 240], [0, 0, 1]]}, "principal point"),
        ({"radial": 9.0}, "radial of the camera"),
        ({"T_world_camera": np.diag([2.0, 1, 1, 1]).tolist()}, "T_world_camera"),
        ({"width": 0}, "width"),
        ({"K": "wide"}, "K"),
    ],
)
def test_wrong_cameras_are_refused(found, change, what):
    data = json.loads(json.dumps({**calibration_to_json(found, "phone"), **change}))
    with pytest.raises(InvalidInput, match=what):
        known_camera(data)
