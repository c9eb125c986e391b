import os
import re
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from osfcore.contrib import tabletop_env
from osfcore.contrib.tabletop_env import ACTIONS, TABLETOP_ID
from osfcore.errors import InvalidInput, OsfError, UnknownName
from osfcore.geometry.workspace import STEP_S
from osfcore.metrics.success import RearrangementTask
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import DrawnTask, TaskSet, draw_task
from tests.support.errors import about

NAMES = ("005_tomato_soup_can", "009_gelatin_box")
STAND = np.zeros(2, np.float32)


@pytest.fixture
def made(data_dir):
    """Makes environments of small scenes, and closes them."""
    envs = []

    def make(**chosen):
        envs.append(gymnasium.make(TABLETOP_ID, **{"data_dir": data_dir, "names": NAMES, "objects": 2, **chosen}))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("obs", ["poses", "both"])
def test_gymnasium_finds_nothing_wrong(made, obs):
    env = made(obs=obs, image_side=32, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_each_kind_of_observation_holds_its_parts(made):
    seen = {obs: made(obs=obs, image_side=32).reset(seed=3)[0] for obs in ("poses", "pixels", "both")}
    assert set(seen["poses"]) == {"pusher", "objects", "poses", "goal"}
    assert set(seen["pixels"]) == {"pusher", "pixels", "goal"}
    assert set(seen["both"]) == set(seen["poses"]) | set(seen["pixels"])
    np.testing.assert_array_equal(seen["both"]["poses"], seen["poses"]["poses"])
    np.testing.assert_array_equal(seen["both"]["goal"]["pixels"], seen["pixels"]["goal"]["pixels"])
    assert seen["pixels"]["pixels"].shape == (4, 32, 32, 3)
    assert seen["pixels"]["goal"]["pixels"].std() > 5


def test_the_reward_is_the_negative_mean_distance_of_poses(made):
    env = made(family="turned")
    env.reset(seed=1)
    seen, reward, *_ = env.step(STAND)
    here, there = seen["poses"], seen["goal"]["poses"]
    shift = np.linalg.norm(here[:, :3] - there[:, :3], axis=1)
    turn = np.minimum(*(np.linalg.norm(here[:, 3:] - sign * there[:, 3:], axis=1) for sign in (1, -1)))
    is_can = seen["objects"] == NAMES.index("005_tomato_soup_can")  # labelled: no symmetry, as the box
    assert is_can.sum() == 1
    assert reward == pytest.approx(-np.hypot(shift, turn).mean(), abs=1e-9)


def test_a_pusher_that_stands_changes_nothing_until_the_end(made):
    env = made(render_mode="rgb_array")
    first, _ = env.reset(seed=2)
    assert env.render().shape == (256, 256, 3)
    ends = []
    for _ in range(ACTIONS):
        seen, reward, terminated, truncated, info = env.step(STAND)
        ends.append(truncated)
        assert (terminated, info["success"]) == (False, False)
    assert ends == [False] * (ACTIONS - 1) + [True]
    np.testing.assert_allclose(seen["poses"], first["poses"], atol=2e-3)
    assert reward < 0
    assert info["others_mm"] < 2
    assert info["moved_mm"] >= 70


def test_an_episode_terminates_when_what_had_to_move_has_arrived(made, library, monkeypatch):
    """The goal is where some pushes lead."""
    world, actions = Tabletop(library, request=SceneRequest(names=NAMES)), []
    world.arrange(0)
    start = world.truth()
    world.restore(start)  # as the environment does: what physics remembers of contacts is gone
    while np.linalg.norm((world.truth().poses.position - start.poses.position)[0]) < 0.08:
        way = (world.truth().poses.position[0] - world.truth().pusher)[:2] / STEP_S
        actions.append(np.clip(way, -0.2, 0.2).astype(np.float32))
        world.act(np.array([*actions[-1].astype(float), 0.0]))
    task = RearrangementTask(0, start, replace(world.truth(), pusher=None), NAMES[:1])
    world.close()
    monkeypatch.setattr(tabletop_env, "draw_task", lambda *_: DrawnTask(task, {}))
    env = made()
    _, info = env.reset(seed=0)
    assert info["moved"] == list(NAMES[:1])
    results = [env.step(action) for action in actions]
    assert [terminated for _, _, terminated, _, _ in results] == [info["success"] for *_, info in results]
    assert not results[0][2]
    assert results[-1][2]
    assert results[-1][1] == pytest.approx(0, abs=1e-6)
    assert results[-1][4]["moved_mm"] == pytest.approx(0, abs=1e-3)


def test_a_task_of_an_evaluation_can_be_asked_for(made, library):
    task = draw_task(library, TaskSet(NAMES, "crowded", 2, 4), 1).task
    seen, info = made(family="crowded").reset(options={"task_seed": 4, "task_number": 1})
    assert (info["names"], info["moved"]) == (list(task.start.names), list(task.moved))
    np.testing.assert_array_equal(seen["poses"][:, :3], task.start.poses.position)
    np.testing.assert_array_equal(seen["goal"]["poses"][:, :3], task.goal.poses.position)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_environments_side_by_side_are_those_one_by_one(data_dir, made, mode):
    chosen = {"data_dir": data_dir, "names": NAMES, "objects": 2, "obs": "both", "image_side": 32}
    envs = gymnasium.make_vec(
        f"osfcore.contrib.tabletop_env:{TABLETOP_ID}", num_envs=2, vectorization_mode=mode, **chosen
    )
    try:
        seen, _ = envs.reset(seed=7)
        later, rewards, *_ = envs.step(np.full((2, 2), 0.1, np.float32))
    finally:
        envs.close()
    for n in range(2):
        env = made(obs="both", image_side=32)
        np.testing.assert_array_equal(env.reset(seed=7 + n)[0]["pixels"], seen["pixels"][n])
        alone, reward, *_ = env.step(np.full(2, 0.1, np.float32))
        np.testing.assert_array_equal(alone["poses"], later["poses"][n])
        assert reward == rewards[n]


@pytest.mark.slow
def test_the_program_of_the_docs_runs(data_dir, tmp_path):
    guide = (Path(__file__).parents[3] / "docs" / "how-to" / "extending.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", guide, flags=re.DOTALL)
    environment = {**os.environ, "OSF_DATA_DIR": str(data_dir)}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert "shall lie as in (2, 7) (64, 64, 3)" in done.stdout
    assert "side by side (2, 1, 7)" in done.stdout


@pytest.mark.filterwarnings("ignore")  # Gymnasium's own, of an unknown render mode
def test_mistakes_are_refused(made):
    mistakes = ({"obs": "depth"}, {"family": "flying"}, {"objects": 3}, {"image_side": 8}, {"render_mode": "ansi"})
    others = ((UnknownName, {"names": ("no_can",), "objects": 1}), (OsfError, {"data_dir": "nowhere", "names": None}))
    for error, chosen in (*((InvalidInput, mistake) for mistake in mistakes), *others):
        with pytest.raises(error):
            made(**chosen)


@pytest.mark.wrong_arrays
def test_actions_and_options_outside_their_bounds_are_refused(made):
    env = made().unwrapped
    with pytest.raises(OsfError):
        env.step(STAND)  # before it is reset
    before, _ = env.reset(seed=0)
    for action in ([0.31, 0], [np.nan, 0], [0.1, 0.1, 0.1]):
        with pytest.raises(InvalidInput):
            env.step(np.array(action))
    seen, *_ = env.step(STAND)
    np.testing.assert_allclose(seen["pusher"], before["pusher"], atol=1e-6)
    with pytest.raises(InvalidInput, check=about("options")):
        env.reset(options={"task_seed": -1, "task_number": 0})
