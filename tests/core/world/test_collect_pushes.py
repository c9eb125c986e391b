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
from tests.support.errors import about
from tests.support.same import assert_same

CAN, GELATIN, DRILL = "005_tomato_soup_can", "009_gelatin_box", "035_power_drill"


def collect(library, out, executor=None, **settings) -> tuple[PushEpisode, ...]:
    config = CollectPushes(out, **{"episodes": 3, "steps": 4, **settings})
    steps = list(collect_pushes(config, library, executor))
    assert steps[-1].done == steps[-1].total == config.episodes
    return read_pushes(out)


def test_episodes_have_the_stated_shapes_and_tell_the_truth(library, tmp_path):
    config = CollectPushes(tmp_path / "a.h5", episodes=3, steps=20, policy="directed")
    *_, last = collect_pushes(config, library)
    episodes = read_pushes(config.out)
    assert len({e.seed for e in episodes}) == 3
    for e in episodes:
        assert e.positions.shape == (21, 3, 3)
        assert e.quaternions.shape == (21, 3, 4)
        assert e.sub_positions.shape == (20, SUBSTATES, 3, 3)
        np.testing.assert_array_equal(e.sub_positions[:, -1], e.positions[1:])
        np.testing.assert_allclose(e.sub_quaternions[:, -1], e.quaternions[1:], atol=1e-12)
        inner = np.abs(e.pusher[1:, :2]).max(axis=1) < 0.349
        np.testing.assert_allclose(np.diff(e.pusher, axis=0)[inner], STEP_S * e.actions[inner], atol=1e-9)
        shift = np.linalg.norm(np.diff(e.positions, axis=0), axis=-1)
        for step in [np.argmax(s > 0.005) for s in shift.T if np.any(s > 0.005)]:
            assert e.contact[: step + 1].any()  # nothing moves before the pusher has touched something
    assert last.contact_share == pytest.approx(np.mean([e.contact.any(axis=1) for e in episodes]))
    assert 0 < last.motion_share <= 1
    assert last.episodes_per_s > 0


def test_disturbed_states_change_nothing_else(library, tmp_path):
    given = {"policy": "directed", "episodes": 1, "steps": 8}
    (plain,), (both,) = (collect(library, tmp_path / f"{n}.h5", disturb=n, **given) for n in (0, 2))
    assert_same(replace(both, disturbed=None), plain)
    assert len(both.disturbed.step) > 0


@pytest.mark.slow
def test_content_does_not_depend_on_the_number_of_workers(library, tmp_path):
    alone = collect(library, tmp_path / "alone.h5")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as executor:
        together = collect(library, tmp_path / "together.h5", executor)
    assert_same(alone, together)
    assert not list(tmp_path.glob("*.partial"))


def test_abandoned_collection_goes_on_where_it_was_with_the_same_objects_alone(library, tmp_path):
    whole = collect(library, tmp_path / "whole.h5", names=library.names())  # all of them: as if none were named
    config = CollectPushes(tmp_path / "parts.h5", episodes=3, steps=4)
    begun = collect_pushes(config, library)
    assert [next(begun).done for _ in range(3)] == [0, 1, 2]
    begun.close()
    assert not config.out.exists()
    with pytest.raises(InvalidInput):
        collect(library, config.out, names=library.names()[:4])
    assert next(collect_pushes(config, library)).done == 2
    assert_same(collect(library, config.out), whole)
    content = config.out.read_bytes()
    with pytest.raises(InvalidInput, check=about("output file")):
        collect(library, config.out)
    assert config.out.read_bytes() == content


@pytest.mark.slow
def test_killed_collection_loses_and_repeats_nothing(library, data_dir, tmp_path):
    whole = collect(library, tmp_path / "whole.h5", episodes=8, steps=30)
    out = tmp_path / "killed.h5"
    command = [
        *(sys.executable, "-m", "app.cli", "collect", "pushes", "--out", str(out), "--episodes", "8", "--steps", "30"),
        *("--workers", "1", "--data-dir", str(data_dir)),
    ]
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


def test_frames_are_those_of_the_chosen_camera_under_a_light_of_their_own(library, tables, tmp_path):
    """The pushes are the same whatever is seen of them."""
    shared = {"episodes": 1, "steps": 2, "objects": 2}
    (plain,) = collect(library, tmp_path / "plain.h5", **shared)
    shared |= {"images": True, "size": 32, "camera": "goal"}
    (goal,), (lit,) = (collect(library, tmp_path / f"{on}.h5", random_lights=on, **shared) for on in (False, True))
    for seen in (goal, lit):
        assert_same(replace(seen, frames=None), plain)
    world = tables(goal.seed, request=SceneRequest(count=2))
    for frames in (goal.frames, lit.frames):
        assert frames.shape == (3, 32, 32, 3)
        np.testing.assert_array_equal(frames[0], to_uint8(world.render((goal_camera(32),)).images[0]))
        world.set_light(Light.random(stream_rng(0, Stream.COLLECTED_LIGHT, 0), MIN_LIGHT_ELEVATION_DEG))


def test_only_the_named_objects_are_pushed(library, tmp_path):
    names = (CAN, GELATIN, DRILL)
    episodes = collect(library, tmp_path / "a.h5", objects=2, names=names, steps=1, episodes=6)
    assert {name for e in episodes for name in e.names} == set(names)
    assert all(len(set(e.names)) == 2 for e in episodes)
    with h5py.File(tmp_path / "a.h5") as file:
        assert json.loads(str(file.attrs["settings"]))["available"] == list(names)


