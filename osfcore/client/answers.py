"""What the service answers, as frozen dataclasses with the core's own types; members it does not know are left alone.

Each is decoded from the JSON that the REST interface documents; a test compares them with its OpenAPI schema.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from osfcore.geometry.cameras import Camera
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.states import SceneState
from osfcore.io.json_codec import Entry, decode
from osfcore.io.scene_file import CameraJson, ObjectJson, scene_from_json
from osfcore.io.state_file import EstimateJson


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
        id: names it.
        state: poses of the objects, light and pusher as they truly are.
        cameras: that look at it; the last one takes goal images.
        time_s: simulated time since it was made [s].
    """

    id: str
    state: SceneState
    cameras: tuple[Camera, ...]
    time_s: float

    @staticmethod
    def of(data: dict[str, Any]) -> RemoteScene:
        """From what the service answers."""
        scene, facts = scene_from_json(data), decode(_SceneFacts, data, "scene")
        return RemoteScene(facts.id, scene.state, scene.cameras, facts.time_s)


class _SceneFacts(Entry):
    id: str
    time_s: float


@dataclass(frozen=True, eq=False, slots=True)
class Goal:
    """A goal image that the service keeps.

    Attributes:
        id: names it.
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
        """From what the service answers."""
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


class _Running(Entry):
    """Work of the service as it is now.

    Attributes:
        id: names it.
        status: of its job.
        stage: what it does, such as "first", "goal", "plan", "act" in an episode.
        done: units of work, or actions of an episode, that are done.
        total: in all, at most; 0 before it is known.
        note: what happens now, for people.
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


class Episode(_Running):
    """An episode as it is now.

    Attributes:
        name: for people.
        scene: its table.
        outcome: "reached", "out of steps" or "refused" once it has ended by itself.
        text: the outcome in a sentence.
        steps: all so far.
        files: that `Client.download` brings.
    """

    name: str
    scene: str
    outcome: str | None
    text: str | None
    steps: list[EpisodeStep]
    files: list[str]


class Estimate(_Running):
    """An estimate of poses and light as it is now.

    Attributes:
        estimate: the result as in state.json; None before it is there.
    """

    estimate: EstimateJson | None

    @property
    def estimated(self) -> EstimatedState | None:
        """The result; None before it is there."""
        return None if self.estimate is None else self.estimate.estimate()
