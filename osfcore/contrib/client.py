"""A Python client of the REST service: tables, goals, estimates, predictions, episodes.

    with Client("http://127.0.0.1:8000") as osf:
        goal = osf.upload_goal("photo.jpg")
        for episode in osf.episode(goal):
            print(episode.done, episode.note)

It returns poses, cameras and lights as types of the core, and images as linear RGB in [0, 1].
"""

from __future__ import annotations

import io
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import httpx2
import numpy as np
from jaxtyping import Float, Float32
from PIL import Image

from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.files import file_at_once
from osfcore.io.image_file import encode_png, to_uint8
from osfcore.io.json_codec import Entry, decode, encode
from osfcore.io.scene_file import (
    CameraJson,
    EstimateJson,
    ObjectJson,
    rollouts_from_json,
    scene_from_json,
    state_to_json,
)

# Answers of the service, decoded from the JSON that the REST interface documents; unknown members are ignored. A test
# compares them with the OpenAPI schema.


class Health(Entry):
    """State of the service.

    Attributes:
        status: "ok" or "degraded".
        problems: present problems, one sentence each.
        version: version of the program.
        stage: state of the simulation: "starting", "ready" or "restarting".
    """

    status: str
    problems: list[str]
    version: str
    stage: str


@dataclass(frozen=True, eq=False, slots=True)
class RemoteScene:
    """A simulated table in the service.

    Attributes:
        id: identifier of the table.
        state: true poses of the objects, the light and the pusher.
        cameras: cameras that look at the table. The last one takes goal images.
        time_s: simulated time since the table was made [s].
    """

    id: str
    state: SceneState
    cameras: tuple[Camera, ...]
    time_s: float

    @staticmethod
    def of(data: dict[str, Any]) -> RemoteScene:
        """Decode an answer of the service."""
        scene, facts = scene_from_json(data), decode(_SceneFacts, data, "scene")
        return RemoteScene(facts.id, scene.state, scene.cameras, facts.time_s)


class _SceneFacts(Entry):
    id: str
    time_s: float


@dataclass(frozen=True, eq=False, slots=True)
class Goal:
    """A goal image in the service.

    Attributes:
        id: identifier of the goal.
        name: name for people.
        camera: camera that took the image.
        names: names of the objects whose goal poses are known; empty for a photo.
    """

    id: str
    name: str
    camera: Camera
    names: tuple[str, ...]

    @staticmethod
    def of(data: object) -> Goal:
        """Decode an answer of the service."""
        facts = decode(_GoalFacts, data, "goal")
        names = tuple(one.name for one in facts.objects or ())
        return Goal(facts.id, facts.name, facts.camera.camera(), names)


class _GoalFacts(Entry):
    id: str
    name: str
    camera: CameraJson
    objects: list[ObjectJson] | None


class EpisodeStep(Entry):
    """One round of an episode. The first entry describes the start.

    Attributes:
        step: actions executed so far.
        image_cost: mean squared difference between the goal image and the rendered estimate.
        to_goal_mm: estimated distance of each object from its goal [mm]; None if the method compares images only.
        to_goal_deg: estimated angle of each object from its goal [deg]; None if the method compares images only.
        seconds: time spent on each stage [s].
    """

    step: int
    image_cost: float
    to_goal_mm: dict[str, float] | None
    to_goal_deg: dict[str, float] | None
    seconds: dict[str, float]


class Running(Entry):
    """Present state of a job of the service.

    Attributes:
        id: identifier of the job.
        status: status of the job.
        stage: present stage, such as "first", "goal", "plan" or "act" in an episode.
        done: units of work that are done; in an episode, actions.
        total: largest number of units; 0 while it is unknown.
        note: what the job is doing, for people.
        eta_s: estimated time left [s]; None while it is unknown.
        error: why the job failed; None if it did not.
    """

    id: str
    status: Literal["queued", "running", "paused", "done", "failed", "cancelled", "interrupted"]
    stage: str | None
    done: int
    total: int
    note: str
    eta_s: float | None
    error: str | None

    @property
    def is_over(self) -> bool:
        """Whether the job has ended."""
        return self.status not in ("queued", "running", "paused")


