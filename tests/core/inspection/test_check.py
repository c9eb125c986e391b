"""Check: check, bop sheet."""

import json
import shutil
import zipfile

import cv2
import numpy as np
import pytest
from safetensors.numpy import save_file

from osfcore.dynamics.graph import PropagationNetwork, write_network
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.inspection.check import check_path, draw_overlay
from osfcore.io.observation_file import write_observation
from osfcore.io.push_file import EpisodeFolder, PushEpisode, save_episode
from osfcore.io.scene_file import write_estimated
from osfcore.world.collect_images import CollectTable, collect_table
from tests.core.fields.sets import edit, turn_cameras, write_set
from tests.core.photo.bop_scenes import write_bop_scene

# Check


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("sets") / "ellipsoid")


@pytest.fixture
def image_set(pristine, tmp_path):
    return shutil.copytree(pristine, tmp_path / "ellipsoid")


def zipped(folder, path):
    with zipfile.ZipFile(path, "w") as file:
        for source in folder.rglob("*.*"):
            file.write(source, source.relative_to(folder.parent))
    return path


def count(path, colour) -> int:
    return np.all(cv2.imread(str(path)) == colour, axis=-1).sum()


def test_a_good_set_of_an_object_passes_with_its_size_and_its_overlay_shows_all(image_set, tmp_path):
    report = check_path(image_set)
    assert (report.kind, dict(report.facts)) == ("image set", {"train": 12, "test": 4})
    size = [float(word) for word in report.summary.split(" of an object of ")[1].split(" x ")]
    np.testing.assert_allclose(size, (1.0, 0.6, 0.4), atol=0.35)
    draw_overlay(image_set, tmp_path / "overlay.png")
    assert cv2.imread(str(tmp_path / "overlay.png")).shape == (512, 1024, 3)
    for colour in ((0, 0, 255), (0, 255, 0), (255, 0, 0), (0, 255, 255), (255, 0, 255)):
        assert count(tmp_path / "overlay.png", colour) > 50


def test_the_bare_table_has_no_box(tmp_path):
    out = tmp_path / "table"
    list(collect_table(CollectTable(out, images=60, size=16)))
    assert check_path(out).summary == "20 train and 40 test images of the bare table"
    draw_overlay(out, tmp_path / "overlay.png")
    assert count(tmp_path / "overlay.png", (0, 0, 255)) > 50
    assert count(tmp_path / "overlay.png", (255, 0, 255)) == 0


def test_wrong_cameras_are_told_and_can_still_be_drawn(image_set, tmp_path):
    turn_cameras(image_set, lambda RT: np.diag([1, -1, -1]) @ RT)
    with pytest.raises(CorruptFile, match="ellipsoid cannot be used: the silhouettes .* share no volume: RT must be"):
        check_path(image_set)
    draw_overlay(image_set, tmp_path / "overlay.png")
    assert count(tmp_path / "overlay.png", (0, 0, 255)) > 100


def test_a_wrong_camera_in_the_test_split_is_found_too(tmp_path):
    folder = write_set(tmp_path / "set", train=30, test=4)
    turn_cameras(folder, lambda RT: np.diag([1, -1, -1]) @ RT, ("test",), 2)
    with pytest.raises(CorruptFile, match="silhouettes of test/r_2.png contradict"):
        check_path(folder)


def test_a_set_of_a_scale_that_no_field_can_hold_is_told(image_set):
    turn_cameras(image_set, lambda RT: RT * [[1, 1, 1, 1e-8]])
    with pytest.raises(CorruptFile, match="ellipsoid cannot be used: its object is 1.*e-08 large"):
        check_path(image_set)


def test_broken_and_leaking_sets_are_told(image_set, tmp_path):
    shutil.copyfile(image_set / "train" / "r_2.png", image_set / "test" / "r_1.png")
    with pytest.raises(CorruptFile, match="1 of 4 test images are also training images"):
        check_path(image_set)
    edit(image_set, lambda e: e.update(light_pos=[0, 0, 0]))
    with pytest.raises(CorruptFile, match="light_pos of entry 3"):
        check_path(image_set)
    with pytest.raises(CorruptFile, match="no readable train/anno.json"):
        check_path(tmp_path)


def test_a_zipped_set_is_checked_like_a_folder(image_set, tmp_path):
    path = zipped(image_set, tmp_path / "mine.zip")
    assert check_path(path) == check_path(image_set)
    draw_overlay(path, tmp_path / "overlay.png")
    assert (tmp_path / "overlay.png").stat().st_size > 1000
    (image_set / "train" / "r_3.png").write_bytes(b"no picture")
    with pytest.raises(CorruptFile) as caught:
        check_path(zipped(image_set, path))
    message = f"{path} cannot be used: mine/train/r_3.png cannot be used: it is no readable PNG"
    assert str(caught.value).startswith(message)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(CorruptFile, match=r"mine.zip cannot be used: it is no zip archive or a damaged one.$"):
        check_path(path)


