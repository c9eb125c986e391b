"""`osf photo`: the board, and objects in a photograph."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from app.cli.main import main
from osfcore.experiments.board_views import board_photograph
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import quaternion_to_matrix, rotation_angle
from osfcore.io.image_file import write_png
from tests.app.cli.photo_of_a_table import SIZE, K, on_the_table, table_photo
from tests.support.boards import tilted
from tests.support.photographs import INTRINSICS, NAME, take

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
    assert main(["photo", "board", "--out", str(tmp_path / "board.png")]) == 2
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
    assert any("No printed board was found" in note for note in result["notes"])
    assert result["light"]["distance_m"] is None
    assert any("distance of the lamp" in note for note in result["notes"])
    assert (images / f"{NAME}.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("box", "sentence"),
    [
        (f"{NAME}:1,2,3", "box is"),
        (f"{NAME}:1,2,3,nan", "within the photo's 300 x 260 pixels"),
        (f"{NAME}:200,20,20,200", "given as LEFT,TOP,RIGHT,BOTTOM"),
        (
            f"{NAME}:900,900,990,990",
            f"box of {NAME} [px] is 900,900,990,990, but it must be within the photo's 300 x 260",
        ),
        (f"{NAME}:10,10,12,12", "at least 8 a side"),
        (f"other.png:{NAME}:20,20,200,200", "photo of a box is other.png"),
        ("teapot:20,20,200,200", "no object named 'teapot'; known:"),
        ("gelatin:20,20,200,200", f"no object named 'gelatin'; did you mean {NAME}?"),
        ("009_gelatine_boks:20,20,200,200", f"did you mean {NAME}?"),
    ],
)
def test_mistakes_are_told_in_one_sentence(photo, tmp_path, capsys, box, sentence):
    assert sentence in refusal(capsys, tmp_path, "--photo", str(photo), "--boxes", box)


def refusal(capsys, tmp_path, *call, code=2):
    """What is said of a call that must not write anything: with code 2 of itself, with 1 of files."""
    out = tmp_path / "found.json"
    assert main(["photo", "estimate", *call, "--out", str(out), "--data-dir", str(tmp_path)]) == code
    error = capsys.readouterr().err
    assert len(error.strip().splitlines()) == 1
    assert "Traceback" not in error
    assert not out.exists()
    return error


BOX = f"{NAME}:20,20,200,200"


def test_neither_boxes_nor_masks_are_told(photo, tmp_path, capsys):
    assert "an object needs a box or a mask" in refusal(capsys, tmp_path, "--photo", str(photo))


def test_a_text_file_is_no_photo(tmp_path, capsys):
    text = tmp_path / "notes.jpg"
    text.write_text("no photo")
    assert "it is no picture that can be read here" in refusal(
        capsys, tmp_path, "--photo", str(text), "--boxes", BOX, code=1
    )


def test_no_photo_is_told(tmp_path, capsys):
    assert "number of photos is 0" in refusal(capsys, tmp_path, "--boxes", BOX, "--photo")


def test_a_photo_that_is_missing_is_told(tmp_path, capsys):
    assert "none.jpg" in refusal(capsys, tmp_path, "--photo", str(tmp_path / "none.jpg"), "--boxes", BOX, code=1)


@pytest.mark.parametrize("focal", ["3", "1e7", "-600", "nan"])
def test_an_absurd_focal_length_is_told(photo, tmp_path, capsys, focal):
    error = refusal(capsys, tmp_path, "--photo", str(photo), "--boxes", BOX, "--focal", focal)
    assert "focal length [px] is" in error


def test_two_photos_that_share_neither_board_nor_object_are_told(photo, tmp_path, capsys):
    error = refusal(
        capsys, tmp_path, "--photo", str(photo), str(photo), "--boxes", BOX.replace(NAME, f"photo.png:{NAME}")
    )
    assert "photo of a box is photo.png" in error  # which of the two?
    error = refusal(capsys, tmp_path, "--photo", str(photo), str(photo), "--boxes", BOX)
    assert "objects marked both in photo 1 and in another is 0" in error


def test_files_of_other_programs_that_do_not_fit_are_told(photo, tmp_path, capsys):
    poses, masks = tmp_path / "poses.csv", tmp_path / "masks"
    poses.write_text("no poses")
    call = ["--photo", str(photo), "--boxes", BOX, "--poses", str(poses)]
    assert "pose 1 is not scene_id,im_id" in refusal(capsys, tmp_path, *call, code=1)
    masks.mkdir()
    call = ["--photo", str(photo), "--masks", str(masks)]
    assert "number of masks of known objects" in refusal(capsys, tmp_path, *call)
    assert "number of folders of masks is 2" in refusal(capsys, tmp_path, *call, str(masks))


def found_in(tmp_path, capsys, *call):
    out = ["--out", str(tmp_path / "found.json"), "--data-dir", str(tmp_path), "--json"]
    assert main(["photo", "estimate", *call, *out]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def turned_deg(found, pose):
    return np.rad2deg(rotation_angle(np.array(found["quaternion"]), pose.quaternion))


@pytest.mark.slow
def test_a_mask_and_a_pose_of_another_program(taken, photo, tmp_path, capsys):
    write_png(tmp_path / "masks" / f"mask_{NAME}.png", 255 * taken.photo.masks[NAME].astype(np.uint8))
    shift, turn = 1e3 * (taken.pose.position + 0.005), quaternion_to_matrix(taken.pose.quaternion)
    line = f"48,1,8,1.0,{' '.join(map(str, turn.ravel()))},{' '.join(map(str, shift))},-1"
    other = line.replace("48,1,8,", "48,1,1,")
    (tmp_path / "bop.csv").write_text(f"{line}\n{other}\n")
    call = ["--photo", str(photo), "--masks", str(tmp_path / "masks"), "--poses", str(tmp_path / "bop.csv")]
    result = found_in(tmp_path, capsys, *call, "--focal", FOCAL)
    (found,) = result["objects"]
    assert turned_deg(found, taken.pose) < 5
    assert np.linalg.norm(np.array(found["position"]) - taken.pose.position) < 0.01
    assert any("Poses of 002_master_chef_can were not used" in note for note in result["notes"])


@pytest.mark.slow
def test_a_large_jpeg_is_reduced(taken, tmp_path, capsys):
    large = cv2.resize(taken.encoded, None, fx=28, fy=28, interpolation=cv2.INTER_CUBIC)  # 61 megapixels
    Image.fromarray(large).save(tmp_path / "large.jpg", quality=90)
    name, _, numbers = box_of(taken.photo.masks[NAME]).partition(":")
    box = f"{name}:{','.join(str(28 * int(number)) for number in numbers.split(','))}"
    call = ["--photo", str(tmp_path / "large.jpg"), "--boxes", box, "--focal", str(28 * INTRINSICS[0, 0])]
    result = found_in(tmp_path, capsys, *call)
    assert turned_deg(result["objects"][0], taken.pose) < 10
    assert any("was reduced" in note for note in result["notes"])


@pytest.mark.slow
def test_half_an_object_is_doubted(taken, tmp_path, capsys):
    box = box_of(taken.photo.masks[NAME])
    left = int(np.nonzero(taken.photo.masks[NAME])[1].mean())
    write_png(tmp_path / "cut.png", taken.encoded[:, left:])
    numbers = [int(number) for number in box.partition(":")[2].split(",")]
    cut = f"{NAME}:0,{numbers[1]},{numbers[2] - left},{numbers[3]}"
    (half,) = found_in(tmp_path, capsys, "--photo", str(tmp_path / "cut.png"), "--focal", FOCAL, "--boxes", cut)[
        "objects"
    ]
    assert half["doubt"]


@pytest.mark.slow
@pytest.mark.parametrize("radius", [60, 0])
def test_a_photo_of_something_else_is_doubted(tmp_path, capsys, radius):
    y, x = np.mgrid[:260, :300]
    ball = ((x - 150) ** 2 + (y - 130) ** 2 < radius**2)[..., None] * np.array([200, 30, 90]) + 40
    write_png(tmp_path / "ball.png", ball.astype(np.uint8))
    call = ["--photo", str(tmp_path / "ball.png"), "--focal", FOCAL, "--boxes", f"{NAME}:85,65,215,195"]
    assert found_in(tmp_path, capsys, *call)["objects"][0]["doubt"]


@pytest.fixture(scope="module")
def field():
    return FieldLibrary(None).load(NAME)


@pytest.fixture(scope="module")
def pose(field):
    return on_the_table(field, 0.21, 0.02)


def save(folder, name, view):
    """Write a photo; its box."""
    write_png(folder / name, view[0])
    return f"{name}:{box_of(view[1])}"


@pytest.mark.slow
def test_two_photos_of_one_table(field, pose, tmp_path, capsys):
    eyes = (0.45, -0.3, 0.4), (0.1, 0.5, 0.45)
    views = [table_photo({NAME: field}, NAME, pose, eye) for eye in eyes]
    boxes = [save(tmp_path, name, view) for name, view in zip(("a.png", "b.png"), views, strict=True)]
    call = ["--photo", str(tmp_path / "a.png"), str(tmp_path / "b.png"), "--boxes", *boxes]
    result = found_in(tmp_path, capsys, *call, "--images", str(tmp_path / "sheets"))
    assert result["table"] == "board"
    (found,) = result["objects"]
    assert turned_deg(found, pose) < 5
    assert np.linalg.norm(np.array(found["position"]) - pose.position) < 0.01
    for camera, (_, _, T_world_camera) in zip([result["camera"], *result["other_cameras"]], views, strict=True):
        assert np.abs(np.array(camera["T_world_camera"]) - T_world_camera.matrix()).max() < 0.02
    assert (tmp_path / "sheets" / f"{NAME}-2.png").is_file()
    alone = found_in(tmp_path, capsys, *call[:-1])  # a box in one of the two is enough
    assert turned_deg(alone["objects"][0], pose) < 10


@pytest.mark.slow
def test_a_lens_that_bends_is_straightened_and_told(field, pose, tmp_path, capsys):
    view = table_photo({NAME: field}, NAME, pose, (0.3, -0.25, 0.35), radial=-0.08)
    box = save(tmp_path, "photo.png", view)
    result = found_in(tmp_path, capsys, "--photo", str(tmp_path / "photo.png"), "--boxes", box)
    assert any("the photo was straightened" in note for note in result["notes"])
    position = np.array(result["camera"]["T_world_camera"])[:3, 3]
    assert np.linalg.norm(position - view[2].position) < 0.01


def test_a_focal_length_that_the_board_contradicts_is_told(field, pose, tmp_path, capsys):
    box = save(tmp_path, "photo.png", table_photo({NAME: field}, NAME, pose, (0.45, -0.3, 0.4)))
    error = refusal(capsys, tmp_path, "--photo", str(tmp_path / "photo.png"), "--boxes", box, "--focal", "1120")
    assert "focal length of the photo [px] is given as 1120" in error
    assert "about 0.50 times that, as the board in it shows" in error


@pytest.mark.slow
def test_a_blurred_board_is_told_as_blurred(field, pose, tmp_path, capsys):
    view = table_photo({NAME: field}, NAME, pose, (0.45, -0.3, 0.4))
    box = save(tmp_path, "photo.png", (cv2.GaussianBlur(view[0], (0, 0), 4.0), view[1]))
    result = found_in(tmp_path, capsys, "--photo", str(tmp_path / "photo.png"), "--boxes", box)
    assert result["table"] is None
    assert any("blur of the photograph's sharpest edges" in note for note in result["notes"])


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


def refused(capsys, *call, code=2):
    assert main(["photo", "calibrate", *call]) == code
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
    assert main([*call, "--focal", "560", "--out", str(tmp_path / "found.json")]) == 2
    assert "--camera has the focal length" in capsys.readouterr().err


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
    assert "number of photos of the board is 2" in refused(capsys, *photos[:2], *out, code=1)
    above = Camera.look_at("above", (0.0, 0.0, 0.5), (0.0, 0.0, 0.0)).T_world_camera
    frontal = [written(tmp_path, f"above{n}.png", above, 10 + n) for n in range(3)]
    assert "do not tell focal length from distance; in the next, " in refused(capsys, *frontal, *out, code=1)
    write_png(tmp_path / "wall.png", np.full((480, 640, 3), 120, np.uint8))
    assert "wall.png cannot be used: " in refused(capsys, *photos[:3], str(tmp_path / "wall.png"), *out, code=1)
    assert "a path that ends in .json" in refused(capsys, *photos, "--out", str(tmp_path / "camera.txt"))
    assert "y of the board [m] is 3" in refused(capsys, *photos, "--place", "0", "3", "0", *out)
    assert not (tmp_path / "camera.json").exists()
