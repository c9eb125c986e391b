import json
from pathlib import Path

import numpy as np
import pytest

from osfcore.errors import CannotWrite, InvalidInput, MissingAssets, UnknownName
from osfcore.io.image_set import read_image_set, read_splits
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
from tests.support.errors import about

MUSTARD = "006_mustard_bottle"
NAMES = ("003_cracker_box", "009_gelatin_box")


@pytest.fixture(scope="module")
def object_set(library, tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "mustard"
    steps = list(collect_object(CollectObject(MUSTARD, out, images=100, size=64, seed=3), library))
    assert steps[-1].done == steps[-1].total == 100
    return out


def test_set_is_in_the_osf_format_and_its_seed_decides_it(library, object_set, tmp_path):
    for split, count in (("train", 60), ("test", 40)):
        entries = json.loads((object_set / split / "anno.json").read_text())
        assert len(entries) == count
        for entry in entries:
            assert {"filename", "RT", "K", "light_pos", "resolution"} <= set(entry)
            assert np.linalg.norm(entry["light_pos"]) == pytest.approx(1)
    assert read_splits(object_set)[0].rgba.shape == (60, 64, 64, 4)
    again = collect_object(CollectObject(MUSTARD, tmp_path / "again", images=100, size=64, seed=3), library)
    for _ in range(61):
        next(again)
    (partial,) = tmp_path.glob(".again*")
    for file in ("train/anno.json", "train/0007.png", "test/0000.png"):
        assert (partial / file).read_bytes() == (object_set / file).read_bytes()
    again.close()
    assert not list(tmp_path.iterdir())  # an abandoned set leaves nothing


def test_views_and_lights_cover_the_sphere_and_no_test_one_is_a_training_one(object_set):
    def angles_deg(a, b):
        return np.rad2deg(np.arccos(np.clip(a @ b.T, -1, 1)))

    sphere = np.random.default_rng(0).normal(size=(500, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    splits = read_splits(object_set)
    views = [np.array([camera.T_world_camera.position for camera in split.cameras]) for split in splits]
    for both in (views, [split.light_directions for split in splits]):
        found, others = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in both)
        assert angles_deg(others, found).min() > 0.05
        assert angles_deg(sphere, found).min(axis=1).max() < 50


def test_object_fills_the_frame_without_touching_its_border_with_straight_alpha(object_set):
    reach, train = [], read_image_set(object_set, "train").rgba
    for image in train:
        alpha = image[..., 3] > 0
        y, x = np.nonzero(alpha)
        reach.append(np.hypot(x + 0.5 - 32, y + 0.5 - 32).max() / 32)
        assert not alpha[[0, -1]].any()
    assert 0.8 < max(reach) <= 0.89  # the bounding sphere spans 87 %
    rgba = train[0].astype(float)
    partial = (rgba[..., 3] > 0) & (rgba[..., 3] < 255)
    assert partial.sum() > 20
    inside = rgba[rgba[..., 3] == 255][:, :3].mean()
    assert rgba[partial][:, :3].mean() > 0.4 * inside  # not darkened by the background


def test_table_set_shows_lambert_radiance(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    list(collect_table(CollectTable(Path("."), images=60, size=32)))  # an empty folder will do
    images = read_image_set(tmp_path / "here", "test")
    heights = images.light_directions[:, 2]
    for camera, height, rgba in zip(images.cameras, heights, images.rgba, strict=True):
        x, y = np.floor(camera.project(np.zeros(3))).astype(int)
        expected = np.array(TABLE_ALBEDO) * (0.25 + 0.75 * height)
        np.testing.assert_allclose(rgba[y, x, :3] / 255, expected, atol=1 / 255)
    assert heights.min() < np.sin(np.deg2rad(15)) < np.sin(np.deg2rad(60)) < heights.max()


def test_impossible_sets_are_refused_and_leave_nothing(library, tmp_path):
    wrong = {InvalidInput: [{"images": 59}, {"images": 6000}, {"size": 15}, {"size": 2000}, {"seed": -1}]}
    wrong |= {UnknownName: [{"name": "teapot"}], MissingAssets: [{"name": "024_bowl"}]}
    for error, changes in (wrong | {CannotWrite: [{"out": Path("/proc/sets/object")}]}).items():
        for change in changes:
            with pytest.raises(error):
                list(collect_object(CollectObject(**{"name": MUSTARD, "out": tmp_path / "out", **change}), library))
    assert not list(tmp_path.iterdir())


def test_two_collections_into_one_folder_do_not_destroy_each_other(tmp_path):
    config = CollectTable(tmp_path / "table", images=60, size=16)
    first, second = collect_table(config), collect_table(config)
    next(first)
    next(second)
    list(first)
    with pytest.raises(CannotWrite):
        list(second)
    assert len(read_image_set(tmp_path / "table", "test").rgba) == 40
    assert [path.name for path in tmp_path.iterdir()] == ["table"]
    with pytest.raises(InvalidInput, check=about("output folder")):
        list(collect_table(config))


# Observations


def test_observation_shows_the_truth(library, tables, tmp_path):
    made = collect_observation(CollectObservation(tmp_path / "scene", NAMES, seed=4, size=32), library)
    read = read_observation(tmp_path / "scene")
    assert read.names == NAMES
    assert [camera.name for camera in read.cameras] == ["0", "1", "2", "3"]
    np.testing.assert_array_equal(read.masks, made.masks)
    assert read.masks.any(axis=(2, 3)).all()
    truth = read_scene(tmp_path / "scene" / TRUTH_FILE)
    np.testing.assert_allclose(truth.state.pusher, read.pusher, atol=1e-12)
    world = tables()
    world.restore(truth.state)
    again = world.render(truth.cameras).images
    assert np.abs(again - read.images).max() <= 0.5 / 255 + 1e-3


def test_a_goal_is_one_view_without_pusher_and_masks(library, tmp_path):
    collect_observation(CollectObservation(tmp_path / "goal", NAMES, seed=4, size=32, goal=True), library)
    read = read_observation(tmp_path / "goal")
    assert [camera.name for camera in read.cameras] == ["goal"]
    assert (read.masks, read.pusher) == (None, None)
    assert read_scene(tmp_path / "goal" / TRUTH_FILE).state.pusher is None


@pytest.mark.slow
def test_a_random_choice_depends_on_the_seed_alone_and_is_among_the_known(library, tmp_path):
    known = (*NAMES, "005_tomato_soup_can", "spoon")
    made = [
        collect_observation(CollectObservation(tmp_path / str(n), objects=2, seed=seed, size=16), library, known)
        for n, seed in enumerate((0, 0, 1, 2, 3))
    ]
    chosen = {observation.names for observation in made}
    assert set().union(*chosen) < set(known)
    assert len(chosen) > 1
    np.testing.assert_array_equal(made[0].images, made[1].images)


def test_impossible_observations_are_refused_and_leave_nothing(library, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("precious")
    for changes, kind, subject in (
        ({"names": ("teapot",)}, UnknownName, "teapot"),
        ({"names": ("024_bowl",)}, MissingAssets, "024_bowl"),
        ({"names": None, "objects": 3}, InvalidInput, "number of objects"),
        ({"names": None, "objects": 0}, InvalidInput, "number of objects"),
        ({"size": 5}, InvalidInput, "image size"),
        ({"seed": -1}, InvalidInput, "seed"),
        ({"out": tmp_path / "full"}, InvalidInput, "output folder"),
        ({"out": tmp_path / "full" / "file" / "new"}, CannotWrite, "full"),
    ):
        config = CollectObservation(**{"out": tmp_path / "new", "names": NAMES, **changes})
        with pytest.raises(kind, check=about(subject)):
            collect_observation(config, library, NAMES)
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["full", "full/file"]