class Episode(Running):
    """Present state of an episode. It has the attributes of `Running` as well.

    Attributes:
        name: name for people.
        scene: identifier of the table.
        outcome: "reached", "out of steps" or "refused"; None while it runs, or if it was cancelled or failed.
        text: the outcome in one sentence.
        steps: all rounds so far.
        files: names of the files that `Client.download` can fetch.
    """

    name: str
    scene: str
    outcome: str | None
    text: str | None
    steps: list[EpisodeStep]
    files: list[str]


class Estimate(Running):
    """Present state of an estimate of poses and light. It has the attributes of `Running` as well.

    Attributes:
        estimate: the result in the form of state.json; None while it runs.
    """

    estimate: EstimateJson | None

    @property
    def estimated(self) -> EstimatedState | None:
        """The result; None while it runs."""
        return None if self.estimate is None else self.estimate.estimate()


# HTTP with the service: requests, streams of events, and problems (RFC 9457) as errors of one sentence.


_QUIET_S = 60.0  # without a byte before a stream counts as lost; a service that works sends something sooner
_RECONNECTS = 5  # in a row, without an event between them


class ServiceError(OsfError):
    """The service refused a request, or did not answer.

    Args:
        sentence: the message, one sentence.
        status: HTTP status; 0 if there was no answer.
    """

    def __init__(self, sentence: str, status: int = 0) -> None:
        super().__init__(sentence)
        self.status = status


class Connection:
    """A connection to one service.

    Args:
        http: an HTTP client with base address and headers. Closing the connection closes it.
    """

    def __init__(self, http: httpx2.Client) -> None:
        self._http = http

    def close(self) -> None:
        """Release the sockets."""
        self._http.close()

    def json(self, method: str, path: str, body: object = None, **query: object) -> Any:  # noqa: ANN401
        """Return the parsed answer to a request.

        Raises:
            ServiceError: if it is refused or there is no answer.
        """
        return self._answer(method, path, query, json=body).json()

    def send(self, method: str, path: str, content: bytes, kind: str, **query: object) -> Any:  # noqa: ANN401
        """Return the parsed answer to a request with a file.

        Args:
            method: HTTP method.
            path: path from the root of the service.
            content: contents of the file.
            kind: media type of the file.
            query: query parameters. Those that are None are left out.

        Raises:
            ServiceError: if it is refused or there is no answer.
        """
        return self._answer(method, path, query, content=content, headers={"Content-Type": kind}).json()

    def bytes(self, path: str, **query: object) -> bytes:
        """Return a file.

        Raises:
            ServiceError: if there is none or no answer.
        """
        return self._answer("GET", path, query).content

    def download(self, path: str, to: Path) -> Path:
        """Write a file to disk in chunks. It appears once it is complete.

        Raises:
            ServiceError: if there is none or no answer.
            CannotWrite: if the disk refuses.
        """
        with self._reached(), self._http.stream("GET", path) as answer:
            _check(answer)
            with file_at_once(to) as partial, partial.open("wb") as file:
                for chunk in answer.iter_bytes():
                    file.write(chunk)
        return to

    def follow(self, path: str) -> Iterator[Any]:
        """Yield the parsed data of a stream of events until it ends; reopen it if the network breaks it.

        Raises:
            ServiceError: if there is no such stream, or the service no longer answers.
        """
        breaks = 0
        while True:
            try:
                with self._http.sse(path, timeout=_QUIET_S) as events:
                    _check(events.response)
                    for event in events:
                        breaks = 0
                        yield event.json()
                    return
            except httpx2.TransportError as error:
                breaks += 1
                if breaks > _RECONNECTS or isinstance(error, httpx2.ConnectError):
                    raise self._silent(error) from error

    def _answer(self, method: str, path: str, query: dict[str, object], **more: Any) -> httpx2.Response:  # noqa: ANN401
        params: Any = {key: value for key, value in query.items() if value is not None}
        with self._reached():
            answer = self._http.request(method, path, params=params, **more)
        _check(answer)
        return answer

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """Raise errors of the network as `ServiceError`."""
        try:
            yield
        except (httpx2.TransportError, httpx2.InvalidURL) as error:
            raise self._silent(error) from error

    def _silent(self, error: Exception) -> ServiceError:
        what = f"The service at {self._http.base_url} does not answer ({error})"
        return ServiceError(f"{what}; start it with 'osf serve', or give its address.")


