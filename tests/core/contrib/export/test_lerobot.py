"""Data sets of LeRobot, read back by the readers of their files."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from osfcore.contrib.export.lerobot import (
    DatasetSize,
    LeRobotEpisode,
    environment_names,
    environment_state,
    image_statistics,
    instruction,
    pooled,
    statistics_of,
    write_dataset,
)
from osfcore.errors import InvalidInput
from tests.support.errors import about

BOX, MUG, CAN = "009_gelatin_box", "025_mug", "005_tomato_soup_can"
rows = arrays(np.float64, st.tuples(st.integers(1, 12), st.just(3)), elements=st.floats(-10, 10, width=32))


@given(st.lists(rows, min_size=1, max_size=4))
def test_statistics_of_parts_are_those_of_the_whole_with_quantiles_in_order(parts):
    together, whole = pooled([statistics_of(part) for part in parts]), statistics_of(np.concatenate(parts))
    for key in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(together[key], whole[key], atol=1e-9)
    ordered = np.array([whole[key] for key in ("min", "q01", "q10", "q50", "q90", "q99", "max")])
    assert np.all(np.diff(ordered, axis=0) >= -1e-9)


@pytest.mark.parametrize("side", [64, 320])
def test_statistics_of_images_are_those_of_all_their_pixels(side):
    images = np.random.default_rng(0).integers(0, (200, 90, 256), (4, side, side, 3), dtype=np.uint8)
    images[:, ::4, ::4] //= 2  # what every fourth pixel has, the others need not have
    found, pixels = image_statistics(images), images.reshape(-1, 3) / 255
    assert found["count"].tolist() == [4]
    expected = {"min": pixels.min(axis=0), "max": pixels.max(axis=0), "mean": pixels.mean(axis=0)}
    expected |= {
        "std": pixels.std(axis=0),
        "q10": np.quantile(pixels, 0.1, axis=0),
        "q99": np.quantile(pixels, 0.99, axis=0),
    }
    for key, colours in expected.items():
        np.testing.assert_allclose(found[key], colours[:, None, None], atol=1e-9)


def test_each_number_of_an_environment_state_has_its_name():
    state = environment_state(np.arange(14.0).reshape(2, 7), np.arange(100.0, 114).reshape(2, 7))
    by_name = dict(zip(environment_names(2), state, strict=True))
    assert (by_name["object_0_x"], by_name["object_1_qw"], by_name["goal_1_qz"]) == (0, 10, 113)


@pytest.mark.parametrize(
    ("names", "moved", "said"),
    [
        ((BOX,), (BOX,), "Push the gelatin box to its goal."),
        ((BOX, MUG), (MUG,), "Push the mug to its goal and leave the gelatin box where it is."),
        ((BOX, MUG, CAN), (), "Push the gelatin box, the mug and the tomato soup can to where the goal shows them."),
    ],
)
def test_tasks_are_said_in_words(names, moved, said):
    assert instruction(names, moved) == said  # a part of the data that policies learn from


def episode(count, task="Push it.", **given):
    steps = np.arange(2.0 * count).reshape(count, 2)
    return LeRobotEpisode(task, 0.001 * steps, 0.01 * steps, **given)


def test_rows_of_all_episodes_are_numbered_on(tmp_path):
    size = write_dataset(tmp_path / "set", [episode(3), episode(2, "Pull it."), episode(4)])
    assert size == DatasetSize(3, 9, 2)
    table = pq.read_table(tmp_path / "set" / "data").to_pydict()
    assert table["index"] == list(range(9))
    assert table["episode_index"] == [0] * 3 + [1] * 2 + [2] * 4
    assert table["frame_index"] == [0, 1, 2, 0, 1, 0, 1, 2, 3]
    assert table["task_index"] == [0] * 3 + [1] * 2 + [0] * 4
    np.testing.assert_allclose(table["timestamp"], 0.2 * np.array(table["frame_index"]), atol=1e-6)
    episodes = pq.read_table(tmp_path / "set" / "meta" / "episodes").to_pydict()
    assert episodes["dataset_from_index"] == [0, 3, 5]
    assert episodes["dataset_to_index"] == [3, 5, 9]
    assert episodes["tasks"] == [["Push it."], ["Pull it."], ["Push it."]]

    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    np.testing.assert_allclose(stats["action"]["mean"], np.mean(table["action"], axis=0), atol=1e-6)


def test_its_info_describes_its_columns(tmp_path):
    write_dataset(tmp_path / "set", [episode(3, environment=np.ones((3, 28)))])
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    columns = pq.read_schema(tmp_path / "set" / info["data_path"].format(chunk_index=0, file_index=0)).names
    assert set(info["features"]) == set(columns)
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", 5, {"train": "0:1"})
    assert info["video_path"] is None
    for feature in info["features"].values():
        assert feature["names"] is None or [len(feature["names"])] == feature["shape"]


@pytest.mark.parametrize(
    ("episodes", "subject"),
    [
        ([], "number of episodes"),
        ([episode(0)], "number of actions in an episode"),
        ([episode(2, environment=np.ones((3, 14)))], "rows of observation.environment_state"),
        ([episode(2), episode(2, environment=np.ones((2, 14)))], "episode 1"),
        ([episode(2, images={"top": np.zeros((2, 9, 8, 3), np.uint8)})], "size of images"),
    ],
)
def test_malformed_data_sets_are_refused_and_leave_nothing(tmp_path, episodes, subject):
    with pytest.raises(InvalidInput, check=about(subject)):
        write_dataset(tmp_path / "set", episodes)
    assert list(tmp_path.iterdir()) == []
