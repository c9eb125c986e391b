import json
import zipfile

import cv2
import numpy as np
import pytest
from safetensors.numpy import save_file

from osfcore.dynamics.graph import PropagationNetwork, write_network
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.inspection.check import check_path, draw_overlay
from osfcore.io.observation_file import write_observation
from osfcore.io.push_file import EpisodeFolder, PushEpisode, save_episode
from osfcore.io.scene_file import write_estimated
from tests.support.bop_scenes import box_masks, write_bop_scene
from tests.support.ellipsoid_sets import turn_cameras, write_set
from tests.support.errors import about


def zipped(folder, path):
    with zipfile.ZipFile(path, "w") as file:
        for source in folder.rglob("*.*"):
            file.write(source, source.relative_to(folder.parent))
    return path


def refused(path, datum):
    with pytest.raises(CorruptFile, check=about(datum)):
        check_path(path)


def described(path):
    report = check_path(path)
    return report.kind, dict(report.facts)


def drawn(path, tmp_path, *colours, least=50):
    """The shape of a path's overlay, which has more than so many pixels of each colour."""
    draw_overlay(path, tmp_path / "overlay.png")
    picture = cv2.imread(str(tmp_path / "overlay.png"))
    assert all(np.all(picture == colour, axis=-1).sum() > least for colour in colours)
    return picture.shape


AXES = (0, 0, 255), (0, 255, 0), (255, 0, 0)


def test_a_good_set_of_an_object_passes_with_its_size_and_its_overlay_shows_all(image_set, tmp_path):
    assert described(image_set) == ("image set", {"train": 12, "test": 4})
    size = [float(word) for word in check_path(image_set).summary.split(" of an object of ")[1].split(" x ")]
    np.testing.assert_allclose(size, (1.0, 0.6, 0.4), atol=0.35)
    assert drawn(image_set, tmp_path, *AXES, (0, 255, 255), (255, 0, 255)) == (512, 1024, 3)


def test_a_wrong_camera_in_the_test_split_is_found_too(tmp_path):
    folder = write_set(tmp_path / "set", train=30, test=4)
    turn_cameras(folder, lambda RT: np.diag([1, -1, -1]) @ RT, ("test",), 2)
    refused(folder, "test/r_2.png")
    drawn(folder, tmp_path, AXES[0], least=100)  # shows what is wrong
    with pytest.raises(InvalidInput):
        draw_overlay(folder, tmp_path / "overlay.jpg")
    refused(tmp_path, "train/anno.json")
    (tmp_path / "notes.txt").write_text("hello")
    refused(tmp_path / "notes.txt", "notes.txt")


def test_a_zipped_set_is_checked_like_a_folder(image_set, tmp_path):
    path = zipped(image_set, tmp_path / "mine.zip")
    assert check_path(path) == check_path(image_set)
    assert drawn(path, tmp_path, *AXES) == (512, 1024, 3)
    (image_set / "train" / "r_3.png").write_bytes(b"no picture")
    refused(zipped(image_set, path), "mine/train/r_3.png")
    path.write_bytes(path.read_bytes()[:500])
    refused(path, "mine.zip")
    folder = image_set.rename(tmp_path / "folder.zip")  # a folder is a folder whatever it is called
    refused(folder, "train/r_3.png")


def push_file(tmp_path, **changes):
    shapes = {"positions": (3, 1, 3), "quaternions": (3, 1, 4), "pusher": (3, 3), "actions": (2, 3)}
    arrays = {"contact": np.zeros((2, 1), bool), **{name: np.zeros(shape) for name, shape in shapes.items()}}
    with EpisodeFolder(tmp_path / "pushes.h5", {}) as folder:
        save_episode(folder.path(0), PushEpisode(("a",), 0, **(arrays | changes)))
        folder.combine(1)
    return tmp_path / "pushes.h5"


def test_push_files_are_checked(tmp_path):
    with EpisodeFolder(tmp_path / "empty.h5", {}) as folder:
        folder.combine(0)
    refused(tmp_path / "empty.h5", "no episodes")
    substates = {"sub_positions": np.zeros((2, 4, 1, 3)), "sub_quaternions": np.zeros((2, 4, 1, 4))}
    assert described(push_file(tmp_path, **substates)) == ("push file", {"episodes": 1, "steps": 2})
    wrong_shapes = {"actions": 3, "positions": (4, 1, 3), "sub_positions": (2, 4, 2, 3)}
    wrongs = {"pusher": np.full((3, 3), np.nan), **{name: np.zeros(shape) for name, shape in wrong_shapes.items()}}
    for name, wrong in wrongs.items():
        refused(push_file(tmp_path, **substates | {name: wrong}), f"{name} of episode 0")


