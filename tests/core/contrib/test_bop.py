"""Scenes, results, masks and poses in the formats of BOP and PoseCNN."""

import json
from dataclasses import replace

import numpy as np
import pytest

from osfcore.contrib.bop import BopChoice, bop_results, read_bop_scene, read_masks
from osfcore.contrib.pose_files import PoseChoice, read_poses
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.estimation.objective import resting_orientations
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import Pose, quaternion_exp, rotation_angle
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.image_file import write_png
from osfcore.photo.pose_loss import TablePrior
from tests.support.bop_scenes import annotation, box_masks, write_bop_scene, write_models_info
from tests.support.errors import about
from tests.support.posed_scenes import NAMES, lying, scene, shipped_models

# Our own scene, written as BOP does, is read as it was; results are what BOP's toolkit reads.


LINEAR = BopChoice(encoding="linear")
CENTRES = {"003_cracker_box": (0.01, -0.02, 0.03), "006_mustard_bottle": (-0.015, 0.0, 0.002)}


@pytest.fixture(scope="module")
def fields():
    return FieldLibrary(None)


@pytest.fixture(scope="module")
def prior(fields):
    return lambda name: TablePrior(resting_orientations(fields.load(name)))


@pytest.fixture(scope="module")
def rendered(fields):
    """Observation and true state of two objects that stand on the table; the pictures are noise."""
    rng, models = np.random.default_rng(3), shipped_models()
    state = scene({name: lying(models, name, 0, x, 0.03) for x, name in zip((-0.08, 0.1), NAMES, strict=True)})
    images, cameras = rng.integers(0, 256, (4, 64, 64, 3)) / 255, default_cameras(64)
    masks = box_masks(cameras, NAMES, state.poses) & (rng.random((4, 2, 64, 64)) > 0.5)
    return Observation(cameras, images.astype(np.float32), NAMES, masks, None, 0.0), state


@pytest.fixture
def folder(rendered, tmp_path):
    return write_bop_scene(tmp_path / "000048", *rendered)


def same(a, b):
    return np.abs(a.position - b.position).max() < 1e-6 and rotation_angle(a.quaternion, b.quaternion) < 1e-5


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_what_was_written_is_read(folder, rendered):
    observation, state = rendered
    found = read_bop_scene(folder, LINEAR)
    read = found.observation
    assert [camera.name for camera in read.cameras] == ["3", "6", "9", "12"]
    assert read.names == NAMES
    for ours, theirs in zip(observation.cameras, read.cameras, strict=True):
        assert same(ours.T_world_camera, theirs.T_world_camera)
        np.testing.assert_allclose(theirs.intrinsics, ours.intrinsics, atol=1e-9)
    for name in NAMES:
        assert same(found.poses[name], state.pose(name))
    np.testing.assert_array_equal(read.masks, observation.masks)
    np.testing.assert_allclose(read.images, observation.images, atol=1e-6)


