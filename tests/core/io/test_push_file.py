from dataclasses import replace

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
from tests.support.same import assert_same


def episode(seed: int, *, frames: bool = False) -> PushEpisode:
    rng = np.random.default_rng(seed)
    arrays = [rng.normal(size=shape) for shape in ((4, 2, 3), (4, 2, 4), (4, 3), (3, 3))]
    within = [rng.normal(size=(3, 4, 2, n)) if seed % 2 else None for n in (3, 4)]
    film = rng.integers(0, 255, (4, 8, 8, 3), np.uint8) if frames else None
    return PushEpisode(("a", "b"), seed, *arrays, rng.random((3, 2)) < 0.5, *within, film)


def disturbed(rows: int = 5) -> Disturbed:
    rng = np.random.default_rng(rows)
    shapes = ((3,), (4,), (3,), (3,), (3,), (4,))
    return Disturbed(np.arange(rows), *(rng.normal(size=(rows, 2, *s)).astype(np.float32) for s in shapes))


def test_unsound_disturbed_states_and_other_files_are_refused(tmp_path):
    path, rows = tmp_path / "pushes.h5", disturbed()
    for wrong in (np.full_like(rows.linear, np.nan), rows.linear[:3]):
        with EpisodeFolder(path, {}) as folder:
            save_episode(folder.path(0), replace(episode(1), disturbed=replace(rows, linear=wrong)))
            folder.combine(1)
        with pytest.raises(CorruptFile, check=about("disturbed_linear of episode 0")):
            read_sound_pushes(path)
    path.write_bytes(b"not HDF5")
    with pytest.raises(CorruptFile):
        read_pushes(path)


def test_combined_file_holds_all_episodes_in_order_and_the_folder_goes(tmp_path):
    out = tmp_path / "pushes.h5"
    episodes = [episode(0), replace(episode(1), disturbed=disturbed(0)), episode(2, frames=True)]
    episodes.append(replace(episode(3), disturbed=disturbed()))
    with EpisodeFolder(out, {"seed": 0}) as folder:
        for index in (2, 0, 3, 1):
            save_episode(folder.path(index), episodes[index])
            assert_same(load_episode(folder.path(index)), episodes[index])
        assert folder.finished() == {0, 1, 2, 3}
        folder.combine(4)
    assert_same(read_pushes(out), episodes)
    assert_same(read_sound_pushes(out), episodes)
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
