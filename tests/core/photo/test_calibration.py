"""Calibration: a camera from sightings of the board, the errors that it predicts, its refusals, and its file."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput, OsfError
from osfcore.experiments.board_views import board_photograph
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.io.files import write_json
from osfcore.io.scene_file import camera_from_json
from osfcore.photo.board import Board, planar_pose
from osfcore.photo.calibration import assess, board_place, calibrated_camera, calibration_to_json, sight, workspace_grid
from osfcore.photo.camera_files import known_camera, read_camera
from osfcore.photo.read_photograph import RawPhotograph
from osfcore.photo.summary import locate, locate_calibrated
from tests.support.boards import RADIAL, SIZE, VARIED, K, on_table, project, sighting, sightings, tilted
from tests.support.errors import about

# camera.json: what is written is read, and photographs of any size are taken as the calibrated camera's.


POSE = Camera.look_at("table", (0.0, -0.35, 0.4), (0.0, 0.0, 0.0)).T_world_camera


@pytest.fixture(scope="module")
def found():
    return calibrated_camera(sightings(), sighting("table.jpg", POSE.inverse()))


@pytest.fixture(scope="module")
def camera_json(found):
    return json.loads(json.dumps(calibration_to_json(found, "phone")))


@pytest.fixture(scope="module")
def raw():
    """A photograph of the board on the table by that camera."""
    view = board_photograph(np.random.default_rng(0), SIZE, camera=(POSE, K), radial=RADIAL)
    return RawPhotograph(view.image, "srgb", (4 * SIZE[0], 4 * SIZE[1]), None, ())


def test_what_is_written_is_read_also_as_a_camera_of_a_scene(found, camera_json, tmp_path):
    write_json(tmp_path / "camera.json", camera_json)
    camera = read_camera(tmp_path / "camera.json")
    np.testing.assert_allclose(camera.lens.intrinsics, found.lens.intrinsics, atol=1e-12)
    np.testing.assert_allclose(camera.T_world_camera.matrix(), found.T_world_camera.matrix(), atol=1e-12)
    assert (camera.lens.radial, camera.size) == (found.lens.radial, SIZE)
    plain = camera_from_json(camera_json)
    assert (plain.name, plain.width, plain.height) == ("phone", *SIZE)
    reduced = camera.lens_at((320, 240))  # a photograph with fewer pixels
    np.testing.assert_allclose(reduced.intrinsics[:2], K[:2] / 2, atol=1e-6)
    with pytest.raises(InvalidInput, check=about("size of the photo")):
        camera.lens_at((480, 640))


@pytest.mark.slow
def test_a_photograph_is_straightened_and_placed_as_calibrated(camera_json, raw):
    fixed, free = known_camera(camera_json), known_camera({**camera_json, "T_world_camera": None})
    located = locate_calibrated(raw, fixed, Board())
    assert (located.source, located.T_world_camera) == ("given", fixed.T_world_camera)
    over_board = locate_calibrated(raw, free, Board())
    np.testing.assert_allclose(over_board.T_world_camera.matrix(), POSE.matrix(), atol=2e-3)
    np.testing.assert_allclose(over_board.intrinsics, K, atol=1e-5)
    blank = replace(raw, encoded=np.full_like(raw.encoded, 128))
    nowhere = locate_calibrated(blank, free, Board())
    assert nowhere.T_world_camera is None
    assert "no board" in nowhere.notes[-1]
    assumed, given = locate(blank, None, Board()), locate(blank, 4 * K[0, 0], Board())
    assert (assumed.source, given.source) == ("assumed", "given")
    assert given.intrinsics[0, 0] == K[0, 0]
    assert assumed.T_world_camera is None
    with pytest.raises(InvalidInput, check=about("focal length")):
        locate(blank, 1.0, Board())


@pytest.mark.slow
def test_a_photograph_is_straightened_by_the_camera_of_another_program(raw, tmp_path):
    sent = 4 * K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 3]]
    (tmp_path / "camera_info.yaml").write_text(
        f"image_width: {4 * SIZE[0]}\nimage_height: {4 * SIZE[1]}\ndistortion_model: plumb_bob\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {sent.ravel().tolist()}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: 5, data: [{RADIAL}, 0, 0, 0, 0]}}\n"
    )
    located = locate_calibrated(raw, read_camera(tmp_path / "camera_info.yaml"), Board())
    np.testing.assert_allclose(located.T_world_camera.matrix(), POSE.matrix(), atol=2e-3)
    np.testing.assert_allclose(located.intrinsics, K, atol=1e-9)


def test_corners_are_in_pixels_of_the_photograph_as_it_was_sent(raw):
    expected = 4 * sighting("table.jpg", POSE.inverse()).points_px
    assert np.abs(sight(raw, "table.jpg", Board()).points_px - expected).max() < 4 * 0.1
    with pytest.raises(CorruptFile, check=about("wall.jpg")):
        sight(replace(raw, encoded=np.full_like(raw.encoded, 128)), "wall.jpg", Board())


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"K": [[560, 5, 1], [0, 560, 1], [0, 0, 1]]}, "K of the camera"),
        ({"K": [[1.0, 0, 320], [0, 560, 240], [0, 0, 1]]}, "focal length of the camera"),
        ({"K": [[560, 0, 9999], [0, 560, 240], [0, 0, 1]]}, "principal point"),
        ({"radial": 9.0}, "radial of the camera"),
        ({"T_world_camera": np.diag([2.0, 1, 1, 1]).tolist()}, "T_world_camera"),
        ({"width": 0}, "width"),
    ],
)
def test_wrong_cameras_are_refused(camera_json, change, what):
    with pytest.raises(InvalidInput, check=about(what)):
        known_camera({**camera_json, **change})


# A camera from several sightings of the board: exact without noise, as far off as predicted with it, or refused.


TABLE_CAMERA = Camera.look_at("table", (0.0, -0.5, 0.65), (0.0, 0.0, 0.0)).T_world_camera
PLACE = board_place(0.05, -0.03, 20.0)
FRONTAL = ((0, 0),) * 6


def table_sighting(noise_px=0.0, rng=None):
    return sighting("table.jpg", TABLE_CAMERA.inverse() @ PLACE, noise_px, rng)


def test_without_noise_the_camera_is_found_exactly_and_moves_with_the_place_of_the_board():
    found = calibrated_camera(sightings(), table_sighting(), PLACE)
    np.testing.assert_allclose(found.lens.intrinsics, K, atol=1e-6)
    assert found.lens.radial == pytest.approx(RADIAL, abs=1e-7)
    np.testing.assert_allclose(found.T_world_camera.matrix(), TABLE_CAMERA.matrix(), atol=1e-7)
    assert max(found.rms_px.values()) < 1e-6
    turned = assess(sightings(), table_sighting(), board_place(0.05, 0.07, 110.0)).T_world_camera
    assert np.rad2deg(rotation_angle(turned.quaternion, TABLE_CAMERA.quaternion)) == pytest.approx(90.0, abs=1e-5)
    assert turned.position[2] == pytest.approx(TABLE_CAMERA.position[2])
    with pytest.raises(InvalidInput, check=about("x of the board")):
        board_place(5.0, 0.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.15, 0.3])
def test_predicted_errors_are_those_of_many_noisy_calibrations(noise):
    rng, points = np.random.default_rng(2), workspace_grid()
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


@pytest.mark.slow
@pytest.mark.parametrize("tilts", [VARIED[1:4], VARIED])
def test_without_a_photo_of_the_table_errors_are_those_of_a_later_one(tilts):
    rng, points, noise = np.random.default_rng(3), workspace_grid(), 0.15
    later = Camera.look_at("later", (0.0, -0.58, 0.69), (0.0, 0.0, 0.0)).T_world_camera  # shows all of the workspace
    seen = project(later.inverse(), points)
    off, predicted = [], []
    for _ in range(25):
        run = calibrated_camera(sightings(tilts, noise, rng))
        predicted.append(run.table.mean_m)
        board, K_run = sighting("later.jpg", later.inverse(), noise, rng), run.lens.intrinsics
        straight = cv2.undistortPoints(board.points_px[:, None], K_run, np.array([run.lens.radial, 0, 0, 0]), P=K_run)
        pose, _ = planar_pose(board.points_m, straight[:, 0], K_run)
        off.append(on_table(replace(run, T_world_camera=pose), seen) - points)
    true = np.sqrt(np.square(off).sum(axis=2).mean(axis=0)).mean()
    assert np.mean(predicted) == pytest.approx(true, rel=0.3)


def test_errors_grow_with_the_noise_and_shrink_with_photos():
    def assessed(count, noise):
        return assess(sightings(VARIED * (count // len(VARIED)), noise, np.random.default_rng(0)))

    few, noisy, many = assessed(6, 0.2), assessed(6, 0.6), assessed(24, 0.2)
    assert noisy.table.mean_m == pytest.approx(3 * few.table.mean_m, rel=0.2)
    assert many.table.mean_m < few.table.mean_m
    assert many.focal_std_px == pytest.approx(few.focal_std_px / 2, rel=0.2)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_a_board_seen_from_straight_above_does_not_suffice_until_one_photo_is_tilted(noise):
    views = [sightings(tilts, noise, np.random.default_rng(0)) for tilts in (FRONTAL, (*FRONTAL, (40, 0)))]
    frontal, tilted = map(assess, views)
    assert "focal length" in frontal.missing
    assert frontal.advice.words in frontal.missing
    assert frontal.advice.mean_m < frontal.table.mean_m
    assert tilted.focal_std_px < frontal.focal_std_px / 10
    with pytest.raises(OsfError):
        calibrated_camera(views[0])


def test_two_photos_or_a_board_beside_the_picture_do_not_suffice():
    assert "number of photos" in assess(sightings(VARIED[:2])).missing
    far = board_place(0.55, 0.55, 0.0)
    camera = Camera.look_at("aside", (0.35, 0.35, 0.15), (0.55, 0.55, 0.0)).T_world_camera
    assert "workspace" in assess(sightings(), sighting("t.jpg", camera.inverse() @ far), far).missing
    with pytest.raises(InvalidInput, check=about("number of photos")):
        assess([])


def test_photos_that_contradict_the_others_are_named():
    views, zoomed = sightings(VARIED, 0.05, np.random.default_rng(1)), K * [[1.15], [1.15], [1]]
    odd = sightings(VARIED, 0.05, np.random.default_rng(2), zoomed)[1]
    portrait = sighting("d.jpg", Pose(np.array([0, 0, 0.5]), np.array([0.0, 1, 0, 0])), size=(480, 640))
    for photos, name in (
        ([views[0], odd, *views[2:]], "b.jpg"),
        ([*views, replace(sighting("e.jpg", tilted((5, 5))), board=Board(5, 4))], "e.jpg"),
        ([*views, portrait], "d.jpg"),
        ([*views, views[0]], "a.jpg"),
    ):
        with pytest.raises(CorruptFile, check=about(name)):
            assess(photos)
    with pytest.raises(InvalidInput, check=about("mean distance of the board's corners")):
        assess(sightings(VARIED, 3.0, np.random.default_rng(1)))
    same = [replace(view, name="image.jpg") for view in views[:3]]
    assert list(assess(same).rms_px) == ["image.jpg", "image.jpg (2)", "image.jpg (3)"]
