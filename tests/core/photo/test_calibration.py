"""Calibration: camera file, calibration."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.board_views import board_photograph
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.io.files import write_json
from osfcore.io.scene_file import CameraJson, camera_from_json
from osfcore.photo.board import planar_pose
from osfcore.photo.calibration import (
    TooLittleSeen,
    assess,
    board_place,
    calibrated_camera,
    calibration_to_json,
    known_camera,
    read_camera,
    sight,
)
from osfcore.photo.read_photograph import RawPhotograph
from osfcore.photo.summary import locate_calibrated
from tests.core.photo.seen_boards import RADIAL, SIZE, VARIED, K, on_table, project, sighting, sightings

# camera.json: what is written is read, and photographs of any size are taken as the calibrated camera's.


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


# A camera from several sightings of the board: exact without noise, as far off as predicted with it, or refused.


TABLE_CAMERA = Camera.look_at("table", (0.0, -0.5, 0.65), (0.0, 0.0, 0.0)).T_world_camera
PLACE = board_place(0.05, -0.03, 20.0)
FRONTAL = ((0, 0),) * 6


def table_sighting(noise_px=0.0, rng=None):
    return sighting("table.jpg", TABLE_CAMERA.inverse() @ PLACE, noise_px, rng)


def grid():
    """The table's workspace, 9 x 9 points."""
    line = np.linspace(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, 9)
    return np.stack(np.meshgrid(line, line, [0.0]), axis=-1).reshape(-1, 3)


def test_without_noise_the_camera_is_found_exactly():
    found = calibrated_camera(sightings(), table_sighting(), PLACE)
    np.testing.assert_allclose(found.lens.intrinsics, K, atol=1e-6)
    assert found.lens.radial == pytest.approx(RADIAL, abs=1e-7)
    np.testing.assert_allclose(found.T_world_camera.matrix(), TABLE_CAMERA.matrix(), atol=1e-7)
    assert max(found.rms_px.values()) < 1e-6
    assert list(found.rms_px) == [*(view.name for view in sightings()), "table.jpg"]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.15, 0.3])
def test_predicted_errors_are_those_of_many_noisy_calibrations(noise):
    rng, points = np.random.default_rng(2), grid()
    seen = project(TABLE_CAMERA.inverse(), points)
    inside = np.all((seen > 0) & (seen < (640, 480)), axis=1)
    runs = [calibrated_camera(sightings(VARIED, noise, rng), table_sighting(noise, rng), PLACE) for _ in range(40)]
    off = np.array([on_table(run, seen[inside]) - points[inside] for run in runs])
    true = np.sqrt(np.square(off).sum(axis=2).mean(axis=0))
    assert np.mean([run.table.mean_m for run in runs]) == pytest.approx(true.mean(), rel=0.25)
    assert np.mean([run.table.worst_m for run in runs]) == pytest.approx(true.max(), rel=0.35)
    focal = [run.lens.intrinsics[0, 0] for run in runs]
    assert np.mean([run.focal_std_px for run in runs]) == pytest.approx(np.std(focal), rel=0.35)
    assert np.mean(focal) == pytest.approx(K[0, 0], abs=3 * np.std(focal) / np.sqrt(len(runs)))
    assert np.mean([run.noise_px for run in runs]) == pytest.approx(noise, rel=0.1)
    assert runs[0].table.seen_share == inside.mean()


@pytest.mark.parametrize("tilts", [VARIED[1:4], pytest.param(VARIED, marks=pytest.mark.slow)])
def test_without_a_photo_of_the_table_errors_are_those_of_a_later_one(tilts):
    rng, points, noise = np.random.default_rng(3), grid(), 0.15
    later = Camera.look_at("later", (0.0, -0.58, 0.69), (0.0, 0.0, 0.0)).T_world_camera  # shows all of the workspace
    seen = project(later.inverse(), points)
    assert np.all((seen > 0) & (seen < (640, 480)))
    off, told = [], []
    for _ in range(25):
        run = calibrated_camera(sightings(tilts, noise, rng))
        told.append(run.table.mean_m)
        board = sighting("later.jpg", later.inverse(), noise, rng)
        straight = cv2.undistortPoints(
            board.points_px[:, None], run.lens.intrinsics, np.array([run.lens.radial, 0, 0, 0]), P=run.lens.intrinsics
        )[:, 0]
        pose, _ = planar_pose(board.points_m, straight, run.lens.intrinsics)
        off.append(on_table(replace(run, T_world_camera=pose), seen) - points)
    true = np.sqrt(np.square(off).sum(axis=2).mean(axis=0)).mean()
    assert np.mean(told) == pytest.approx(true, rel=0.3)


