import json

import cv2
import numpy as np
import pytest

from osfcore.check import check_path, draw_overlay, read_annotations
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.scene import Camera
from osfcore.world.collect_images import CollectTable, collect_table
from osfcore.world.push_file import EpisodeFolder, PushEpisode, save_episode


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "table"
    list(collect_table(CollectTable(out, images=60, size=16)))
    return out


@pytest.fixture
def image_set(pristine, tmp_path):
    import shutil

    return shutil.copytree(pristine, tmp_path / "table")


def edit(image_set, change) -> None:
    path = image_set / "train" / "anno.json"
    entries = json.loads(path.read_text())
    change(entries[3])
    path.write_text(json.dumps(entries))


def test_good_image_set_passes_and_its_overlay_shows_axes(image_set, tmp_path):
    report = check_path(image_set)
    assert (report.kind, dict(report.facts)) == ("image set", {"train": 20, "test": 40})
    draw_overlay(image_set, tmp_path / "overlay.png")
    sheet = cv2.imread(str(tmp_path / "overlay.png"))
    assert sheet.shape == (512, 1024, 3)
    for colour in ((0, 0, 255), (0, 255, 0), (255, 0, 0)):
        assert np.all(sheet == colour, axis=-1).sum() > 50


def test_lights_of_any_length_are_normalised(image_set):
    edit(image_set, lambda entry: entry.update(light_pos=[0, 0, 15.0]))
    np.testing.assert_allclose(read_annotations(image_set, "train")[3].light_direction, [0, 0, 1])


def test_public_sets_with_two_and_a_half_metre_cameras_are_read(tmp_path):
    camera = Camera.look_at("view", (2.5, 0, 0.1), (0, 0, 0), size=256, fov_y_deg=39.6)
    entry = {
        "filename": "r_0.png",
        "RT": camera.T_world_camera.inverse().matrix()[:3].tolist(),
        "K": camera.intrinsics.tolist(),
        "light_pos": [0, 9, 12],
        "resolution": 256,
        "objects": {},
        "light_rgb": None,
    }
    for split in ("train", "test"):
        (tmp_path / split).mkdir()
        (tmp_path / split / "anno.json").write_text(json.dumps([entry]))
        cv2.imwrite(str(tmp_path / split / "r_0.png"), np.zeros((256, 256, 4), np.uint8))
    assert check_path(tmp_path).facts == {"train": 1, "test": 1}
    np.testing.assert_allclose(
        read_annotations(tmp_path, "test")[0].camera.T_world_camera.position, (2.5, 0, 0.1), atol=1e-6
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: e.pop("light_pos"), "entry 3"),
        (lambda e: e.update(light_pos=[0, 0, 0]), "no direction"),
        (lambda e: e.update(light_pos=[10**400, 0, 0]), "entry 3"),
        (lambda e: e.update(RT=np.zeros((3, 4)).tolist()), "rotation"),
        (lambda e: e.update(K=np.zeros((3, 3)).tolist()), "focal"),
        (lambda e: e.update(filename="gone.png"), "no readable PNG"),
    ],
)
def test_broken_sets_are_told_with_their_place(image_set, change, words):
    edit(image_set, change)
    with pytest.raises(CorruptFile, match=words):
        check_path(image_set)


def test_annotations_nested_too_deeply_are_refused(image_set):
    (image_set / "train" / "anno.json").write_text("[" * 100_000)
    with pytest.raises(CorruptFile, match="not valid JSON"):
        check_path(image_set)


def test_images_without_transparency_are_refused(image_set):
    cv2.imwrite(str(image_set / "test" / "0000.png"), np.zeros((16, 16, 3), np.uint8))
    with pytest.raises(CorruptFile, match="RGBA"):
        check_path(image_set)


def test_a_folder_that_is_no_set_and_an_unwritable_overlay_are_told(image_set, tmp_path):
    with pytest.raises(CorruptFile, match="train/anno.json"):
        check_path(tmp_path)
    with pytest.raises(InvalidInput, match="overlay"):
        draw_overlay(image_set, tmp_path / "no" / "such" / "folder.png")


def test_files_of_other_kinds_are_told(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("hello")
    with pytest.raises(CorruptFile, match="neither"):
        check_path(path)


def push_file(tmp_path, **changes):
    arrays = {
        "positions": np.zeros((3, 1, 3)),
        "quaternions": np.zeros((3, 1, 4)),
        "pusher": np.zeros((3, 3)),
        "actions": np.zeros((2, 3)),
        "contact": np.zeros((2, 1), bool),
    }
    with EpisodeFolder(tmp_path / "pushes.h5", {}) as folder:
        save_episode(folder.path(0), PushEpisode(("a",), 0, **(arrays | changes)))
        folder.combine(1)
    return tmp_path / "pushes.h5"


def test_push_files_are_checked(tmp_path):
    with EpisodeFolder(tmp_path / "empty.h5", {}) as folder:
        folder.combine(0)
    with pytest.raises(CorruptFile, match="no episodes"):
        check_path(tmp_path / "empty.h5")
    assert check_path(push_file(tmp_path)).facts == {"episodes": 1, "steps": 2}
    with pytest.raises(CorruptFile, match="not finite"):
        check_path(push_file(tmp_path, pusher=np.full((3, 3), np.nan)))
    with pytest.raises(CorruptFile, match="actions of episode 0 have shape"):
        check_path(push_file(tmp_path, actions=np.zeros(3)))
    with pytest.raises(CorruptFile, match="shape"):
        check_path(push_file(tmp_path, actions=np.zeros((4, 3))))
