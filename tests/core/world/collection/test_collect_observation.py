import numpy as np
import pytest

from osfcore.errors import CannotWrite, InvalidInput, MissingAssets, UnknownName
from osfcore.io.observation_file import read_observation
from osfcore.io.scene_file import read_scene
from osfcore.world.collect_images import TRUTH_FILE, CollectObservation, collect_observation
from osfcore.world.tabletop import Tabletop

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
