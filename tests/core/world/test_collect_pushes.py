"""Collect pushes: collect pushes, disturbed states, policies."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import h5py
import numpy as np
import pytest

from osfcore.dynamics.motion import SLEEP_M, substates
from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import quaternion_conjugate, quaternion_multiply, rotation_angle
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S, check_action
from osfcore.io.image_file import to_uint8
from osfcore.io.push_file import PushEpisode, read_pushes
from osfcore.random_streams import Stream, stream_rng
from osfcore.world import collect_pushes as module
from osfcore.world.collect_pushes import (
    SUBSTATES,
    CollectPushes,
    DirectedPolicy,
    PaperPolicy,
    collect_pushes,
    disturbed,
)
from osfcore.world.physics import body_model
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

# Collect pushes


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


# Disturbed states


@pytest.fixture(scope="module")
def pushed(library, tmp_path_factory):
    """One episode in which things are pushed around, and the bodies of its objects."""
    out = tmp_path_factory.mktemp("pushed") / "pushes.h5"
    list(collect_pushes(CollectPushes(out, episodes=1, steps=30, policy="directed", seed=3), library))
    episode = read_pushes(out)[0]
    return episode, {name: body_model(library.load(name)) for name in episode.names}


def run(pushed, seed: int = 0, count: int = 1):
    return disturbed(*pushed, np.random.default_rng(seed), count)


def test_every_substep_in_which_something_moves_is_played_as_often_as_asked(pushed):
    once, twice = run(pushed), run(pushed, count=2)
    assert len(once.step) > 20
    assert np.array_equal(np.repeat(once.step, 2), twice.step)
    positions = substates(pushed[0]).position
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(axis=1)
    assert (moved[once.step] > SLEEP_M / 2).all()
    assert once.step.min() >= 1
    assert once.step.max() < len(positions) - 1


def test_the_same_seed_gives_the_same_rows_and_another_others(pushed):
    first, again, other = run(pushed), run(pushed), run(pushed, seed=1)
    assert np.array_equal(first.after_positions, again.after_positions)
    assert not np.array_equal(first.linear, other.linear)


def test_what_rests_is_left_alone_and_nothing_is_far_from_what_was_recorded(pushed):
    found, recorded = run(pushed), substates(pushed[0])
    off = np.linalg.norm(found.positions - recorded.position[found.step], axis=-1)
    rests = np.linalg.norm(found.linear, axis=-1) == 0
    assert rests.any()
    assert not rests.all()
    assert off[rests].max() < 1e-6
    assert 1e-4 < off[~rests].mean() < 1e-3
    turn = rotation_angle(found.quaternions.astype(float), recorded.quaternion[found.step])
    assert 1e-4 < turn[~rests].mean() < 0.01
    np.testing.assert_allclose(found.positions[..., 2], recorded.position[found.step][..., 2], atol=1e-6)


@pytest.fixture
def undisturbed(monkeypatch):
    for name in ("_MOST", "_OFF_M", "_OFF_RAD"):
        monkeypatch.setattr(module, name, 0.0)


@pytest.mark.usefixtures("undisturbed")
def test_undisturbed_the_simulator_repeats_what_was_recorded(pushed):
    """But for what poses and mean velocities do not tell of the simulator's state."""
    found, recorded = run(pushed), substates(pushed[0])
    off = np.linalg.norm(found.after_positions - recorded.position[found.step + 1], axis=-1)
    way = np.linalg.norm(found.after_positions - found.positions, axis=-1)
    moving = way > 0.002
    assert np.median(off[moving]) < 5e-4
    assert np.median(off[moving]) < 0.1 * np.median(way[moving])


@pytest.mark.usefixtures("undisturbed")
def test_velocities_are_those_of_the_objects_origins(pushed):
    found, recorded = run(pushed), substates(pushed[0])
    before = recorded.position[found.step - 1]
    turned = quaternion_multiply(
        recorded.quaternion[found.step], quaternion_conjugate(recorded.quaternion[found.step - 1])
    )
    small = (rotation_angle(turned, np.array([1.0, 0, 0, 0])) < 0.05) & (np.linalg.norm(found.linear, axis=-1) > 0)
    np.testing.assert_allclose(found.linear[small], (found.positions - before)[small], atol=2e-4)


def test_where_nothing_moves_there_is_nothing_to_disturb(pushed):
    episode, models = pushed
    still = {name: np.broadcast_to(getattr(episode, name)[:1], getattr(episode, name).shape)
             for name in ("positions", "quaternions")}  # fmt: skip
    within = {
        "sub_positions": np.broadcast_to(episode.positions[0], episode.sub_positions.shape),
        "sub_quaternions": np.broadcast_to(episode.quaternions[0], episode.sub_quaternions.shape),
    }
    found = disturbed(replace(episode, **still, **within), models, np.random.default_rng(0), 3)
    assert found.step.shape == (0,)
    assert found.positions.shape == (0, 3, 3)
    assert found.after_quaternions.shape == (0, 3, 4)


# Policies


def run_policy(library, policy_name: str, seeds: range) -> float:
    """Share of steps with contact; every action is checked on the way."""
    world = Tabletop(library, request=SceneRequest(count=3))
    contacts = []
    for seed in seeds:
        world.arrange(seed)
        rng = np.random.default_rng(seed)
        policy = PaperPolicy(rng) if policy_name == "paper" else DirectedPolicy(world.assets, rng)
        for _ in range(50):
            action = check_action(policy.action(world.truth()))
            contacts.append(bool(world.act_contacts(action)))
    world.close()
    return float(np.mean(contacts))


@pytest.mark.slow
def test_directed_policy_has_sustained_contact_where_the_paper_policy_rarely_has(library):
    paper, directed = run_policy(library, "paper", range(8)), run_policy(library, "directed", range(8))
    assert directed > 0.4
    assert directed > 2 * paper


def test_paper_policy_is_uniform_in_the_speed_limits(library):
    policy = PaperPolicy(np.random.default_rng(0))
    world = Tabletop(library)
    world.arrange(0)
    actions = np.array([policy.action(world.truth()) for _ in range(4000)])
    world.close()
    np.testing.assert_array_equal(actions[:, 2], 0)
    assert np.abs(actions).max() <= MAX_SPEED_M_S
    for axis in (0, 1):  # quartiles of a uniform distribution
        np.testing.assert_allclose(np.quantile(actions[:, axis], [0.25, 0.5, 0.75]), [-0.15, 0, 0.15], atol=0.015)


def test_policy_without_pusher_is_a_programming_error(library):
    world = Tabletop(library)
    world.arrange(0)
    state = world.truth()
    bare = type(state)(state.names, state.poses, state.light, None)
    with pytest.raises(ValueError, match="pusher"):
        DirectedPolicy(world.assets, np.random.default_rng(0)).action(bare)
    world.close()