@pytest.mark.parametrize("centres", [None, CENTRES])
def test_results_are_read_by_the_rules_of_the_toolkit(rendered, tmp_path, centres):
    observation, state = rendered
    folder = write_bop_scene(tmp_path / "000048", *rendered, centres=centres)
    models = None if centres is None else write_models_info(tmp_path / "models", centres)
    found = read_bop_scene(folder, BopChoice(encoding="linear", models=models))
    assert all(same(found.poses[name], state.pose(name)) for name in NAMES)
    estimate = EstimatedState(state, np.array([0.0, 0.001]), np.zeros(2), 0.0, ("", ""), "")
    text = bop_results(estimate, found.observation.cameras, 48, models, 2.5)
    header, *lines = text.splitlines()
    assert header == "scene_id,im_id,obj_id,score,R,t,time"
    annotations = json.loads((folder / "scene_gt.json").read_text())
    assert len(lines) == len(annotations) * len(NAMES)
    for line in lines:
        scene_id, im_id, obj_id, score, R, t, seconds = line.split(",")  # as bop_toolkit_lib.inout.load_bop_results
        (truth,) = (e for e in annotations[im_id] if e["obj_id"] == int(obj_id))
        np.testing.assert_allclose(np.array(R.split(), float), truth["cam_R_m2c"], atol=1e-6)
        np.testing.assert_allclose(np.array(t.split(), float), truth["cam_t_m2c"], atol=1e-3)
        assert (int(scene_id), float(seconds)) == (48, 2.5)
        assert float(score) == {2: 1.0, 5: 0.5}[int(obj_id)]
    if centres is None:
        (tmp_path / "results.csv").write_text(text)
        poses = read_poses(tmp_path / "results.csv", PoseChoice(image=6))
        T_camera_world = observation.cameras[1].T_world_camera.inverse()
        assert all(same(poses[name], T_camera_world @ state.pose(name)) for name in NAMES)
    pear = replace(estimate, state=replace(state, names=("016_pear", NAMES[1])))
    refused(UnknownName, "016_pear", bop_results, pear, observation.cameras, 1)
    refused(InvalidInput, "name of a camera", bop_results, estimate, (replace(observation.cameras[0], name="goal"),), 1)


def test_a_table_is_found_under_the_objects_of_any_world(rendered, prior, tmp_path):
    observation, state = rendered
    T = observation.cameras[0].T_world_camera.inverse()  # to the world of the first camera
    cameras = tuple(replace(camera, T_world_camera=T @ camera.T_world_camera) for camera in observation.cameras)
    moved = replace(observation, cameras=cameras), replace(state, poses=T @ state.poses)
    folder = write_bop_scene(tmp_path / "000048", *moved)
    with pytest.raises(InvalidInput, check=about("height of image 3")):
        read_bop_scene(folder, LINEAR)
    found = read_bop_scene(folder, LINEAR, table_prior=prior)
    for name in NAMES:
        np.testing.assert_allclose(found.poses[name].position[2], state.pose(name).position[2], atol=4e-3)
        for ours, theirs in zip(observation.cameras, found.observation.cameras, strict=True):
            place = theirs.project(found.poses[name].position)
            np.testing.assert_allclose(place, ours.project(state.pose(name).position), atol=1e-2)


def test_the_table_is_found_without_objects_that_nobody_knows(folder, rendered, fields, prior):
    observation, state = rendered
    number = 18  # the marker, of which there is no field

    def add_marker(content):
        for entries, camera in zip(content.values(), observation.cameras, strict=True):
            floating = camera.T_world_camera.inverse() @ Pose(np.array([0.0, 0, 0.3]), state.poses.quaternion[0])
            entries.append(annotation(floating, number))

    edit(folder / "scene_gt.json", add_marker)
    found = read_bop_scene(folder, LINEAR, table_prior=prior, known=fields.names())
    assert (found.observation.names, tuple(found.left_out)) == (NAMES, ("040_large_marker",))
    edit(folder / "scene_camera.json", without_places)
    with pytest.raises(InvalidInput, check=about("cam_R_w2c and cam_t_w2c of image 3")):
        read_bop_scene(folder, LINEAR, table_prior=prior)


def test_an_object_that_is_there_twice_and_one_that_nobody_knows_are_left_out(folder):
    def change(content):
        content["9"] += [{**content["9"][1], "cam_t_m2c": [0, 0, 700]}, {**content["9"][0], "obj_id": 30}]
        content["6"].append({**content["6"][0], "obj_id": 30, "cam_t_m2c": [0, 0, -500]})  # out of view

    edit(folder / "scene_gt.json", change)
    found = read_bop_scene(folder, LINEAR, known=NAMES)
    assert found.observation.names == NAMES[:1]
    assert {name: "several" in why for name, why in found.left_out.items()} == {NAMES[1]: True, "object 30": False}
    assert [note for note in found.notes if "Image 9" in note and NAMES[1] in note]
    assert [note for note in found.notes if "Image 9" in note and "object 30" in note]
    refused(InvalidInput, f"object {NAMES[1]}", read_bop_scene, folder, LINEAR, NAMES)
    assert read_bop_scene(folder, BopChoice((3, 6), "linear"), NAMES).observation.names == NAMES