def test_observations_are_described_and_drawn(tmp_path):
    folder, masks = tmp_path / "scene", np.zeros((4, 2, 16, 16), bool)
    masks[:3, 0, 4:9, 4:9] = True
    images = np.zeros((4, 16, 16, 3))
    write_observation(folder, Observation(default_cameras(16), images, ("a", "b"), masks, None, 0.0))
    facts = {"cameras": 4, "objects": 2, "width": 16, "height": 16, "masks": 3}
    assert described(folder) == ("observation", facts)
    assert drawn(folder, tmp_path, AXES[0]) == (384, 4 * 384, 3)
    refused(folder / "observation.json", "observation.json")
    (folder / "mask_1_0.png").unlink()
    refused(folder, "mask_1_0.png")


def test_states_are_described(tmp_path):
    state = SceneState(("a",), Pose.identity(1), Light(np.array([0, 0, 1.0])), None)
    path = tmp_path / "state.json"
    for reason in ("", "a: it hides"):
        write_estimated(path, EstimatedState(state, np.zeros(1), np.zeros(1), 0.0, (reason,), reason))
        assert described(path) == ("state", {"objects": 1, "trusted": not reason, "reason": reason})
    path.write_text(path.read_text().replace('"doubt": "', '"doubt": 3, "x": "'))
    refused(path, "doubt of object a")


def test_actions_and_networks_are_described(tmp_path):
    path = tmp_path / "actions.json"
    path.write_text(json.dumps({"actions": [[[0.1, 0, 0]] * 4] * 2, "step_s": 0.2}))
    assert described(path) == ("actions", {"sequences": 2, "steps": 4})
    path.write_text(json.dumps({"actions": [[[0.4, 0, 0]]]}))
    refused(path, "action 0 of sequence 0")
    write_network(tmp_path / "pushes.safetensors", PropagationNetwork(8, 2))
    assert described(tmp_path / "pushes.safetensors") == ("dynamics", {"hidden": 8, "steps": 2})
    save_file({"x": np.zeros(3)}, tmp_path / "other.safetensors", metadata={"format": "other"})
    refused(tmp_path / "other.safetensors", "format")


NAMES = ("003_cracker_box", "025_mug")
PLACES = np.array([[0.05, 0.1, 0.08], [-0.1, -0.05, 0.04]])


@pytest.fixture
def folder(tmp_path):
    """Two objects, whose masks are rectangles around their boxes."""
    cameras, poses = default_cameras(64), Pose(PLACES, np.tile([1.0, 0, 0, 0], (2, 1)))
    masks = box_masks(cameras, NAMES, poses)
    state = SceneState(NAMES, poses, Light(np.array([0, 0, 1.0])), None)
    observation = Observation(cameras, np.full((4, 64, 64, 3), 0.4), NAMES, masks, None, 0.0)
    return write_bop_scene(tmp_path / "000001", observation, state)


def edit_bop(path, change):
    content = json.loads(path.read_text())
    for entry in content.values():
        change(entry)
    path.write_text(json.dumps(content))


def test_a_good_scene_passes_and_its_overlay_shows_the_objects(folder, tmp_path):
    facts = {"images": 4, "objects": 2, "masks": 8, "notes": (), "cameras in a world": 4}
    assert described(folder) == ("scene of BOP", facts)
    assert drawn(folder, tmp_path, *AXES) == (288, 4 * 384, 3)
    edit_bop(folder / "scene_camera.json", lambda entry: entry.pop("cam_R_w2c"))
    assert check_path(folder).facts["cameras in a world"] == 0


def in_metres(entries):
    for entry in entries:
        entry["cam_t_m2c"] = [value / 1000 for value in entry["cam_t_m2c"]]


@pytest.mark.parametrize(
    ("file", "change", "datum"),
    [
        ("scene_gt.json", in_metres, "mm"),
        ("scene_camera.json", lambda entry: entry.pop("cam_K"), "'cam_K'"),
        ("scene_camera.json", lambda e: e.update(cam_K=[8 * k for k in e["cam_K"][:8]] + [1.0]), "cam_K"),
    ],
)
def test_a_scene_whose_parts_do_not_fit_is_refused(folder, file, change, datum):
    edit_bop(folder / file, change)
    refused(folder, datum)
