"""Requests and responses that concern episodes and their settings."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, Field

from app.api.schemas.common import Input, Seed
from app.api.schemas.goals import Poses, SceneRef
from app.api.schemas.limits import GOAL_NAME, HORIZON, NAME, SAMPLES, STEPS, TEMPERATURE, sized, within
from app.api.schemas.paging import JobPageOut
from app.jobs.job import Job, State
from app.jobs.kinds.episodes import method_of
from app.services.episodes import AskedEpisode, defaults, flat
from osfcore.control.events import CostKind, EpisodeSettings, Matter
from osfcore.paper.method import METHODS, Method


def _between(bounds: tuple[float, float], text: str) -> Any:  # noqa: ANN401  what pydantic's Field returns
    return Field(None, **within(bounds), description=text)


class SettingsIn(Input):
    """What shall be other than by default, or than before."""

    method: Method | None = Field(
        None,
        description='"ours", or "paper": as published, which is slower and knows no goal poses; chosen before an '
        "episode, with a cost of images, a plan for each action, and no changes on the way.",
    )
    steps: int | None = _between(STEPS, "Actions at most, of 0.2 s each, counted anew after each disturbance.")
    replan_every: int | None = _between(STEPS, "Actions executed of each plan.")
    cost: CostKind | None = Field(
        None, description='"pose" compares futures with where things are in the goal image, "image" rendered pixels.'
    )
    samples: int | None = _between(SAMPLES, "Sequences of actions in each round of a plan.")
    horizon: int | None = _between(HORIZON, "Actions in each.")
    temperature: float | None = _between(TEMPERATURE, "Of the softmax, as a share of the spread of costs.")
    planning: bool | None = Field(None, description="Draw plans; where not, the last plan is followed to its end.")
    acting: bool | None = Field(None, description="Execute plans; where not, the table is only watched.")
    despite_doubts: bool | None = Field(None, description="Go on with a goal image that is not explained well.")

    def given(self) -> dict[str, Any]:
        """Those that were."""
        return self.model_dump(exclude_none=True)


class EpisodeIn(Input):
    """An episode: give either goal or poses."""

    scene: SceneRef
    goal: str | None = Field(None, **sized(NAME), description="Identifier of a goal image.")
    poses: Poses | None = Field(None, description="Where all objects shall be.")
    seed: Seed = 0
    settings: SettingsIn = SettingsIn()  # pyright: ignore[reportCallIssue]

    def asked(self) -> AskedEpisode:
        """What the service's own modules take."""
        poses = None if self.poses is None else tuple(entry.named_pose() for entry in self.poses)
        settings = self.settings.given()
        method: Method = settings.pop("method", "ours")
        return AskedEpisode(self.scene, self.goal, poses, self.seed, settings, method)


class SettingsOut(BaseModel):
    """How an episode goes."""

    method: Method
    steps: int
    replan_every: int
    cost: CostKind
    samples: int
    horizon: int
    temperature: float
    planning: bool
    acting: bool
    despite_doubts: bool


Bounds = Annotated[list[float], Field(min_length=2, max_length=2, description="Least and most.")]


class SettingBounds(BaseModel):
    """Which numbers are allowed."""

    steps: Bounds
    replan_every: Bounds
    samples: Bounds
    horizon: Bounds
    temperature: Bounds


class EpisodeSettingsOut(BaseModel):
    """Defaults and bounds of an episode's settings."""

    defaults: SettingsOut
    published: SettingsOut = Field(description="Defaults of the method as published.")
    reached_mm: float = Field(description="Objects as near as this to their goals, as estimated, have arrived [mm].")
    reached_deg: float = Field(description="Likewise for how they are turned [deg].")
    bounds: SettingBounds


class ServiceSettings(BaseModel):
    """What can be set, and what it is where nothing is said."""

    episode: EpisodeSettingsOut

    @staticmethod
    def now() -> ServiceSettings:
        """Of this version."""
        bounds = SettingBounds(
            steps=list(STEPS),
            replan_every=list(STEPS),
            samples=list(SAMPLES),
            horizon=list(HORIZON),
            temperature=list(TEMPERATURE),
        )
        ours, published = (SettingsOut(method=method, **defaults(method)) for method in METHODS)
        rule = EpisodeSettings()
        reached_mm, reached_deg = 1000 * rule.reached_m, math.degrees(rule.reached_rad)
        return ServiceSettings(
            episode=EpisodeSettingsOut(
                defaults=ours, published=published, reached_mm=reached_mm, reached_deg=reached_deg, bounds=bounds
            )
        )


