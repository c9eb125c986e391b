"""`OSFTabletop-v0` with the names that LeRobot gives to what is observed."""

from typing import Any

import gymnasium
import numpy as np

from osfcore.contrib.tabletop_env import TABLETOP_ID  # registers what is made below
from osfcore.contrib.tabletop_env import TabletopEnv
from osfcore.contrib.export.lerobot import GOAL_IMAGE, environment_state, image_name, instruction
from osfcore.geometry.cameras import default_cameras


class LeRobotTabletop(gymnasium.Env[dict[str, Any], np.ndarray]):
    """The tabletop as LeRobot observes it; actions, rewards and ends of episodes are those of `OSFTabletop-v0`.

        agent_pos          (2,) the pusher's place [m]
        environment_state  (14 N,) poses of the N objects, then those of their goals    poses, both
        pixels             dict of images (h, w, 3): camera_0 to camera_3 and goal      pixels, both

    `info` holds `is_success` besides what `OSFTabletop-v0` tells.

    Args:
        episode_length: actions before an episode is truncated.
        names: objects to choose from; all that are there if None.
        render_mode: "rgb_array" or None.
        chosen: else, as `OSFTabletop-v0` takes it.
    """

    metadata = TabletopEnv.metadata

    def __init__(
        self,
        *,
        episode_length: int = 30,
        names: list[str] | None = None,
        render_mode: str | None = None,
        **chosen: Any,  # noqa: ANN401  passed on
    ) -> None:
        self._env = gymnasium.make(
            TABLETOP_ID,
            max_episode_steps=episode_length,
            names=None if names is None else tuple(names),
            render_mode=render_mode,
            **chosen,
        )
        self.render_mode = render_mode
        self._max_episode_steps = episode_length  # LeRobot asks for it by this name
        self.task = self.task_description = ""
        self.action_space = self._env.action_space
        self.observation_space = _space_of(self._env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin a new task, which `task_description` then tells in words."""
        super().reset(seed=seed)
        observation, info = self._env.reset(seed=seed, options=options)
        self.task = self.task_description = instruction(info["names"], info["moved"])
        return _told(observation), _with_success(info)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Hold a velocity for 0.2 s; one that is too fast is slowed down, as policies do not know limits."""
        box = self.action_space
        observation, reward, terminated, truncated, info = self._env.step(np.clip(action, box.low, box.high))
        return _told(observation), float(reward), terminated, truncated, _with_success(info)

    def render(self) -> Any:  # noqa: ANN401  as Gymnasium has it
        """The table now, from the goal camera."""
        return self._env.render()

    def close(self) -> None:
        """Free the simulation."""
        self._env.close()


def _with_success(info: dict[str, Any]) -> dict[str, Any]:
    return {**info, "is_success": info["success"]}


def _told(observation: dict[str, Any]) -> dict[str, Any]:
    told: dict[str, Any] = {"agent_pos": observation["pusher"]}
    goal = observation["goal"]
    if "poses" in observation:
        told["environment_state"] = environment_state(observation["poses"], goal["poses"])
    if "pixels" in observation:
        names = [image_name(camera.name) for camera in default_cameras()]
        told["pixels"] = {**dict(zip(names, observation["pixels"], strict=True)), GOAL_IMAGE: goal["pixels"]}
    return told


def _space_of(observed: gymnasium.spaces.Dict) -> gymnasium.spaces.Dict:
    """The space of what is told, from that of the tabletop."""
    spaces, goal = observed.spaces, observed["goal"]
    told = {"agent_pos": spaces["pusher"]}
    if "poses" in spaces:
        limits = environment_state(spaces["poses"].high, goal["poses"].high)
        told["environment_state"] = gymnasium.spaces.Box(-limits, limits, dtype=np.float64)
    if "pixels" in spaces:
        names = [*(image_name(camera.name) for camera in default_cameras()), GOAL_IMAGE]
        told["pixels"] = gymnasium.spaces.Dict(dict.fromkeys(names, goal["pixels"]))
    return gymnasium.spaces.Dict(told)
