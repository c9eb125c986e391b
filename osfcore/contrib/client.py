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
    """Whether and how the service runs.

    Attributes:
        status: "ok" or "degraded".
        problems: what is wrong now, a sentence each.
        version: of the program.
        stage: of the simulation: "starting", "ready" or "restarting".
    """

    status: str
    problems: list[str]
    version: str
    stage: str


@dataclass(frozen=True, eq=False, slots=True)
class RemoteScene:
    """A table of the service.

    Attributes:
        id: its identifier.
        state: true poses of the objects, light and pusher.
        cameras: that look at it; the last one takes goal images.
        time_s: simulated time since it was made [s].
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
    """A goal image that the service keeps.

    Attributes:
        id: its identifier.
        name: for people.
        camera: that took the image.
        names: of the objects whose places in it are known; none of a photo.
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
    """One round of the loop, or how it was before the first.

    Attributes:
        step: actions executed so far.
        image_cost: mean squared difference of goal image and rendered estimate.
        to_goal_mm: of each object as estimated [mm]; None where the method looks at images alone.
        to_goal_deg: likewise [deg].
        seconds: spent, by part of the loop [s].
    """

    step: int
    image_cost: float
    to_goal_mm: dict[str, float] | None
    to_goal_deg: dict[str, float] | None
    seconds: dict[str, float]


class Running(Entry):
    """Work of the service as it is now.

    Attributes:
        id: its identifier.
        status: of its job.
        stage: of the work, such as "first", "goal", "plan", "act" in an episode.
        done: units of work, or actions of an episode, that are done.
        total: at most so many units; 0 before it is known.
        note: the work of the moment, for people.
        eta_s: estimated time left [s].
        error: why it failed, if it did.
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
        """Whether nothing more comes."""
        return self.status not in ("queued", "running", "paused")


class Episode(Running):
    """An episode as it is now.

    Attributes:
        name: for people.
        scene: its table.
        outcome: "reached", "out of steps" or "refused" once it has ended by itself.
        text: the outcome in a sentence.
        steps: all so far.
        files: names for `Client.download`.
    """

    name: str
    scene: str
    outcome: str | None
    text: str | None
    steps: list[EpisodeStep]
    files: list[str]


class Estimate(Running):
    """An estimate of poses and light as it is now.

    Attributes:
        estimate: the result as in state.json; None before it is there.
    """

    estimate: EstimateJson | None

    @property
    def estimated(self) -> EstimatedState | None:
        """The result; None before it is there."""
        return None if self.estimate is None else self.estimate.estimate()


# HTTP with the service: requests, streams of events, and problems (RFC 9457) as errors of one sentence.


_QUIET_S = 60.0  # without a byte before a stream counts as lost; a service that works sends something sooner
_RECONNECTS = 5  # in a row, without an event between them


class ServiceError(OsfError):
    """The service refused a request, or does not answer.

    Args:
        sentence: for a person.
        status: of HTTP; 0 without an answer.
    """

    def __init__(self, sentence: str, status: int = 0) -> None:
        super().__init__(sentence)
        self.status = status


class Connection:
    """A connection to one service.

    Args:
        http: an HTTP client with base address and headers; closed with this.
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
            method: of HTTP.
            path: from the root.
            content: of the file.
            kind: its media type.
            query: parameters; those that are None are left out.

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
        """Write a file to disk piece by piece; it appears when it is whole.

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
        """Yield the parsed data of a stream of events until it ends; open it again where the network breaks it.

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
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._service = connection or Connection(httpx2.Client(base_url=url, headers=headers, timeout=timeout_s))

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """End the connection; what runs in the service goes on."""
        self._service.close()

    def health(self) -> Health:
        """Return whether and how the service runs."""
        return decode(Health, self._service.json("GET", "/api/health"), "health")

    def objects(self) -> tuple[str, ...]:
        """Return the names of the objects that scenes can be made of."""
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
        """Return a table as it is now; the one that is shown if none is named."""
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
        """Return the image of a camera of a table.

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
        """Send a photo of the goal.

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
            suffix = path.suffix.lower()
            if suffix not in _KINDS or not path.is_file():
                raise InvalidInput("photo", path, f"a file that is there and ends in {', '.join(_KINDS)}")
            content, kind, name = path.read_bytes(), f"image/{_KINDS[suffix]}", name or path.stem
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
        """Return the image of a goal."""
        return _image(self._service.bytes(f"/api/goals/{goal.id}/image.png"))

    def goal_problem(self, goal: Goal, scene: str | None = None) -> str:
        """Return why a goal is unfit for a table, in a sentence; "" if it is fit."""
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
        """Estimate poses and light; yield the progress, last with the result.

        Args:
            mode: "first" from masks alone, "next" without masks from an earlier estimate, "goal" from one view.
            observation: a folder with observation.json; otherwise the cameras of a table are used.
            scene: the table; the one that is shown if none is named.
            prior: the earlier estimate of mode "next" and "goal"; the latest of the table otherwise.
            seed: of the search.
        """
        place, asked = "/api/estimates", {"mode": mode, "prior": prior, "seed": seed}
        if observation is None:
            data = self._service.json("POST", place, {**asked, "scene": scene})
        else:
            data = self._service.send("POST", place, _zipped(Path(observation)), "application/zip", **asked)
        return self._followed(place, data, Estimate)

    def predict(self, actions: Float[np.ndarray, "K T 3"], state: SceneState | None = None) -> Rollouts:
        """Predict what sequences of pusher velocities would do.

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
        """Rearrange a table until it looks like the goal; yield the progress, last the outcome.

        The episode starts at once and goes on if nobody follows it any more; `cancel` ends it.

        Args:
            goal: a goal image, or poses of all objects.
            scene: the table; the one that is shown if none is named.
            seed: of the search and the planner.
            settings: that differ from the defaults: steps, replan_every, cost, samples, horizon, temperature,
                despite_doubts, method.

        Raises:
            ServiceError: if a setting is not allowed, or an episode runs on this table already.
        """
        to = {"goal": goal.id} if isinstance(goal, Goal) else {"poses": _poses(goal)}
        data = self._service.json("POST", "/api/episodes", {"scene": scene, "seed": seed, "settings": settings, **to})
        return self._followed("/api/episodes", data, Episode)

    def episodes(self) -> tuple[Episode, ...]:
        """Return the latest episodes, newest first, without their steps."""
        return tuple(decode(Episode, one, "episode") for one in self._service.json("GET", "/api/episodes")["episodes"])

    def cancel(self, running: Episode | Estimate) -> None:
        """End an episode or an estimate; the actions of an episode are kept.

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
        place = Path(to) / file if Path(to).is_dir() else Path(to)
        return self._service.download(f"/api/episodes/{episode.id}/files/{file}", place)

    def _shown(self) -> str:
        current = self._service.json("GET", "/api/scenes")["current"]
        if current is None:
            raise InvalidInput("table", "none", "one that is shown; make one first, with new_scene")
        return current

    def _followed(self, place: str, data: dict[str, Any], kind: type[T]) -> Iterator[T]:
        """Yield the state of a job now and after every change."""
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