class RenameIn(Input):
    """What to call an episode."""

    name: str = Field(**sized(GOAL_NAME), description="For people.")


class NoticeOut(BaseModel):
    """Something that was noticed on the way."""

    step: int
    matter: str = Field(description=f"One of {', '.join(get_args(Matter))}.")
    text: str


class EpisodeStepOut(BaseModel):
    """One round of the loop, or how it was before the first."""

    step: int = Field(description="Actions executed so far.")
    seconds: dict[str, float] = Field(description='Spent on "first", "goal", "estimate", "plan" and "act" [s].')
    image_cost: float = Field(description="Mean squared difference of goal image and rendered estimate.")
    ssim: float | None = Field(
        None, description="Their structural similarity, 1 for equal images; null in episodes of earlier versions."
    )
    to_goal_mm: dict[str, float] | None = Field(
        description="Of each object, as estimated [mm]; null where the method looks at images alone."
    )
    to_goal_deg: dict[str, float] | None = Field(description="Likewise [deg].")
    estimate_off_mm: dict[str, float] = Field(description="Simulation only: errors of the estimate [mm].")
    light_off_deg: float | None = Field(
        None, description="Simulation only: error of the estimated light [deg]; null in episodes of earlier versions."
    )
    truly_to_goal_mm: dict[str, float] | None = Field(
        None, description="Simulation only: true distances [mm]; null where nobody knows the truth of the goal."
    )


class EpisodeOut(BaseModel):
    """An episode as it is now."""

    id: str
    name: str = Field(description="For people.")
    scene: str
    goal: str | None = Field(description="Identifier of the goal image; null where poses were given.")
    objects: list[str]
    seed: int
    settings: SettingsOut
    status: State
    position: int | None = Field(description="Place in the queue, 1 is next; null when not queued.")
    done: int = Field(description="Actions executed.")
    total: int = Field(description="Actions at most.")
    stage: Literal["first", "goal", "plan", "act", "next", "search"] | None
    note: str
    eta_s: float | None = Field(description="Estimated time left [s].")
    created_at: str
    started_at: str | None
    finished_at: str | None
    error: str | None
    outcome: Literal["reached", "out of steps", "refused"] | None
    text: str | None = Field(description="The outcome in a sentence.")
    notices: list[NoticeOut]
    seconds: float | None = Field(description="Spent so far, without pauses [s]; null before the first look.")
    steps: list[EpisodeStepOut]
    step_s: list[float] = Field(description="When each step is over in the episode's replay, see /api/views [s].")
    files: list[str] = Field(description="Names to download from /api/episodes/{id}/files/{name}.")

    @staticmethod
    def of_job(
        job: Job, name: str, settings: EpisodeSettings, report: dict[str, Any] | None, files: tuple[str, ...]
    ) -> EpisodeOut:
        """From the registry's job and what it has written so far.

        Args:
            job: of the kind "episode".
            name: for people.
            settings: as they are now.
            report: what report.json holds; None before there is one, or where steps are not asked for.
            files: names that can be downloaded.
        """
        report, result = report or {}, job.result or {}
        return EpisodeOut(
            id=job.id,
            name=name,
            scene=job.params["scene"],
            goal=job.params["goal"]["id"],
            objects=job.params["names"],
            seed=job.params["seed"],
            settings=SettingsOut(method=method_of(job.params), **flat(settings)),
            status=job.state,
            position=job.position,
            done=job.done,
            total=job.total,
            stage=result.get("stage"),
            note=job.note,
            eta_s=(job.result or {}).get("left_s") if job.state == "running" else None,
            created_at=job.created_at,
            started_at=job.started_at,
            finished_at=job.finished_at,
            error=job.error,
            outcome=result.get("outcome"),
            text=result.get("text"),
            notices=[NoticeOut(**notice) for notice in report.get("noticed", ())],
            seconds=report.get("seconds", result.get("seconds")),
            steps=[EpisodeStepOut.model_validate(step) for step in report.get("steps", ())],
            step_s=report.get("step_s", []),
            files=list(files),
        )


class EpisodeList(JobPageOut):
    """Episodes, newest first, without their steps."""

    episodes: list[EpisodeOut]