@pytest.mark.parametrize(
    ("bad", "error"),
    [({key: value}, InvalidInput) for key, value in (
        ("episodes", 0), ("steps", 0), ("objects", 0), ("objects", 9), ("policy", "wild"), ("seed", -1),
        ("camera", "1"), ("size", 8), ("disturb", -1), ("names", ()), ("names", (CAN, GELATIN)), ("names", (CAN,) * 3),
    )] + [({"names": ("teapot",) * 3}, UnknownName), ({"names": ("024_bowl", CAN, GELATIN)}, MissingAssets)],
)  # fmt: skip
def test_bad_settings_are_refused_before_anything_is_written(library, tmp_path, bad, error):
    with pytest.raises(error):
        collect(library, tmp_path / "a.h5", **bad)
    assert not list(tmp_path.iterdir())


# Disturbed states


@pytest.fixture(scope="module")
def pushed(library, tmp_path_factory):
    """One episode in which things are pushed around, and the bodies of its objects."""
    out = tmp_path_factory.mktemp("pushed") / "pushes.h5"
    (episode,) = collect(library, out, episodes=1, steps=30, policy="directed", seed=3)
    return episode, {name: body_model(library.load(name)) for name in episode.names}


def run(pushed, seed: int = 0, count: int = 1):
    return disturbed(*pushed, np.random.default_rng(seed), count)


@pytest.fixture(scope="module")
def found(pushed):
    return run(pushed)


@pytest.mark.slow
def test_every_substep_in_which_something_moves_is_played_as_often_as_asked(pushed, found):
    twice, other, again = run(pushed, count=2), run(pushed, seed=1), run(pushed)
    assert len(found.step) > 20
    assert np.array_equal(np.repeat(found.step, 2), twice.step)
    positions = substates(pushed[0]).position
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(axis=1)
    assert (moved[found.step] > SLEEP_M / 2).all()
    assert 1 <= found.step.min() < found.step.max() < len(positions) - 1
    assert np.array_equal(found.after_positions, again.after_positions)  # the seed decides
    assert not np.array_equal(found.linear, other.linear)


def test_what_rests_is_left_alone_and_nothing_is_far_from_what_was_recorded(pushed, found):
    recorded = substates(pushed[0])
    off = np.linalg.norm(found.positions - recorded.position[found.step], axis=-1)
    rests = np.linalg.norm(found.linear, axis=-1) == 0
    assert rests.any()
    assert not rests.all()
    assert off[rests].max() < 1e-6
    assert 1e-4 < off[~rests].mean() < 1e-3
    turn = rotation_angle(found.quaternions.astype(float), recorded.quaternion[found.step])
    assert 1e-4 < turn[~rests].mean() < 0.01
    np.testing.assert_allclose(found.positions[..., 2], recorded.position[found.step][..., 2], atol=1e-6)


def test_undisturbed_the_simulator_repeats_what_was_recorded(pushed, monkeypatch):
    """But for what poses and mean velocities leave open; velocities are those of the objects' origins."""
    for name in ("_MOST", "_OFF_M", "_OFF_RAD"):
        monkeypatch.setattr(module, name, 0.0)
    found, recorded = run(pushed), substates(pushed[0])
    off = np.linalg.norm(found.after_positions - recorded.position[found.step + 1], axis=-1)
    way = np.linalg.norm(found.after_positions - found.positions, axis=-1)
    moving = way > 0.002
    assert np.median(off[moving]) < min(5e-4, 0.1 * np.median(way[moving]))
    before = recorded.position[found.step - 1]
    last = quaternion_conjugate(recorded.quaternion[found.step - 1])
    turned = quaternion_multiply(recorded.quaternion[found.step], last)
    small = (rotation_angle(turned, np.array([1.0, 0, 0, 0])) < 0.05) & (np.linalg.norm(found.linear, axis=-1) > 0)
    np.testing.assert_allclose(found.linear[small], (found.positions - before)[small], atol=2e-4)


def test_where_nothing_moves_there_is_nothing_to_disturb(pushed):
    episode, models = pushed
    still = {
        below + name: np.broadcast_to(getattr(episode, name)[0], getattr(episode, below + name).shape)
        for name in ("positions", "quaternions")
        for below in ("", "sub_")
    }
    found = run((replace(episode, **still), models), count=3)
    assert found.step.shape == (0,)
    assert found.after_quaternions.shape == (0, 3, 4)


# Policies


@pytest.mark.slow
def test_directed_policy_has_sustained_contact_where_the_paper_policy_rarely_has(tables):
    shares, world = [], tables()
    for policy_of in (PaperPolicy, lambda rng: DirectedPolicy(world.assets, rng)):
        contacts = []
        for seed in range(8):
            world.arrange(seed)
            policy = policy_of(np.random.default_rng(seed))
            for _ in range(50):
                action = check_action(policy.action(world.truth()))
                contacts.append(bool(world.act_recorded(action, 1)[0]))
        shares.append(np.mean(contacts))
    assert shares[1] > 0.4
    assert shares[1] > 2 * shares[0]


def test_paper_policy_is_uniform_in_the_speed_limits_and_the_directed_one_needs_a_pusher(tables):
    world, policy = tables(0), PaperPolicy(np.random.default_rng(0))
    state = world.truth()
    with pytest.raises(InvalidInput, check=about("pusher")):
        DirectedPolicy(world.assets, np.random.default_rng(0)).action(replace(state, pusher=None))
    actions = np.array([policy.action(state) for _ in range(4000)])
    np.testing.assert_array_equal(actions[:, 2], 0)
    assert np.abs(actions).max() <= MAX_SPEED_M_S
    for axis in (0, 1):  # quartiles of a uniform distribution
        np.testing.assert_allclose(np.quantile(actions[:, axis], [0.25, 0.5, 0.75]), [-0.15, 0, 0.15], atol=0.015)
