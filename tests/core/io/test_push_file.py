from dataclasses import fields, replace

import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.io.push_file import (
    Disturbed,
    EpisodeFolder,
    PushEpisode,
    load_episode,
    read_pushes,
    read_sound_pushes,
    save_episode,
)
from tests.support.errors import about


def episode(seed: int, *, frames: bool = False) -> PushEpisode:
    rng = np.random.default_rng(seed)
    return PushEpisode(
        ("a", "b"),
        seed,
        rng.normal(size=(4, 2, 3)),
        rng.normal(size=(4, 2, 4)),
        rng.normal(size=(4, 3)),
        rng.normal(size=(3, 3)),
        rng.random((3, 2)) < 0.5,
        rng.normal(size=(3, 4, 2, 3)) if seed % 2 else None,
        rng.normal(size=(3, 4, 2, 4)) if seed % 2 else None,
        rng.integers(0, 255, (4, 8, 8, 3), np.uint8) if frames else None,
    )


def disturbed(rows: int = 5) -> Disturbed:
    rng = np.random.default_rng(rows)
    shapes = ((3,), (4,), (3,), (3,), (3,), (4,))
    return Disturbed(np.arange(rows), *(rng.normal(size=(rows, 2, *s)).astype(np.float32) for s in shapes))


def assert_same(a: PushEpisode, b: PushEpisode) -> None:
    assert (a.names, a.seed) == (b.names, b.seed)
    for name in ("positions", "quaternions", "pusher", "actions", "contact", "sub_positions", "frames"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("rows", [0, 5])
def test_disturbed_states_survive_both_files(tmp_path, rows):
    original = replace(episode(1), disturbed=disturbed(rows))
    with EpisodeFolder(tmp_path / "pushes.h5", {}) as folder:
        save_episode(folder.path(0), original)
        kept = load_episode(folder.path(0))
        folder.combine(1)
    for found in (kept, *read_pushes(tmp_path / "pushes.h5")):
        assert_same(found, original)
        for field in fields(Disturbed):
            np.testing.assert_array_equal(getattr(found.disturbed, field.name), getattr(original.disturbed, field.name))
    assert read_sound_pushes(tmp_path / "pushes.h5")[0].disturbed is not None


@pytest.mark.parametrize("change", ["nan", "short"])
def test_unsound_disturbed_states_are_refused(tmp_path, change):
    rows = disturbed()
    wrong = np.full_like(rows.linear, np.nan) if change == "nan" else rows.linear[:3]
    with EpisodeFolder(tmp_path / "pushes.h5", {}) as folder:
        save_episode(folder.path(0), replace(episode(1), disturbed=replace(rows, linear=wrong)))
        folder.combine(1)
    with pytest.raises(CorruptFile, check=about("disturbed_linear of episode 0")):
        read_sound_pushes(tmp_path / "pushes.h5")
    (tmp_path / "pushes.h5").write_bytes(b"not HDF5")
    with pytest.raises(CorruptFile):
        read_pushes(tmp_path / "pushes.h5")


def test_combined_file_holds_all_episodes_in_order_and_the_folder_goes(tmp_path):
    out = tmp_path / "pushes.h5"
    with EpisodeFolder(out, {"seed": 0}) as folder:
        for index in (2, 0, 1):
            save_episode(folder.path(index), episode(index, frames=index == 2))
            assert_same(load_episode(folder.path(index)), episode(index, frames=index == 2))
        assert folder.finished() == {0, 1, 2}
        folder.combine(3)
    for index, stored in enumerate(read_pushes(out)):
        assert_same(stored, episode(index, frames=index == 2))
    assert list(tmp_path.iterdir()) == [out]


def test_half_written_episodes_do_not_count(tmp_path):
    with EpisodeFolder(tmp_path / "pushes.h5", {}) as folder:
        folder.path(0).with_name(f".{folder.path(0).name}.123").write_bytes(b"half")
        (tmp_path / ".pushes.h5.123").write_bytes(b"half")
        save_episode(folder.path(1), episode(1))
        folder.path(2).write_bytes(folder.path(1).read_bytes()[:200])  # cut short
    with EpisodeFolder(tmp_path / "pushes.h5", {}) as folder:
        assert folder.finished() == {1}
    assert [path.name for path in tmp_path.iterdir()] == ["pushes.h5.partial"]
    assert not list((tmp_path / "pushes.h5.partial").glob(".*"))


def test_a_folder_belongs_to_one_collection_of_one_kind(tmp_path):
    with EpisodeFolder(tmp_path / "pushes.h5", {"seed": 0}), pytest.raises(InvalidInput):
        EpisodeFolder(tmp_path / "pushes.h5", {"seed": 0})
    with pytest.raises(InvalidInput):
        EpisodeFolder(tmp_path / "pushes.h5", {"seed": 1})
    with EpisodeFolder(tmp_path / "pushes.h5", {"seed": 0}):
        pass
