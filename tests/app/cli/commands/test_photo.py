"""`osf photo`: the board, and objects in a photograph."""

import json

import numpy as np
import pytest

from app.cli.main import main
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import rotation_angle
from osfcore.io.image_file import write_png
from tests.core.photo.conftest import INTRINSICS, NAME, take

FOCAL = str(INTRINSICS[0, 0])


@pytest.fixture(scope="module")
def taken():
    return take({NAME: FieldLibrary(None).load(NAME)})


@pytest.fixture
def photo(taken, tmp_path):
    path = tmp_path / "photo.png"
    write_png(path, taken.encoded)
    return path


def box_of(mask):
    rows, columns = np.nonzero(mask)
    return f"{NAME}:{columns.min() - 3},{rows.min() - 3},{columns.max() + 4},{rows.max() + 4}"


def test_the_board_is_written(tmp_path, capsys):
    assert main(["photo", "board", "--out", str(tmp_path / "board.pdf")]) == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    assert "Print it at 100 %" in capsys.readouterr().out


def test_the_board_is_a_pdf(tmp_path, capsys):
    assert main(["photo", "board", "--out", str(tmp_path / "board.png")]) == 1
    assert "a path that ends in .pdf" in capsys.readouterr().err


@pytest.mark.slow
def test_an_object_is_found_by_its_box(taken, photo, tmp_path, capsys):
    out, images = tmp_path / "found.json", tmp_path / "images"
    call = ["photo", "estimate", "--photo", str(photo), "--boxes", box_of(taken.photo.masks[NAME]), "--focal", FOCAL]
    assert main([*call, "--out", str(out), "--images", str(images), "--data-dir", str(tmp_path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result == json.loads(out.read_text())
    (found,) = result["objects"]
    assert found["name"] == NAME
    assert np.rad2deg(rotation_angle(np.array(found["quaternion"]), taken.pose.quaternion)) < 10
    assert result["table"] is None  # one object does not tell
    assert any("No board tells where the table is" in note for note in result["notes"])
    assert result["light"]["distance_m"] is None
    assert any("How far away the lamp is" in note for note in result["notes"])
    assert (images / f"{NAME}.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("box", "sentence"),
    [
        (f"{NAME}:1,2,3", "box is"),
        ("teapot:20,20,200,200", "no field named 'teapot'"),
        (f"{NAME}:900,900,990,990", "box"),
    ],
)
def test_mistakes_are_told_in_one_sentence(photo, tmp_path, capsys, box, sentence):
    call = ["photo", "estimate", "--photo", str(photo), "--boxes", box, "--out", str(tmp_path / "found.json")]
    assert main([*call, "--data-dir", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert sentence in error
    assert "Traceback" not in error