def _check(answer: httpx2.Response) -> None:
    if answer.is_success:
        return
    answer.read()
    try:
        detail = answer.json()["detail"]
    except (ValueError, KeyError, TypeError):
        what = f"{answer.url} answered {answer.status_code} as this service does not"
        detail = f"{what}; give the address of one that 'osf serve' runs."
    raise ServiceError(detail, answer.status_code)


T = TypeVar("T")
Mode = Literal["first", "next", "goal"]
_KINDS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp", ".heic": "heic"}  # of photos, by suffix


class Client:
    """A client of a running service (`osf serve`).

    Methods with a `scene` argument take the identifier of a table; None means the table that the page shows. All
    methods raise `ServiceError` if the service refuses the request or does not answer.

    Args:
        url: address of the service.
        token: token of the service, if it was started with one.
        timeout_s: longest time for one answer [s]. It does not limit how long episodes and estimates are followed.
        connection: a connection to use instead of url, token and timeout.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        token: str | None = None,
        timeout_s: float = 60.0,
        connection: Connection | None = None,
    ) -> None:
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._service = connection or Connection(httpx2.Client(base_url=url, headers=headers, timeout=timeout_s))

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the connection."""
        self.close()

    def close(self) -> None:
        """Close the connection. Jobs of the service continue."""
        self._service.close()

    def health(self) -> Health:
        """Return the state of the service."""
        return decode(Health, self._service.json("GET", "/api/health"), "health")

    def objects(self) -> tuple[str, ...]:
        """Return the names of the objects that can be put on a table."""
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
        """Make a table and show it on the page.

        Args:
            objects: names of the objects; None to draw `count` of them.
            count: number of objects to draw if `objects` is None.
            seed: seed of everything random. The same seed gives the same table; None takes a new one.
            light: the light; None to draw it.
            poses: `T_world_object` of all objects, by name; None to draw them.

        Raises:
            ServiceError: if such a table is impossible.
        """
        body = {
            "objects": None if objects is None else list(objects),
            "count": count,
            "seed": seed,
            "light": _light(light),
            "poses": None if poses is None else _poses(poses),
        }
        return RemoteScene.of(self._service.json("POST", "/api/scenes", body))

    def scenes(self) -> tuple[RemoteScene, ...]:
        """Return the tables, oldest first."""
        return tuple(map(RemoteScene.of, self._service.json("GET", "/api/scenes")["scenes"]))

    def scene(self, scene: str | None = None) -> RemoteScene:
        """Return the present state of a table."""
        return RemoteScene.of(self._service.json("GET", f"/api/scenes/{scene or self._shown()}"))

    def act(self, actions: Float[np.ndarray, "T 3"], scene: str | None = None) -> RemoteScene:
        """Move the pusher with velocities (vx, vy, 0) in the world [m/s], each for 0.2 s.

        Raises:
            InvalidInput: if an action is outside its limits.
        """
        body = {"actions": check_actions(np.asarray(actions)[None])[0].tolist()}
        return RemoteScene.of(self._service.json("POST", f"/api/scenes/{scene or self._shown()}/actions", body))

    def image(
        self, camera: str = "goal", scene: str | None = None, *, size: int | None = None, pusher: bool = True
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return an image of a table, linear RGB in [0, 1].

        Args:
            camera: name of the camera: "0" to "3", or "goal".
            scene: the table.
            size: side of the image [px]; None for the size of the camera.
            pusher: whether the image shows the pusher.
        """
        path = f"/api/scenes/{scene or self._shown()}/images/{camera}.png"
        return _image(self._service.bytes(path, size=size, pusher=str(pusher).lower()))

    # Goals

    def upload_goal(self, photo: str | Path | Float[np.ndarray, "h w 3"], name: str | None = None) -> Goal:
        """Upload a photo of the goal.

        Args:
            photo: an image file, or an image as linear RGB in [0, 1].
            name: name for people; the name of the file if None.

        Raises:
            InvalidInput: if the file does not exist, or is not an image of a supported type.
        """
        if isinstance(photo, np.ndarray):
            content, kind, name = encode_png(to_uint8(photo)), "image/png", name or "Photo"
        else:
            path = Path(photo)
            suffix = path.suffix.lower()
            if suffix not in _KINDS or not path.is_file():
                raise InvalidInput("photo", path, f"an existing file whose name ends in {', '.join(_KINDS)}")
            content, kind, name = path.read_bytes(), f"image/{_KINDS[suffix]}", name or path.stem
        return Goal.of(self._service.send("POST", "/api/goals", content, kind, name=name))

    def goal_of(
        self, poses: Mapping[str, Pose], *, light: Light | None = None, name: str = "Goal", scene: str | None = None
    ) -> Goal:
        """Make a goal image in the simulation, in which some objects of a table have these poses `T_world_object`."""
        body = {"scene": scene, "objects": _poses(poses), "light": _light(light), "name": name}
        return Goal.of(self._service.json("POST", "/api/goals", body))

    def random_goal(self, seed: int = 0, *, moved: int | None = None, scene: str | None = None) -> Goal:
        """Make a goal image in which `moved` objects of a table lie at random places; None for a random number."""
        body = {"scene": scene, "random": {"seed": seed, "moved": moved}}
        return Goal.of(self._service.json("POST", "/api/goals", body))

    def goal(self, goal: str) -> Goal:
        """Return the goal that has an identifier."""
        return Goal.of(self._service.json("GET", f"/api/goals/{goal}"))

    def goal_image(self, goal: Goal) -> Float32[np.ndarray, "h w 3"]:
        """Return the image of a goal, linear RGB in [0, 1]."""
        return _image(self._service.bytes(f"/api/goals/{goal.id}/image.png"))

    def goal_problem(self, goal: Goal, scene: str | None = None) -> str:
        """Return why a goal does not suit a table, in one sentence; "" if it does."""
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
        """Estimate poses and light; yield the progress. The last value has the result.

        Args:
            mode: "first" for images with masks and no guess, "next" for images after an earlier estimate, "goal" for
                one goal image.
            observation: a folder with observation.json; None to use the cameras of a table.
            scene: the table.
            prior: identifier of the earlier estimate for modes "next" and "goal"; the latest of the table if None.
            seed: seed of the search.
        """
        place, asked = "/api/estimates", {"mode": mode, "prior": prior, "seed": seed}
        if observation is None:
            data = self._service.json("POST", place, {**asked, "scene": scene})
        else:
            data = self._service.send("POST", place, _zipped(Path(observation)), "application/zip", **asked)
        return self._followed(place, data, Estimate)

    def predict(self, actions: Float[np.ndarray, "K T 3"], state: SceneState | None = None) -> Rollouts:
        """Predict the poses of all objects under K sequences of T actions.

        Args:
            actions: velocities (vx, vy, 0) of the pusher in the world [m/s], each held for 0.2 s.
            state: state to begin with; the true state of the table that the page shows if None.

        Raises:
            InvalidInput: if an action is outside its limits.
        """
        body = {"actions": check_actions(actions).tolist(), "state": None if state is None else state_to_json(state)}
        return rollouts_from_json(self._service.json("POST", "/api/predictions", body))

    # Episodes

    def episode(
        self, goal: Goal | Mapping[str, Pose], *, scene: str | None = None, seed: int = 0, **settings: object
    ) -> Iterator[Episode]:
        """Rearrange a table until it looks like the goal; yield the progress. The last value has the outcome.

        The episode starts at once. It continues if the caller stops iterating; `cancel` ends it.

        Args:
            goal: a goal image, or goal poses `T_world_object` of all objects.
            scene: the table.
            seed: seed of the search and the planner.
            settings: settings that differ from the defaults: steps, replan_every, cost, samples, horizon, temperature,
                despite_doubts, method.

        Raises:
            ServiceError: if a setting is not allowed, or an episode runs on this table already.
        """
        to = {"goal": goal.id} if isinstance(goal, Goal) else {"poses": _poses(goal)}
        data = self._service.json("POST", "/api/episodes", {"scene": scene, "seed": seed, "settings": settings, **to})
        return self._followed("/api/episodes", data, Episode)

    def episodes(self) -> tuple[Episode, ...]:
        """Return the latest episodes, newest first. Their `steps` are empty."""
        return tuple(decode(Episode, one, "episode") for one in self._service.json("GET", "/api/episodes")["episodes"])

    def latest(self, episode: str) -> Episode:
        """Return the present state of the episode that has an identifier."""
        return decode(Episode, self._service.json("GET", f"/api/episodes/{episode}"), "episode")

    def frame(self, episode: Episode, step: int) -> Float32[np.ndarray, "h w 3"]:
        """Return a picture of one of an episode's `steps`, in [0, 1]: goal, table, estimate and cameras."""
        return _image(self._service.bytes(f"/api/episodes/{episode.id}/frames/{step}.png"))

    def cancel(self, running: Episode | Estimate) -> None:
        """Cancel an episode or an estimate. The steps of an episode so far are kept.

        Raises:
            ServiceError: if the job has already ended.
        """
        noun = "episodes" if isinstance(running, Episode) else "estimates"
        self._service.json("DELETE", f"/api/{noun}/{running.id}")

    def download(self, episode: Episode, file: str, to: str | Path = ".") -> Path:
        """Write one of an episode's files to disk.

        Args:
            episode: the episode.
            file: a name in its `files`, such as "video.mp4" or "report.json".
            to: the file to write, or the folder to write it into.

        Returns:
            The file that was written.
        """
        place = Path(to) / file if Path(to).is_dir() else Path(to)
        return self._service.download(f"/api/episodes/{episode.id}/files/{file}", place)

    def _shown(self) -> str:
        current = self._service.json("GET", "/api/scenes")["current"]
        if current is None:
            raise InvalidInput("table", "none", "a table that the page shows; call new_scene first")
        return current

    def _followed(self, place: str, data: dict[str, Any], kind: type[T]) -> Iterator[T]:
        """Yield the present state of a job, and its state after every change."""
        path = f"{place}/{data['id']}"

        def states() -> Iterator[T]:
            yield decode(kind, data, place)
            for _ in self._service.follow(f"{path}/events"):
                yield decode(kind, self._service.json("GET", path), path)

        return states()


def _light(light: Light | None) -> dict[str, Any] | None:
    return None if light is None else {"position": light.position.tolist()}


def _poses(poses: Mapping[str, Pose]) -> list[dict[str, Any]]:
    return [encode(ObjectJson.of(name, pose)) for name, pose in poses.items()]


def _image(content: bytes) -> Float32[np.ndarray, "h w 3"]:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.float32) / 255


def _zipped(folder: Path) -> bytes:
    if not (folder / "observation.json").is_file():
        raise InvalidInput("observation", folder, "a folder with observation.json in it")
    with tempfile.TemporaryDirectory() as place:
        return Path(shutil.make_archive(f"{place}/seen", "zip", folder)).read_bytes()
