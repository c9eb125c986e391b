"""`osf photo calibrate`: from photos of the board to a camera that `osf photo estimate` takes."""

import json

import numpy as np
import pytest

from app.cli.main import main
from osfcore.experiments.board_views import board_photograph
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera
from osfcore.io.image_file import write_png
from tests.app.cli.commands.photo_of_a_table import SIZE, K, on_the_table, table_photo
from tests.support.boards import tilted

TILTS = ((35, 0), (-35, 10), (0, 38), (5, -36))
NAME = "009_gelatin_box"
EYE = (0.3, -0.25, 0.35)
T_WORLD_CAMERA = Camera.look_at("photo", EYE, (0.05, 0.0, 0.0)).T_world_camera
RADIAL = -0.08


def written(folder, name, T_world_camera, seed):
    view = board_photograph(np.random.default_rng(seed), SIZE, camera=(T_world_camera, K), radial=RADIAL)
    write_png(folder / name, view.image)
    return str(folder / name)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boards")
    return [written(folder, f"board{n}.png", tilted(tilt).inverse(), n) for n, tilt in enumerate(TILTS)]


def calibrated(capsys, *call):
    assert main(["photo", "calibrate", *call, "--json"]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def refused(capsys, *call):
    assert main(["photo", "calibrate", *call]) == 1
    return capsys.readouterr().err


@pytest.mark.slow
def test_a_camera_is_calibrated_and_stands_where_the_photo_of_the_table_says(photos, tmp_path, capsys):
    table, out = written(tmp_path, "table.png", T_WORLD_CAMERA, 9), tmp_path / "camera.json"
    result = calibrated(capsys, *photos, "--table", table, "--out", str(out))
    assert result == json.loads(out.read_text())
    assert np.abs(np.array(result["K"]) - K).max() < 3
    assert result["radial"] == pytest.approx(RADIAL, abs=0.01)
    assert np.abs(np.array(result["T_world_camera"]) - T_WORLD_CAMERA.matrix()).max() < 2e-3
    assert 0 < result["expected_error_mm"]["mean"] < result["expected_error_mm"]["worst"] < 2
    assert set(result["reprojection_px"]) == {*(f"board{n}.png" for n in range(len(TILTS))), "table.png"}


@pytest.mark.slow
def test_an_object_is_found_by_the_calibrated_camera(photos, tmp_path, capsys):
    field = FieldLibrary(None).load(NAME)
    pose = on_the_table(field, 0.21, 0.02)
    image, mask, _ = table_photo({NAME: field}, NAME, pose, EYE, radial=RADIAL)
    camera, photo = tmp_path / "camera.json", tmp_path / "photo.png"
    calibrated(capsys, *photos, "--out", str(camera))
    write_png(photo, image)
    rows, columns = np.nonzero(mask)
    box = f"{NAME}:{columns.min() - 3},{rows.min() - 3},{columns.max() + 4},{rows.max() + 4}"
    call = ["photo", "estimate", "--photo", str(photo), "--boxes", box, "--camera", str(camera)]
    assert main([*call, "--out", str(tmp_path / "found.json"), "--data-dir", str(tmp_path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["table"] == "board"
    assert any("the one that was calibrated" in note for note in result["notes"])
    assert np.abs(np.array(result["camera"]["T_world_camera"]) - T_WORLD_CAMERA.matrix()).max() < 3e-3
    assert np.linalg.norm(np.array(result["objects"][0]["position"]) - pose.position) < 0.01
    assert main([*call, "--focal", "560", "--out", str(tmp_path / "found.json")]) == 1
    assert "--camera tells the focal length" in capsys.readouterr().err


@pytest.mark.slow
def test_people_are_told_what_was_found_and_what_would_help(photos, tmp_path, capsys):
    assert main(["photo", "calibrate", *photos, "--out", str(tmp_path / "camera.json")]) == 0
    told = capsys.readouterr().out
    assert "board0.png: corners 0." in told
    assert "Expected error on the table: 0." in told
    assert "One more photo would make it" in told


@pytest.mark.slow
def test_what_does_not_suffice_is_refused(photos, tmp_path, capsys):
    out = ["--out", str(tmp_path / "camera.json")]
    assert "number of photos of the board is 2" in refused(capsys, *photos[:2], *out)
    above = Camera.look_at("above", (0.0, 0.0, 0.5), (0.0, 0.0, 0.0)).T_world_camera
    frontal = [written(tmp_path, f"above{n}.png", above, 10 + n) for n in range(3)]
    assert "do not tell focal length from distance; in the next, " in refused(capsys, *frontal, *out)
    write_png(tmp_path / "wall.png", np.full((480, 640, 3), 120, np.uint8))
    assert "wall.png cannot be used: " in refused(capsys, *photos[:3], str(tmp_path / "wall.png"), *out)
    assert "a path that ends in .json" in refused(capsys, *photos, "--out", str(tmp_path / "camera.txt"))
    assert "y of the board [m] is 3" in refused(capsys, *photos, "--place", "0", "3", "0", *out)
    assert not (tmp_path / "camera.json").exists()
