import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.rivals.train_fitvid import VideoFiles, windows
from osfcore.io.push_file import read_pushes
from tests.core.experiments.rivals.fitvid.videos import write_videos


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_videos(tmp_path_factory.mktemp("videos") / "a.h5")


def test_one_episode_in_twelve_is_held_out(path):
    with VideoFiles((path,)) as files:
        assert (files.side, len(files.learned), len(files.held_out)) == (16, 12, 2)
    with VideoFiles((path, path)) as files:
        assert (len(files.learned), len(files.held_out)) == (24, 4)


def test_windows_are_stretches_of_the_episodes(path):
    episodes = read_pushes(path)
    with VideoFiles((path,)) as files:
        some = windows([files.held_out[0], files.held_out[1]], np.array([1, 2]), 3)
        for n, (number, start) in enumerate(((0, 1), (12, 2))):
            np.testing.assert_array_equal(some.frames[n], episodes[number].frames[start : start + 4])
            np.testing.assert_allclose(some.actions[n], episodes[number].actions[start : start + 3], atol=1e-7)
        drawn = files.drawn(np.random.default_rng(0), 9, 6)  # the whole of them
        assert drawn.frames.shape == (9, 7, 16, 16, 3)
        whole = {e.frames.tobytes() for n, e in enumerate(episodes) if n % 12}
        assert {frames.tobytes() for frames in drawn.frames} <= whole
        with pytest.raises(InvalidInput, match="at most 7"):
            files.drawn(np.random.default_rng(0), 1, 7)


def test_objects_that_never_meet_are_not_learned_from(path, monkeypatch):
    from osfcore.experiments.rivals import train_fitvid

    monkeypatch.setattr(train_fitvid, "has_held_out_pair", lambda names: True)
    with pytest.raises(InvalidInput, match="learn from is 0"):
        VideoFiles((path,))


def test_files_without_frames_and_of_other_kinds_are_told(path, tmp_path):
    with pytest.raises(CorruptFile, match="--images"):
        VideoFiles((write_videos(tmp_path / "plain.h5", count=2, with_frames=False),))
    with pytest.raises(CorruptFile, match="2 are needed"):
        VideoFiles((write_videos(tmp_path / "short.h5", count=2, steps=1),))
    with pytest.raises(InvalidInput, match="sizes of the frames"):
        VideoFiles((path, write_videos(tmp_path / "large.h5", side=32, count=2)))
    (tmp_path / "rubbish.h5").write_text("rubbish")
    with pytest.raises(CorruptFile, match="not a push file"):
        VideoFiles((tmp_path / "rubbish.h5",))
    with pytest.raises(InvalidInput, match="measure on is 0|learn from is 0"):
        VideoFiles((write_videos(tmp_path / "one.h5", count=1),))
    with pytest.raises(InvalidInput, match="is 0"):
        VideoFiles(())
