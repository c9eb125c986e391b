"""Collect images: collect images, collect observation."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from osfcore.errors import CannotWrite, InvalidInput, MissingAssets, UnknownName
from osfcore.io.image_set import read_annotations
from osfcore.io.observation_file import read_observation
from osfcore.io.scene_file import read_scene
from osfcore.world.collect_images import (
    TRUTH_FILE,
    CollectObject,
    CollectObservation,
    CollectTable,
    collect_object,
    collect_observation,
    collect_table,
)
from osfcore.world.imaging import TABLE_ALBEDO
from osfcore.world.tabletop import Tabletop

# Collect images


@pytest.fixture(scope="module")
def object_set(library, tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "mustard"
    steps = list(collect_object(CollectObject("006_mustard_bottle", out, images=100, size=64, seed=3), library))
    assert steps[-1].done == steps[-1].total == 100
    return out


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arccos(np.clip(a @ b.T, -1, 1)))


def directions(images) -> tuple[np.ndarray, np.ndarray]:
    views = np.array([i.camera.T_world_camera.position for i in images])
    return views / np.linalg.norm(views, axis=1, keepdims=True), np.array([i.light_direction for i in images])


def test_set_is_in_the_osf_format(object_set):
    for split, count in (("train", 60), ("test", 40)):
        entries = json.loads((object_set / split / "anno.json").read_text())
        assert len(entries) == count
        for entry in entries:
            assert {"filename", "RT", "K", "light_pos", "resolution"} <= set(entry)
            assert entry["resolution"] == 64
            rotation = np.array(entry["RT"])[:, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
            assert np.linalg.norm(entry["light_pos"]) == pytest.approx(1)
            image = cv2.imread(str(object_set / split / entry["filename"]), cv2.IMREAD_UNCHANGED)
            assert image.shape == (64, 64, 4)


def test_views_and_lights_cover_the_sphere_and_no_test_one_is_a_training_one(object_set):
    train, test = (directions(read_annotations(object_set, split)) for split in ("train", "test"))
    sphere = np.random.default_rng(0).normal(size=(500, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    for kind in (0, 1):
        assert angles_deg(test[kind], train[kind]).min() > 0.05
        assert angles_deg(sphere, train[kind]).min(axis=1).max() < 50


def test_object_fills_the_frame_without_touching_its_border(object_set):
    reach = []
    for image in read_annotations(object_set, "train"):
        alpha = cv2.imread(str(image.path), cv2.IMREAD_UNCHANGED)[..., 3] > 0
        y, x = np.nonzero(alpha)
        reach.append(np.hypot(x + 0.5 - 32, y + 0.5 - 32).max() / 32)
        assert not alpha[0].any()
        assert not alpha[-1].any()
    assert 0.8 < max(reach) <= 0.89  # the bounding sphere spans 87 %


def test_alpha_is_straight_and_edges_are_smooth(object_set):
    image = next(iter(read_annotations(object_set, "train")))
    rgba = cv2.imread(str(image.path), cv2.IMREAD_UNCHANGED).astype(float)
    partial = (rgba[..., 3] > 0) & (rgba[..., 3] < 255)
    assert partial.sum() > 20
    inside = rgba[rgba[..., 3] == 255][:, :3].mean()
    assert rgba[partial][:, :3].mean() > 0.4 * inside  # not darkened by the background


def test_same_seed_same_set(library, object_set, tmp_path):
    again = tmp_path / "again"
    list(collect_object(CollectObject("006_mustard_bottle", again, images=100, size=64, seed=3), library))
    assert (again / "test" / "anno.json").read_text() == (object_set / "test" / "anno.json").read_text()
    assert (again / "train" / "0007.png").read_bytes() == (object_set / "train" / "0007.png").read_bytes()


def test_table_set_shows_lambert_radiance(tmp_path):
    out = tmp_path / "table"
    list(collect_table(CollectTable(out, images=60, size=32)))
    elevations = []
    for image in read_annotations(out, "test"):
        rgb = cv2.imread(str(image.path), cv2.IMREAD_UNCHANGED)[..., 2::-1] / 255
        expected = np.array(TABLE_ALBEDO) * (0.25 + 0.75 * image.light_direction[2])
        x, y = np.floor(image.camera.project(np.array([0.0, 0.0, 0.0]))).astype(int)
        np.testing.assert_allclose(rgb[y, x], expected, atol=1 / 255)
        elevations.append(np.rad2deg(np.arcsin(image.light_direction[2])))
    assert min(elevations) < 15
    assert max(elevations) > 60


@pytest.mark.parametrize(("images", "size"), [(59, 64), (6000, 64), (100, 15), (100, 2000)])
def test_numbers_out_of_range_are_refused(library, tmp_path, images, size):
    with pytest.raises(InvalidInput):
        list(collect_object(CollectObject("006_mustard_bottle", tmp_path / "out", images, size), library))
    assert not list(tmp_path.iterdir())


def test_unknown_and_missing_objects_are_told(library, tmp_path):
    with pytest.raises(UnknownName):
        list(collect_object(CollectObject("teapot", tmp_path / "out"), library))
    with pytest.raises(MissingAssets):
        list(collect_object(CollectObject("024_bowl", tmp_path / "out"), library))


def test_a_negative_seed_and_an_unwritable_place_are_told(tmp_path):
    with pytest.raises(InvalidInput, match="seed"):
        list(collect_table(CollectTable(tmp_path / "out", seed=-1)))
    with pytest.raises(CannotWrite, match="/proc/sets"):
        list(collect_table(CollectTable(Path("/proc/sets/table"))))


def test_the_current_folder_will_do_if_it_is_empty(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    list(collect_table(CollectTable(Path("."), images=60, size=16)))
    assert (tmp_path / "here" / "test" / "anno.json").exists()


def test_two_collections_into_one_folder_do_not_destroy_each_other(tmp_path):
    config = CollectTable(tmp_path / "table", images=60, size=16)
    first, second = collect_table(config), collect_table(config)
    next(first)
    next(second)
    list(first)
    with pytest.raises(CannotWrite):
        list(second)
    assert len(read_annotations(tmp_path / "table", "test")) == 40
    assert [path.name for path in tmp_path.iterdir()] == ["table"]


def test_full_folder_is_left_alone_and_an_abandoned_set_leaves_nothing(library, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("precious")
    with pytest.raises(InvalidInput, match="new or empty"):
        list(collect_object(CollectObject("006_mustard_bottle", tmp_path / "mine"), library))
    steps = collect_object(CollectObject("006_mustard_bottle", tmp_path / "out", 100, 32), library)
    for _ in range(3):
        next(steps)
    steps.close()
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


# Collect observation


NAMES = ("003_cracker_box", "009_gelatin_box")


def test_what_is_written_is_what_the_cameras_see_of_the_truth(library, tmp_path):
    made = collect_observation(CollectObservation(tmp_path / "scene", NAMES, seed=4, size=32), library)
    read = read_observation(tmp_path / "scene")
    assert read.names == NAMES
    assert [camera.name for camera in read.cameras] == ["0", "1", "2", "3"]
    np.testing.assert_array_equal(read.masks, made.masks)
    assert read.masks.any(axis=(2, 3)).all()
    truth = read_scene(tmp_path / "scene" / TRUTH_FILE)
    np.testing.assert_allclose(truth.state.pusher, read.pusher, atol=1e-12)
    world = Tabletop(library)
    world.restore(truth.state)
    again = world.render(truth.cameras).images
    world.close()
    assert np.abs(again - read.images).max() <= 0.5 / 255 + 1e-3


def test_a_goal_is_one_view_without_pusher_and_masks(library, tmp_path):
    collect_observation(CollectObservation(tmp_path / "goal", NAMES, seed=4, size=32, goal=True), library)
    read = read_observation(tmp_path / "goal")
    assert [camera.name for camera in read.cameras] == ["goal"]
    assert (read.masks, read.pusher) == (None, None)
    assert read_scene(tmp_path / "goal" / TRUTH_FILE).state.pusher is None


def test_a_random_choice_depends_on_the_seed_alone_and_is_among_the_known(library, tmp_path):
    known = (*NAMES, "005_tomato_soup_can", "spoon")
    chosen = set()
    for number, seed in enumerate((0, 0, 1, 2, 3)):
        config = CollectObservation(tmp_path / str(number), objects=2, seed=seed, size=16)
        chosen.add(collect_observation(config, library, known).names)
        assert set().union(*chosen) < set(known)
    first, second = (read_observation(tmp_path / name) for name in "01")
    np.testing.assert_array_equal(first.images, second.images)
    assert len(chosen) > 1


def test_mistakes_are_told_and_leave_nothing(library, tmp_path):
    for changes, kind, words in (
        ({"names": ("teapot",)}, UnknownName, "teapot"),
        ({"names": ("024_bowl",)}, MissingAssets, "024_bowl"),
        ({"objects": 3}, InvalidInput, "between 1 and 2"),
        ({"objects": 0}, InvalidInput, "between 1 and 2"),
        ({"size": 5}, InvalidInput, "image size"),
        ({"seed": -1}, InvalidInput, "seed"),
    ):
        with pytest.raises(kind, match=words):
            collect_observation(CollectObservation(**{"out": tmp_path / "new", **changes}), library, NAMES)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    with pytest.raises(InvalidInput, match="new or empty"):
        collect_observation(CollectObservation(tmp_path / "full", NAMES), library)
    with pytest.raises(CannotWrite):
        collect_observation(CollectObservation(tmp_path / "full" / "file" / "new", NAMES), library)
