import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor

import h5py
import numpy as np
import pytest

from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.workspace import STEP_S
from osfcore.io.image_file import to_uint8
from osfcore.io.push_file import PushEpisode, read_pushes
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.collect_pushes import SUBSTATES, CollectPushes, collect_pushes
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop


def collect(library, out, executor=None, **settings) -> tuple[PushEpisode, ...]:
    config = CollectPushes(out, **{"episodes": 6, "steps": 8, **settings})
    steps = list(collect_pushes(config, library, executor))
    assert steps[-1].done == steps[-1].total == config.episodes
    return read_pushes(out)


def assert_same(a: tuple[PushEpisode, ...], b: tuple[PushEpisode, ...]) -> None:
    assert len(a) == len(b)
    for x, y in zip(a, b, strict=True):
        assert (x.names, x.seed) == (y.names, y.seed)
        for name in ("positions", "quaternions", "pusher", "actions", "contact"):
            np.testing.assert_array_equal(getattr(x, name), getattr(y, name))


def test_episodes_have_the_stated_shapes_and_tell_the_truth(library, tmp_path):
    episodes = collect(library, tmp_path / "a.h5", policy="directed", steps=20)
    assert len({e.seed for e in episodes}) == 6
    for e in episodes:
        assert e.positions.shape == (21, 3, 3)
        assert e.quaternions.shape == (21, 3, 4)
        assert e.contact.shape == (20, 3)
        assert e.sub_positions is not None
        assert e.sub_quaternions is not None
        assert e.sub_positions.shape == (20, SUBSTATES, 3, 3)
        np.testing.assert_array_equal(e.sub_positions[:, -1], e.positions[1:])
        np.testing.assert_allclose(e.sub_quaternions[:, -1], e.quaternions[1:], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(e.quaternions, axis=-1), 1, atol=1e-6)
        inner = np.abs(e.pusher[1:, :2]).max(axis=1) < 0.349
        np.testing.assert_allclose(np.diff(e.pusher, axis=0)[inner], STEP_S * e.actions[inner], atol=1e-9)
        shift = np.linalg.norm(np.diff(e.positions, axis=0), axis=-1)
        first_moves = [np.argmax(s > 0.005) for s in shift.T if np.any(s > 0.005)]
        for step in first_moves:  # nothing moves before the pusher has touched something
            assert e.contact[: step + 1].any()
    assert any(e.contact.any() for e in episodes)


def test_disturbed_states_are_kept_where_they_are_asked_for(library, tmp_path):
    """They change nothing else."""
    plain = collect(library, tmp_path / "plain.h5", policy="directed", episodes=2)
    both = collect(library, tmp_path / "both.h5", policy="directed", episodes=2, disturb=2)
    assert_same(plain, both)
    assert all(e.disturbed is None for e in plain)
    assert all(e.disturbed is not None for e in both)
    assert sum(len(e.disturbed.step) for e in both) > 0


@pytest.mark.slow
def test_content_does_not_depend_on_the_number_of_workers(library, tmp_path):
    alone = collect(library, tmp_path / "alone.h5")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        together = collect(library, tmp_path / "together.h5", executor)
    assert_same(alone, together)
    assert not list(tmp_path.glob("*.partial"))


def test_abandoned_collection_goes_on_where_it_was(library, tmp_path):
    whole = collect(library, tmp_path / "whole.h5")
    config = CollectPushes(tmp_path / "parts.h5", episodes=6, steps=8)
    begun = collect_pushes(config, library)
    for step in begun:
        if step.done == 3:
            break
    begun.close()
    assert not config.out.exists()
    first = next(iter(collect_pushes(config, library)))
    assert first.done == 3
    assert_same(collect(library, config.out), whole)