def test_errors_grow_with_the_noise_and_shrink_with_photos():
    def told(count, noise):
        tilts = VARIED * (count // len(VARIED))
        return assess(sightings(tilts, noise, np.random.default_rng(0)))

    assert told(6, 0.6).table.mean_m == pytest.approx(3 * told(6, 0.2).table.mean_m, rel=0.2)
    assert told(24, 0.2).table.mean_m < told(6, 0.2).table.mean_m
    assert told(24, 0.2).focal_std_px == pytest.approx(told(6, 0.2).focal_std_px / 2, rel=0.2)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_a_board_seen_from_straight_above_does_not_tell_focal_length_from_distance(noise):
    for seed in range(3):
        views = sightings(FRONTAL, noise, np.random.default_rng(seed))
        with pytest.raises(TooLittleSeen, match=r"focal length from distance; in the next, .* 30 to 45 degrees"):
            calibrated_camera(views)


@pytest.mark.parametrize("tilts", [VARIED, FRONTAL])
def test_what_the_advice_promises_comes_true(tilts):
    before = assess(sightings(tilts, 0.1, np.random.default_rng(4)))
    assert before.advice is not None
    assert before.advice.mean_m < before.table.mean_m


def test_one_tilted_photo_among_frontal_ones_tells_more_than_all_of_them():
    frontal = assess(sightings(FRONTAL, 0.05, np.random.default_rng(0)))
    tilted = assess(sightings((*FRONTAL, (40, 0)), 0.05, np.random.default_rng(0)))
    assert tilted.focal_std_px < frontal.focal_std_px / 10


def test_two_photos_are_too_few():
    with pytest.raises(TooLittleSeen, match="number of photos of the board is 2, but it must be 3 or more"):
        calibrated_camera(sightings(VARIED[:2]))
    with pytest.raises(InvalidInput, match="number of photos of the board is 0"):
        assess([])


def test_a_photo_with_another_zoom_is_named():
    views, zoomed = sightings(VARIED, 0.05, np.random.default_rng(1)), K.copy()
    zoomed[[0, 1], [0, 1]] *= 1.15
    odd = sightings(VARIED, 0.05, np.random.default_rng(2), zoomed)[1]
    with pytest.raises(CorruptFile, match=r"b\.jpg cannot be used: the board's corners in it lie .* other photos"):
        assess([views[0], odd, *views[2:]])


def test_photos_that_nobody_could_have_taken_with_one_camera_are_refused():
    with pytest.raises(InvalidInput, match="mean distance of the board's corners"):
        assess(sightings(VARIED, 3.0, np.random.default_rng(1)))


def test_photos_of_one_name_are_told_apart():
    views = [replace(view, name="image.jpg") for view in sightings()]
    assert list(assess(views).rms_px)[:2] == ["image.jpg", "image.jpg (2)"]


def test_a_photo_of_another_size_or_sent_twice_is_named():
    views = sightings()
    portrait = sighting("d.jpg", Pose(np.array([0, 0, 0.5]), np.array([0.0, 1, 0, 0])), size=(480, 640))
    with pytest.raises(CorruptFile, match=r"d\.jpg cannot be used: it has 480 x 640 pixels and a\.jpg has 640 x 480"):
        assess([*views, portrait])
    with pytest.raises(CorruptFile, match=r"it shows the same as a\.jpg"):
        assess([*views, views[0]])


def test_a_board_beside_the_picture_shows_no_workspace():
    far = board_place(0.55, 0.55, 0.0)
    camera = Camera.look_at("aside", (0.35, 0.35, 0.15), (0.55, 0.55, 0.0)).T_world_camera
    with pytest.raises(TooLittleSeen, match="part of the workspace in the photo of the table is none"):
        calibrated_camera(sightings(), sighting("t.jpg", camera.inverse() @ far), far)


def test_the_place_of_the_board_moves_the_camera_with_it():
    moved = [assess(sightings(), table_sighting(), place) for place in (PLACE, board_place(0.05, 0.07, 110.0))]
    first, second = (found.T_world_camera for found in moved)
    assert np.rad2deg(rotation_angle(first.quaternion, second.quaternion)) == pytest.approx(90.0, abs=1e-6)
    assert first.position[2] == pytest.approx(second.position[2])
    with pytest.raises(InvalidInput, match="x of the board"):
        board_place(5.0, 0.0, 0.0)
