"""The service as an object: tables, goals, estimates, predictions, episodes.

    with Client("http://127.0.0.1:8000") as osf:
        goal = osf.upload_goal("photo.jpg")
        for episode in osf.episode(goal):
            print(episode.done, episode.note)

Poses, cameras and light come as the core's own types, images as linear RGB in [0, 1].
"""

from __future__ import annotations

import io
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeVar

import numpy as np
from jaxtyping import Float, Float32
from PIL import Image

from osfcore.client.answers import Episode, Estimate, Goal, Health, RemoteScene
from osfcore.client.connection import Connection
from osfcore.errors import InvalidInput
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.io.image_file import encode_png, to_uint8
from osfcore.io.json_codec import decode
from osfcore.io.rollout_file import rollouts_from_json
from osfcore.io.scene_file import state_to_json

T = TypeVar("T")
Mode = Literal["first", "next", "goal"]
_KINDS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp", ".heic": "heic"}  # of photos, by suffix


class Client:
    """A connection to a service that `osf serve` runs.

    Args:
        url: of the service.
        token: where it was started with one.
        timeout_s: how long one answer may take [s]; following episodes and estimates has no limit.
        connection: instead of url, token and timeout.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        token: str | None = None,
        timeout_s: float = 60.0,
        connection: Connection | None = None,
    ) -> None:
        self._service = connection or Connection.to(url, token, timeout_s)

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """End the connection; what runs in the service goes on."""
        self._service.close()

    def health(self) -> Health:
        """Whether and how the service runs."""
        return decode(Health, self._service.json("GET", "/api/health"), "health")

    def objects(self) -> tuple[str, ...]:
        """Names of the objects that scenes can be made of."""
        listed = self._service.json("GET", "/api/objects")["objects"]
        return tuple(one["name"] for one in listed if one["available"])

    # Tables

    def new_scene(
        self,
        objects: Sequence[str] | None = None,
        *,
        count: int = 3,
        seed: int | None = None,
        light: Light | None = None,
        poses: Mapping[str, Pose] | None = None,
    ) -> RemoteScene:
        """Make a table and show it.

        Args:
            objects: their names; `count` that the seed draws otherwise.
            count: how many, where they are not named.
            seed: the same seed makes the same scene; any otherwise.
            light: drawn from the seed otherwise.
            poses: of all objects; drawn from the seed otherwise.

        Raises:
            ServiceError: if there can be no such scene.
        """
        body = {
            "objects": None if objects is None else list(objects),
            "count": count,
            "seed": seed,
            "light": _light(light),
            "poses": None if poses is None else _poses(poses),
        }
        return RemoteScene.of(self._service.json("POST", "/api/scenes", body))

    def scene(self, scene: str | None = None) -> RemoteScene:
        """A table as it is now; the one that is shown if none is named."""
        return RemoteScene.of(self._service.json("GET", f"/api/scenes/{scene or self._shown()}"))

    def act(self, actions: Float[np.ndarray, "T 3"], scene: str | None = None) -> RemoteScene:
        """Move the pusher by hand, each velocity (vx, vy, 0) [m/s] for 0.2 s.

        Raises:
            InvalidInput: if one of them is outside its limits.
        """
        body = {"actions": check_actions(np.asarray(actions)[None])[0].tolist()}
        return RemoteScene.of(self._service.json("POST", f"/api/scenes/{scene or self._shown()}/actions", body))

    def image(
        self, camera: str = "goal", scene: str | None = None, *, size: int | None = None, pusher: bool = True
    ) -> Float32[np.ndarray, "h w 3"]:
        """What a camera of a table sees.

        Args:
            camera: "0" to "3", or "goal".
            scene: the table; the one that is shown if none is named.
            size: side of the image [px]; the scene's own otherwise.
            pusher: whether it is shown.
        """
        path = f"/api/scenes/{scene or self._shown()}/images/{camera}.png"
        return _image(self._service.bytes(path, size=size, pusher=str(pusher).lower()))

    # Goals

    def upload_goal(self, photo: str | Path | Float[np.ndarray, "h w 3"], name: str | None = None) -> Goal:
        """Send a photo that shows how the table shall look.

        Args:
            photo: a file, or linear RGB in [0, 1].
            name: for people; the file's own otherwise.

        Raises:
            InvalidInput: if there is no such file, or none of a kind that is taken.
        """
        if isinstance(photo, np.ndarray):
            content, kind, name = encode_png(to_uint8(photo)), "image/png", name or "Photo"
        else:
            path = Path(photo)
            kind = f"image/{_KINDS.get(path.suffix.lower())}"
            if path.suffix.lower() not in _KINDS or not path.is_file():
                raise InvalidInput("photo", path, f"a file that is there and ends in {', '.join(_KINDS)}")
            content, name = path.read_bytes(), name or path.stem
        return Goal.of(self._service.send("POST", "/api/goals", content, kind, name=name))

    def goal_of(
        self, poses: Mapping[str, Pose], *, light: Light | None = None, name: str = "Goal", scene: str | None = None
    ) -> Goal:
        """Make a goal image in the simulation, in which some objects of a table lie elsewhere."""
        body = {"scene": scene, "objects": _poses(poses), "light": _light(light), "name": name}
        return Goal.of(self._service.json("POST", "/api/goals", body))

    def random_goal(self, seed: int = 0, *, moved: int | None = None, scene: str | None = None) -> Goal:
        """Make a goal image in which `moved` objects of a table lie elsewhere, as the seed draws it."""
        body = {"scene": scene, "random": {"seed": seed, "moved": moved}}
        return Goal.of(self._service.json("POST", "/api/goals", body))

    def goal_image(self, goal: Goal) -> Float32[np.ndarray, "h w 3"]:
        """The image itself."""
        return _image(self._service.bytes(f"/api/goals/{goal.id}/image.png"))

    def goal_problem(self, goal: Goal, scene: str | None = None) -> str:
        """What speaks against a goal for a table, in a sentence; "" if nothing does."""
        return self._service.json("GET", f"/api/goals/{goal.id}/check", scene=scene)["text"]

    # Estimates and predictions

    def estimate(
        self,
        mode: Mode = "first",
        *,
        observation: str | Path | None = None,
        scene: str | None = None,
        prior: str | None = None,
        seed: int = 0,
    ) -> Iterator[Estimate]:
        """Find poses and light; yields how it goes, last with the result.

        Args:
            mode: "first" from masks alone, "next" without masks from an earlier estimate, "goal" from one view.
            observation: a folder with observation.json; what the cameras of a table see otherwise.
            scene: the table; the one that is shown if none is named.
            prior: the earlier estimate of mode "next" and "goal"; the latest of the table otherwise.
            seed: of the search.
        """
        if observation is None:
            body = {"mode": mode, "scene": scene, "prior": prior, "seed": seed}
            data = self._service.json("POST", "/api/estimates", body)
        else:
            query = {"mode": mode, "prior": prior, "seed": seed}
            data = self._service.send("POST", "/api/estimates", _zipped(Path(observation)), "application/zip", **query)
        return self._followed("/api/estimates", data, Estimate)

    def predict(self, actions: Float[np.ndarray, "K T 3"], state: SceneState | None = None) -> Rollouts:
        """What sequences of pusher velocities would do.

        Args:
            actions: each held for 0.2 s [m/s].
            state: to begin with; the true one of the table that is shown otherwise.

        Raises:
            InvalidInput: if an action is outside its limits.
        """
        body = {"actions": check_actions(actions).tolist(), "state": None if state is None else state_to_json(state)}
        return rollouts_from_json(self._service.json("POST", "/api/predictions", body))

    # Episodes

    def episode(
        self, goal: Goal | Mapping[str, Pose], *, scene: str | None = None, seed: int = 0, **settings: object
    ) -> Iterator[Episode]:
        """Rearrange a table until it looks like the goal; yields how it goes, last how it ended.

        The episode starts at once and goes on if nobody follows it any more; `cancel` ends it.

        Args:
            goal: a goal image, or poses of all objects.
            scene: the table; the one that is shown if none is named.
            seed: of the search and the planner.
            settings: what shall be other than by default: steps, replan_every, cost, samples, horizon, temperature,
                despite_doubts, method.

        Raises:
            ServiceError: if a setting is not allowed, or an episode runs on this table already.
        """
        to = {"goal": goal.id} if isinstance(goal, Goal) else {"poses": _poses(goal)}
        data = self._service.json("POST", "/api/episodes", {"scene": scene, "seed": seed, "settings": settings, **to})
        return self._followed("/api/episodes", data, Episode)

    def episodes(self) -> tuple[Episode, ...]:
        """The latest episodes, newest first, without their steps."""
        return tuple(decode(Episode, one, "episode") for one in self._service.json("GET", "/api/episodes")["episodes"])

    def cancel(self, running: Episode | Estimate) -> None:
        """End an episode or an estimate; what an episode has done is kept.

        Raises:
            ServiceError: if it has ended already.
        """
        noun = "episodes" if isinstance(running, Episode) else "estimates"
        self._service.json("DELETE", f"/api/{noun}/{running.id}")

    def download(self, episode: Episode, file: str, to: str | Path = ".") -> Path:
        """Write one of an episode's files to disk.

        Args:
            episode: one whose `files` name it.
            file: such as "video.mp4" or "report.json".
            to: a file, or a folder to put it into.
        """
        place = Path(to)
        return self._service.download(
            f"/api/episodes/{episode.id}/files/{file}", place / file if place.is_dir() else place
        )

    def _shown(self) -> str:
        current = self._service.json("GET", "/api/scenes")["current"]
        if current is None:
            raise InvalidInput("table", "none", "one that is shown; make one first, with new_scene")
        return current

    def _followed(self, place: str, data: dict[str, Any], kind: type[T]) -> Iterator[T]:
        """How a job is now whenever it changes."""
        path = f"{place}/{data['id']}"

        def states() -> Iterator[T]:
            yield decode(kind, data, place)
            for _ in self._service.follow(f"{path}/events"):
                yield decode(kind, self._service.json("GET", path), path)

        return states()


def _light(light: Light | None) -> dict[str, Any] | None:
    return None if light is None else {"position": light.position.tolist()}


def _poses(poses: Mapping[str, Pose]) -> list[dict[str, Any]]:
    return [
        {"name": name, "position": pose.position.tolist(), "quaternion": pose.quaternion.tolist()}
        for name, pose in poses.items()
    ]


def _image(content: bytes) -> Float32[np.ndarray, "h w 3"]:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.float32) / 255


def _zipped(folder: Path) -> bytes:
    if not (folder / "observation.json").is_file():
        raise InvalidInput("observation", folder, "a folder with observation.json in it")
    with tempfile.TemporaryDirectory() as place:
        return Path(shutil.make_archive(f"{place}/seen", "zip", folder)).read_bytes()
