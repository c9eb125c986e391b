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
from osfcore.io.state_file import estimated_from_json

Status = Literal["queued", "running", "paused", "done", "failed", "cancelled"]
_OVER = ("done", "failed", "cancelled")


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


class Episode(Entry):
    """An episode as it is now.

    Attributes:
        id: names it.
        name: for people.
        scene: its table.
        status: of its job.
        stage: what it does: "first", "goal", "plan", "act", "next", "search".
        done: actions executed.
        total: actions at most.
        note: what happens now, for people.
        eta_s: estimated time left [s].
        outcome: "reached", "out of steps" or "refused" once it has ended by itself.
        text: the outcome in a sentence.
        error: why it failed, if it did.
        steps: all so far.
        files: that `Client.download` brings.
    """

    id: str
    name: str
    scene: str
    status: Status
    stage: str | None
    done: int
    total: int
    note: str
    eta_s: float | None
    outcome: str | None
    text: str | None
    error: str | None
    steps: list[EpisodeStep]
    files: list[str]

    @property
    def is_over(self) -> bool:
        """Whether nothing more comes."""
        return self.status in _OVER


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """An estimate of poses and light as it is now.

    Attributes:
        id: names it.
        status: of its job.
        stage: what it does.
        done: units of work that are done, of `total`.
        total: units in all; 0 before it is known.
        note: what happens now, for people.
        error: why it failed, if it did.
        estimated: the result; None before it is there.
    """

    id: str
    status: Status
    stage: str | None
    done: int
    total: int
    note: str
    error: str | None
    estimated: EstimatedState | None

    @property
    def is_over(self) -> bool:
        """Whether nothing more comes."""
        return self.status in _OVER

    @staticmethod
    def of(data: dict[str, Any]) -> Estimate:
        """From what the service answers."""
        facts = decode(_EstimateFacts, data, "estimate")
        result = data.get("estimate")
        estimated = None if result is None else estimated_from_json(result)
        return Estimate(**dict(facts), estimated=estimated)


class _EstimateFacts(Entry):
    id: str
    status: Status
    stage: str | None
    done: int
    total: int
    note: str
    error: str | None