def test_an_unwritable_overlay_is_told(image_set, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="overlay.png"):
        draw_overlay(image_set, tmp_path / "file" / "overlay.png")
    with pytest.raises(InvalidInput, match="overlay file is .*overlay.jpg, but it must be a path that ends in .png"):
        draw_overlay(image_set, tmp_path / "overlay.jpg")
    assert not (tmp_path / "overlay.jpg").exists()


def test_a_folder_is_a_folder_whatever_it_is_called(image_set, tmp_path):
    folder = image_set.rename(tmp_path / "folder.zip")
    assert check_path(folder).kind == "image set"
    draw_overlay(folder, tmp_path / "overlay.png")
    assert (tmp_path / "overlay.png").stat().st_size > 1000


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


def seen(tmp_path):
    cameras = default_cameras(16)
    masks = np.zeros((4, 2, 16, 16), bool)
    masks[:3, 0, 4:9, 4:9] = True
    write_observation(tmp_path / "scene", Observation(cameras, np.zeros((4, 16, 16, 3)), ("a", "b"), masks, None, 0.0))
    return tmp_path / "scene"


def test_observations_are_described_and_drawn(tmp_path):
    folder = seen(tmp_path)
    report = check_path(folder)
    assert (report.kind, report.summary) == ("observation", "4 views of 16 x 16 px, 2 objects, 3 masks")
    assert dict(report.facts) == {"cameras": 4, "objects": 2, "width": 16, "height": 16, "masks": 3}
    draw_overlay(folder, tmp_path / "overlay.png")
    assert cv2.imread(str(tmp_path / "overlay.png")).shape == (384, 4 * 384, 3)
    assert count(tmp_path / "overlay.png", (0, 0, 255)) > 50
    with pytest.raises(CorruptFile, match="check the folder that holds it"):
        check_path(folder / "observation.json")
    (folder / "mask_1_0.png").unlink()
    with pytest.raises(CorruptFile, match="mask_1_0.png cannot be used: there is no such file"):
        check_path(folder)


def test_states_are_told_from_scenes(tmp_path):
    state = SceneState(("a",), Pose.identity(1), Light(np.array([0, 0, 1.0])), None)
    path = tmp_path / "state.json"
    for reason, words in (("", "1 objects, trusted"), ("a: it hides", "1 objects, not trusted: a: it hides")):
        write_estimated(path, EstimatedState(state, np.zeros(1), np.zeros(1), 0.0, (reason,), reason))
        report = check_path(path)
        assert (report.kind, report.summary) == ("state", words)
        assert dict(report.facts) == {"objects": 1, "trusted": not reason, "reason": reason}
    path.write_text(path.read_text().replace('"doubt": "', '"doubt": 3, "x": "'))
    with pytest.raises(CorruptFile, match="doubt of object a is 3"):
        check_path(path)


def test_actions_and_networks_are_told(tmp_path):
    (tmp_path / "actions.json").write_text(json.dumps({"actions": [[[0.1, 0, 0]] * 4] * 2, "step_s": 0.2}))
    report = check_path(tmp_path / "actions.json")
    assert (report.kind, dict(report.facts)) == ("actions", {"sequences": 2, "steps": 4})
    (tmp_path / "actions.json").write_text(json.dumps({"actions": [[[0.4, 0, 0]]]}))
    with pytest.raises(CorruptFile, match=r"0\.4"):
        check_path(tmp_path / "actions.json")
    write_network(tmp_path / "pushes.safetensors", PropagationNetwork(8, 2))
    report = check_path(tmp_path / "pushes.safetensors")
    assert (report.kind, dict(report.facts)) == ("dynamics", {"hidden": 8, "steps": 2})
    save_file({"x": np.zeros(3)}, tmp_path / "other.safetensors", metadata={"format": "other"})
    with pytest.raises(CorruptFile, match="format"):
        check_path(tmp_path / "other.safetensors")


def test_wrong_substates_of_pushes_are_told(tmp_path):
    arrays = {"positions": np.zeros((3, 1, 3)), "quaternions": np.zeros((3, 1, 4)), "pusher": np.zeros((3, 3)),
              "actions": np.zeros((2, 3)), "contact": np.zeros((2, 1), bool)}  # fmt: skip
    for shape, words in (((2, 4, 1, 3), None), ((2, 4, 2, 3), "sub_positions of episode 0 has shape")):
        episode = PushEpisode(
            ("a",), 0, **arrays, sub_positions=np.zeros(shape), sub_quaternions=np.zeros((2, 4, 1, 4))
        )
        with EpisodeFolder(tmp_path / f"{words is None}.h5", {}) as folder:
            save_episode(folder.path(0), episode)
            folder.combine(1)
        if words is None:
            assert check_path(tmp_path / "True.h5").kind == "push file"
        else:
            with pytest.raises(CorruptFile, match=words):
                check_path(tmp_path / "False.h5")


# A scene of BOP is judged as a whole: numbers that fit, and one sentence for those that do not.


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


def edit_bop(path, change):
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
    edit_bop(folder / "scene_camera.json", lambda entry: entry.pop("cam_R_w2c"))
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
    edit_bop(folder / file, change)
    with pytest.raises(CorruptFile, match=sentence):
        check_path(folder)