def test_images_without_annotation_are_left_out_and_missing_masks_told(folder, rendered):
    edit(folder / "scene_gt.json", lambda content: content.pop("9"))
    (folder / "mask_visib" / "000006_000001.png").unlink()
    found = read_bop_scene(folder, LINEAR)
    assert [camera.name for camera in found.observation.cameras] == ["3", "6", "12"]
    assert found.observation.unmasked.tolist() == [[False, False], [False, True], [False, False]]
    assert [note for note in found.notes if "Image 9" in note and "annotation" in note]
    assert [note for note in found.notes if "Image 6" in note and NAMES[1] in note]
    edit(folder / "scene_camera.json", lambda content: content.pop("12"))
    assert [note for note in read_bop_scene(folder, LINEAR).notes if "Image 12" in note and "camera" in note]
    for mask in (folder / "mask_visib").iterdir():
        mask.unlink()
    refused(InvalidInput, "masks of the objects", read_bop_scene, folder, LINEAR)


def test_objects_of_another_data_set_are_not_taken_for_those_of_ycb_video(folder, rendered, tmp_path):
    """Neither where its models have other sizes, nor where the masks do; its own names count."""
    models, sizes = tmp_path / "models", {NAMES[0]: (76.0, 78.0, 92.0)}
    write_models_info(models, CENTRES, sizes)
    for size in ("76 x 78 x 92", "71.8 x 164 x 213"):
        refused(CorruptFile, size, read_bop_scene, folder, LINEAR)
    (models / "models_info.json").unlink()
    models.rmdir()
    names = {NAMES[0]: "ape", NAMES[1]: "benchvise"}
    write_models_info(models, dict.fromkeys(NAMES, np.zeros(3)), {name: (90.0, 150.0, 200.0) for name in NAMES}, names)
    assert read_bop_scene(folder, LINEAR).observation.names == ("ape", "benchvise")
    (models / "models_info.json").unlink()
    edit(folder / "scene_gt.json", lambda c: [e.update(obj_id=6) for entries in c.values() for e in entries[:1]])
    edit(folder / "scene_gt.json", lambda c: [entries.pop() for entries in c.values()])
    refused(InvalidInput, "mask of 007_tuna_fish_can", read_bop_scene, folder, LINEAR)


def without_places(content):
    for entry in content.values():
        del entry["cam_R_w2c"], entry["cam_t_w2c"]


def in_metres(content):
    for entry in content.values():
        entry["cam_t_w2c"] = (np.array(entry["cam_t_w2c"]) / 1e3).tolist()


@pytest.mark.parametrize(
    ("file", "change", "what"),
    [
        ("scene_camera.json", without_places, "cam_R_w2c and cam_t_w2c of image 3"),
        ("scene_camera.json", in_metres, "image 3's camera in BOP's world"),
        ("scene_camera.json", lambda c: c["3"].pop("cam_K"), "cam_K"),
        ("scene_camera.json", lambda c: c.clear(), "images"),
        ("scene_camera.json", lambda c: c["3"]["cam_R_w2c"].__setitem__(0, 3.0), "cam_R_w2c of image 3"),
        ("scene_gt.json", lambda c: c.clear(), "poses and masks"),
    ],
)
def test_scenes_that_make_no_sense_are_refused(folder, file, change, what):
    edit(folder / file, change)
    with pytest.raises((InvalidInput, CorruptFile), check=about(what)):
        read_bop_scene(folder, LINEAR)


def refused(kind, what, read, *arguments):
    with pytest.raises(kind, check=about(what)):
        read(*arguments)


