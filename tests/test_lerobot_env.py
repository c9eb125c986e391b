"""The example of an environment for LeRobot: by itself, and through LeRobot where it is."""

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from importlib.metadata import distributions
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from osfcore.contrib.export.lerobot import LeRobotEpisode, instruction, write_dataset

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "examples" / "lerobot_env_osf"
NAMES = ["005_tomato_soup_can", "009_gelatin_box"]


@pytest.fixture(scope="module")
def tabletop():
    """The class, loaded without LeRobot, which its package needs only to be found."""
    path = PACKAGE / "lerobot_env_osf" / "environment.py"
    spec = importlib.util.spec_from_file_location("lerobot_env_osf_environment", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.LeRobotTabletop


@pytest.fixture
def made(tabletop, data_dir):
    """Makes environments, and closes them."""
    envs = []

    def make(**chosen):
        envs.append(tabletop(data_dir=data_dir, **{"names": NAMES, "objects": 2, "image_side": 32, **chosen}))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


def test_gymnasium_finds_nothing_wrong(made):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*spec")  # it is made here without Gymnasium's register
        check_env(made(obs="both"), skip_render_check=True)


def test_it_observes_what_the_tabletop_does(made, data_dir):
    ours = gymnasium.make(
        "osfcore.contrib.tabletop_env:OSFTabletop-v0", data_dir=data_dir, names=tuple(NAMES), objects=2, obs="both",
        image_side=32,
    )  # fmt: skip
    observed, info = ours.reset(seed=4)
    told, about = made(obs="both").reset(seed=4)
    np.testing.assert_array_equal(told["agent_pos"], observed["pusher"])
    poses = told["environment_state"].reshape(2, 2, 7)
    np.testing.assert_array_equal(poses, [observed["poses"], observed["goal"]["poses"]])
    for number in range(4):
        np.testing.assert_array_equal(told["pixels"][f"camera_{number}"], observed["pixels"][number])
    np.testing.assert_array_equal(told["pixels"]["goal"], observed["goal"]["pixels"])
    assert about["is_success"] == info["success"]
    ours.close()


def test_it_tells_its_task_and_ends_in_time(made):
    env = made(obs="poses", episode_length=2)
    _, info = env.reset(seed=1)
    assert env.task_description == instruction(info["names"], info["moved"])
    assert not env.step(np.zeros(2, np.float32))[3]
    assert env.step(np.zeros(2, np.float32))[3]


def test_actions_that_are_too_fast_are_slowed_down(made):
    ends = []
    for fast in (0.3, 7.0):
        env = made(obs="poses")
        env.reset(seed=2)
        ends.append(env.step(np.array([fast, -fast], np.float32))[0]["agent_pos"])
    np.testing.assert_allclose(*ends, atol=1e-6)


def test_pip_installs_it_under_a_name_that_lerobot_looks_for(tmp_path):
    shutil.copytree(PACKAGE, tmp_path / "source")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps")
    place = tmp_path / "site"
    subprocess.run([*pip, "--no-build-isolation", "--target", place, tmp_path / "source"], check=True)
    (found,) = distributions(path=[str(place)])
    name = found.metadata["Name"]
    assert name.startswith("lerobot_env_")
    assert (place / name / "__init__.py").exists()  # what it imports by that name


# Through LeRobot

MADE = """
import json, sys
from importlib.metadata import distribution
from lerobot.configs.parser import load_plugin
from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
from lerobot.datasets.utils import dataset_to_policy_features
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import add_envs_task, env_to_policy_features, preprocess_observation
load_plugin("lerobot_env_osf")
chosen = json.loads(sys.argv[1])
config = EnvConfig.get_choice_class("osf")(**chosen)
env = make_env(config, n_envs=2)["osf"][0]
observation, _ = env.reset(seed=[0, 1])
seen = add_envs_task(env, preprocess_observation(observation))
tasks = seen.pop("task")
env.step(env.action_space.sample())
shapes = lambda features: {key: list(feature.shape) for key, feature in features.items()}
print(json.dumps({
    "tasks": tasks, "seen": {key: list(value.shape[1:]) for key, value in seen.items()},
    "told": shapes(env_to_policy_features(config)),
    "recorded": shapes(dataset_to_policy_features(LeRobotDatasetMetadata("osf/set", root=sys.argv[2]).features)),
}))
env.close()
"""


@pytest.fixture(scope="module")
def lerobot():
    python = os.environ.get("OSF_TEST_LEROBOT_PYTHON")
    if not python:
        pytest.skip("OSF_TEST_LEROBOT_PYTHON names no Python that has LeRobot")
    return Path(python)


@pytest.fixture
def run(lerobot, tmp_path):
    """Runs something where LeRobot is, with our package beside it."""
    environment = {
        "HF_HOME": str(tmp_path / "hub"), "HF_HUB_OFFLINE": "1", "PATH": f"{lerobot.parent}:{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT}:{PACKAGE}",
    }  # fmt: skip

    def run(*command):
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    return run


def recorded(place, *, images):
    """A data set of two objects, as `osf lerobot` writes it."""
    views = ("camera_0", "camera_1", "camera_2", "camera_3", "goal") if images else ()
    rng = np.random.default_rng(0)
    rows = rng.uniform(-0.2, 0.2, (6, 2))
    told = {name: rng.integers(0, 255, (6, 32, 32, 3), np.uint8) for name in views}
    write_dataset(place, [LeRobotEpisode("Push it.", rows, rows, rng.uniform(-0.2, 0.2, (6, 28)), told)])


@pytest.mark.slow
def test_lerobot_makes_it_and_it_observes_what_data_sets_tell(lerobot, run, data_dir, tmp_path):
    recorded(tmp_path / "set", images=True)
    chosen = {"data_dir": str(data_dir), "names": NAMES, "objects": 2, "image_side": 32}
    printed = run(str(lerobot), "-c", MADE, json.dumps(chosen), str(tmp_path / "set"))
    told = json.loads(printed.splitlines()[-1])
    assert all(task.startswith("Push the ") for task in told["tasks"])
    assert told["told"] == told["recorded"]
    assert told["seen"] == {key: shape for key, shape in told["told"].items() if key != "action"}


@pytest.mark.slow
def test_the_commands_of_the_docs_train_and_evaluate(run, data_dir, tmp_path):
    """With less of everything."""
    recorded(tmp_path / "demonstrations", images=False)
    guide = (ROOT / "docs" / "how-to" / "extending.md").read_text()
    (block,) = re.findall(r"```sh\n(lerobot-.*?)```", guide, flags=re.DOTALL)
    train, evaluate = (shlex.split(line) for line in block.splitlines())
    small = ["dim_model=32", "n_heads=2", "dim_feedforward=32", "chunk_size=2", "n_action_steps=2", "use_vae=false"]
    run(*train, "--steps=2", "--batch_size=2", "--num_workers=0", *(f"--policy.{one}" for one in small))
    place = [f"--env.data_dir={data_dir}", f"--env.names={json.dumps(NAMES)}", "--env.obs=poses"]
    run(*evaluate, *place, "--env.episode_length=3", "--eval.n_episodes=1", "--eval.batch_size=1", "--output_dir=out")
    found = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert found["overall"]["n_episodes"] == 1
    assert found["overall"]["avg_sum_reward"] < 0