@pytest.mark.slow
def test_killed_collection_loses_and_repeats_nothing(library, tmp_path):
    whole = collect(library, tmp_path / "whole.h5", episodes=8, steps=30)
    out = tmp_path / "killed.h5"
    command = [
        *(sys.executable, "-m", "app.cli", "collect", "pushes", "--out", str(out), "--episodes", "8", "--steps", "30"),
        *("--workers", "1", "--data-dir", str(tmp_path / "data")),
    ]
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "objects").symlink_to(library.root)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    partial = tmp_path / "killed.h5.partial"
    deadline = time.monotonic() + 60
    while len(list(partial.glob("*.npz"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert 2 <= len(list(partial.glob("*.npz"))) < 8
    assert subprocess.run(command, check=False, capture_output=True).returncode == 0
    assert_same(read_pushes(out), whole)


def test_frames_on_demand(library, tmp_path):
    (with_frames,) = collect(library, tmp_path / "frames.h5", episodes=1, steps=2, images=True)
    assert with_frames.frames is not None
    assert with_frames.frames.shape == (3, 128, 128, 3)
    (without,) = collect(library, tmp_path / "plain.h5", episodes=1, steps=2)
    assert without.frames is None


def test_frames_are_those_of_the_chosen_camera_under_a_light_of_their_own(library, tmp_path):
    """The pushes are the same whatever is seen of them."""
    shared = {"episodes": 2, "steps": 2, "objects": 2, "images": True, "size": 32}
    plain = collect(library, tmp_path / "plain.h5", **shared)
    goal = collect(library, tmp_path / "goal.h5", camera="goal", **shared)
    lit = collect(library, tmp_path / "lit.h5", camera="goal", random_lights=True, **shared)
    assert_same(plain, goal)
    assert_same(plain, lit)
    world = Tabletop(library, request=SceneRequest(count=2))
    try:
        for index, (scene, other) in enumerate(zip(goal, lit, strict=True)):
            assert scene.frames is not None
            assert other.frames is not None
            assert other.frames.shape == (3, 32, 32, 3)
            world.arrange(scene.seed)
            np.testing.assert_array_equal(scene.frames[0], to_uint8(world.render((goal_camera(32),)).images[0]))
            drawn = stream_rng(0, Stream.COLLECTED_LIGHT, index)
            world.set_light(Light.random(drawn, MIN_LIGHT_ELEVATION_DEG))
            np.testing.assert_array_equal(other.frames[0], to_uint8(world.render((goal_camera(32),)).images[0]))
            assert np.abs(scene.frames.astype(int) - other.frames).max() > 10
    finally:
        world.close()


def test_shares_are_counted_over_all_steps(library, tmp_path):
    config = CollectPushes(tmp_path / "a.h5", episodes=3, steps=20, policy="directed")
    last = list(collect_pushes(config, library))[-1]
    episodes = read_pushes(config.out)
    assert last.contact_share == pytest.approx(np.mean([e.contact.any(axis=1) for e in episodes]))
    assert 0 < last.motion_share <= 1
    assert last.episodes_per_s > 0


@pytest.mark.parametrize(
    "bad",
    [{"episodes": 0}, {"steps": 0}, {"objects": 0}, {"objects": 9}, {"policy": "wild"}, {"seed": -1}]
    + [{"camera": "1"}, {"size": 8}],
)
def test_bad_settings_are_refused_before_anything_is_written(library, tmp_path, bad):
    with pytest.raises(InvalidInput):
        collect(library, tmp_path / "a.h5", **bad)
    assert not list(tmp_path.iterdir())


def test_existing_file_is_never_overwritten(library, tmp_path):
    (tmp_path / "a.h5").write_text("precious")
    with pytest.raises(InvalidInput, match="must be new"):
        collect(library, tmp_path / "a.h5")
    assert (tmp_path / "a.h5").read_text() == "precious"


def test_only_the_named_objects_are_pushed(library, tmp_path):
    names = ("005_tomato_soup_can", "009_gelatin_box", "035_power_drill")
    episodes = collect(library, tmp_path / "a.h5", objects=2, names=names, steps=1)
    assert {name for e in episodes for name in e.names} == set(names)
    assert all(len(set(e.names)) == 2 for e in episodes)
    with h5py.File(tmp_path / "a.h5") as file:
        assert json.loads(str(file.attrs["settings"]))["available"] == list(names)


def test_naming_all_objects_is_naming_none(library, tmp_path):
    whole = collect(library, tmp_path / "a.h5", episodes=2, steps=2)
    assert_same(collect(library, tmp_path / "b.h5", episodes=2, steps=2, names=library.names()), whole)


def test_a_collection_of_other_objects_is_not_gone_on_with(library, tmp_path):
    config = CollectPushes(tmp_path / "a.h5", episodes=2, steps=2)
    begun = collect_pushes(config, library)
    next(begun)
    begun.close()
    with pytest.raises(InvalidInput, match="other settings"):
        collect(library, config.out, episodes=2, steps=2, names=library.names()[:4])


@pytest.mark.parametrize(
    ("names", "error"),
    [
        (("teapot",) * 3, UnknownName),
        (("024_bowl", "005_tomato_soup_can", "009_gelatin_box"), MissingAssets),
        (("005_tomato_soup_can", "009_gelatin_box"), InvalidInput),  # three are wanted
        ((), InvalidInput),
        (("005_tomato_soup_can",) * 3, InvalidInput),
    ],
)
def test_bad_names_are_refused_before_anything_is_written(library, tmp_path, names, error):
    with pytest.raises(error):
        collect(library, tmp_path / "a.h5", names=names)
    assert not list(tmp_path.iterdir())