def test_what_is_chosen_must_be_there(folder):
    chosen = read_bop_scene(folder, BopChoice((9,), "linear"), NAMES[1:]).observation
    assert ([camera.name for camera in chosen.cameras], chosen.names) == (["9"], NAMES[1:])
    refused(InvalidInput, "image", read_bop_scene, folder, BopChoice((4,)))
    refused(InvalidInput, "object", read_bop_scene, folder, LINEAR, ("025_mug",))
    known = read_bop_scene(folder, LINEAR, known=NAMES[:1])
    assert (known.observation.names, tuple(known.left_out)) == (NAMES[:1], NAMES[1:])
    (folder / "rgb" / "000003.png").unlink()
    refused(CorruptFile, "000003.png", read_bop_scene, folder)
    refused(CorruptFile, "scene_camera.json", read_bop_scene, folder / "rgb")
    refused(CorruptFile, "models_info.json", read_bop_scene, folder, BopChoice(models=folder))


# Masks in folders: by name, and as BOP numbers them.


POSE = Pose(np.array([0.05, -0.1, 0.8]), quaternion_exp(np.array([0.4, -1.2, 0.3])))
KNOWN = ("025_mug", "003_cracker_box", "009_gelatin_box")
SIZE, HALF = (80, 60), (40, 30)


def mask_at(left, value=255, size=SIZE):
    image = np.zeros((size[1], size[0]), np.uint8)
    image[10:30, left : left + 20] = value
    return image


@pytest.mark.parametrize(("name", "value"), [("025_mug.png", 1), ("mask_025_mug.png", 255)])
def test_masks_by_name_are_reduced_with_the_photo(tmp_path, name, value):
    write_png(tmp_path / name, mask_at(10, value))
    write_png(tmp_path / "photo.png", mask_at(0))
    masks = read_masks(tmp_path, KNOWN, (SIZE, SIZE))
    assert list(masks) == ["025_mug"]
    np.testing.assert_array_equal(masks["025_mug"], mask_at(10) > 0)
    reduced = read_masks(tmp_path, KNOWN, (SIZE, HALF))["025_mug"]
    np.testing.assert_array_equal(reduced, mask_at(10)[::2, ::2] > 0)


@pytest.mark.parametrize("place", [".", ".."])
def test_masks_of_bop(tmp_path, place):
    folder = tmp_path / "mask_visib"
    for image, index, left in ((1, 0, 0), (1, 1, 20), (2, 0, 40)):
        write_png(folder / f"{image:06d}_{index:06d}.png", mask_at(left))
    refused(InvalidInput, "scene_gt.json of the masks", read_masks, folder, KNOWN, (SIZE, SIZE), 1)
    content = {"1": [annotation(POSE, 14), annotation(POSE, 2)], "2": [annotation(POSE, 8)]}
    (folder / place / "scene_gt.json").write_text(json.dumps(content))
    masks = read_masks(folder, KNOWN, (SIZE, SIZE), 1)
    assert list(masks) == ["025_mug", "003_cracker_box"]
    assert masks["003_cracker_box"][20, 30]
    assert list(read_masks(folder, KNOWN, (SIZE, SIZE), 2)) == ["009_gelatin_box"]
    refused(InvalidInput, "image of the masks", read_masks, folder, KNOWN, (SIZE, SIZE))


def test_folders_without_masks_of_the_photo_are_refused(tmp_path):
    asked = KNOWN, (SIZE, SIZE)
    refused(InvalidInput, "folder of masks", read_masks, tmp_path / "none", *asked)
    refused(InvalidInput, "number of masks", read_masks, tmp_path, *asked)
    for mask, what in (
        (mask_at(0, 0), "number of masks"),
        (mask_at(10, size=(64, 48)), "size of the mask 025_mug.png"),
    ):
        write_png(tmp_path / "025_mug.png", mask)
        refused(InvalidInput, what, read_masks, tmp_path, *asked)
    (tmp_path / "025_mug.png").write_text("no picture")
    refused(CorruptFile, "025_mug.png", read_masks, tmp_path, *asked)
