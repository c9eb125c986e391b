"""What can be chosen of the environment, and what LeRobot is told of it before it is made."""

from dataclasses import dataclass
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from osfcore.contrib.export.lerobot import ACTION, ENVIRONMENT, GOAL_IMAGE, IMAGES, STATE, image_name
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.workspace import STEP_S

PACKAGE, TASK = "lerobot_env_osf", "Tabletop-v0"
GYM_ID = f"{PACKAGE}/{TASK}"


@EnvConfig.register_subclass("osf")
@dataclass
class OsfEnv(EnvConfig):
    """The tabletop; all but `episode_length` is as `OSFTabletop-v0` has it.

    Attributes:
        obs: what is observed besides the pusher: "poses", "pixels" or "both".
        objects: in each scene.
        names: objects to choose from; all that are there if None.
        family: of the tasks.
        image_side: of images [px].
        data_dir: whose objects are used; the program's own if None.
        episode_length: actions before an episode is truncated.
    """

    task: str | None = TASK
    fps: int = round(1 / STEP_S)
    obs: str = "both"
    objects: int = 3
    names: list[str] | None = None
    family: str = "shifted"
    image_side: int = 128
    data_dir: str | None = None
    episode_length: int = 30

    def __post_init__(self) -> None:
        """Tell the features by the environment's keys, and what LeRobot calls each."""
        self._tell("action", ACTION, FeatureType.ACTION, (2,))
        self._tell("agent_pos", STATE, FeatureType.STATE, (2,))
        if self.obs != "pixels":
            self._tell("environment_state", ENVIRONMENT, FeatureType.ENV, (14 * self.objects,))
        if self.obs != "poses":
            for name in (*(image_name(camera.name) for camera in default_cameras()), GOAL_IMAGE):
                shape = (self.image_side, self.image_side, 3)
                self._tell(f"pixels/{name}", f"{IMAGES}.{name}", FeatureType.VISUAL, shape)

    def _tell(self, key: str, called: str, kind: FeatureType, shape: tuple[int, ...]) -> None:
        self.features[key], self.features_map[key] = PolicyFeature(kind, shape), called

    @property
    def package_name(self) -> str:
        """What LeRobot imports to have the environment registered."""
        return PACKAGE

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """For `gymnasium.make`."""
        keys = ("obs", "objects", "names", "family", "image_side", "data_dir", "episode_length")
        return {"render_mode": "rgb_array", **{key: getattr(self, key) for key in keys}}
