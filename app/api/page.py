"""What the page needs, more than programs do: who drives, what its 3D view shows, examples to begin with."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query
from pydantic import BaseModel, Field

from osfcore.errors import InvalidInput

from ..jobs.params import Identifier
from ..services.examples import PRESETS, Stories, preset, set_up
from ..storage.paths import static_folder
from ..viewer.page_views import Replay, Shows, Wish
from .bodies import BoundedRoute
from .dependencies import Services, ServicesDep, slow
from .goals import GoalOut
from .models import Input, Visitor
from .problems import named_in_path, problems
from .scenes import SceneOut, scene_out

driver_router = APIRouter(prefix="/api/driver", tags=["driver"], responses=problems(), route_class=BoundedRoute)


class DriverIn(Input):
    """A page that wants to drive."""

    visitor: Visitor = Field(description="What a page calls itself.")


class DriverOut(BaseModel):
    """Who drives, and among how many."""

    driver: str | None = Field(description="What the page calls itself; null while no page is open.")
    visitors: int


@driver_router.get("")
async def get(services: ServicesDep) -> DriverOut:
    """Return who drives."""
    return DriverOut.model_validate(services.driver.now(), from_attributes=True)


@driver_router.post("")
def take(services: ServicesDep, body: DriverIn) -> DriverOut:
    """Let a page drive from now on; programs are never asked who they are."""
    return DriverOut.model_validate(services.driver.take(body.visitor), from_attributes=True)


views_router = APIRouter(prefix="/api/views", tags=["views"], responses=problems(), route_class=BoundedRoute)
VisitorPath = Annotated[Visitor, Path(description="What the page calls itself.")]


Share = Annotated[float, Query(ge=0, le=1, description="Share of the view, from its left or its top.")]


class ReplayIn(Input):
    """A recorded course on view in place of the live table: give either an episode or a story."""

    episode: Identifier | None = Field(None, description="Identifier of an episode, perhaps of one that runs.")
    story: Identifier | None = Field(None, description="Name of a recording that comes with the program.")
    at_s: float = Field(0.0, ge=0, le=86_400, description="The moment to show [s].")
    plays: bool = Field(False, description="Whether it goes on from there by itself.")
    speed: float = Field(1.0, ge=0.1, le=16, description="Of going on; 1 is real time.")

    def replay(self, services: Services) -> Replay:
        """What the view takes."""
        if (self.episode is None) == (self.story is None):
            raise InvalidInput("replay", "neither or both", "an episode or a story")
        if self.episode is not None:
            path = services.episodes.trajectory(services.episodes.get(self.episode))
        else:
            path = Stories().trajectory(self.story or "")
        return Replay(path, self.at_s, self.plays, self.speed)


class ViewIn(Input):
    """What a page wants to see."""

    replay: ReplayIn | None = Field(None, description="Null for the live table.")
    shows: Shows = Field(
        "meshes",
        description='Things as scanned meshes, as their neural "fields" render them, or only the "beliefs" about them.',
    )

    goal: str | None = Field(None, description="Goal whose objects are drawn in gold on the live table, if known.")
    handles: bool = Field(False, description="Whether objects have handles to lift and turn them.")


class ViewOut(BaseModel):
    """How a page's view is."""

    is_open: bool = Field(description="Whether a browser shows it now; if not, it will begin with what was asked for.")


@views_router.put("/{visitor}", responses=problems(404, 409))
def show(services: ServicesDep, visitor: VisitorPath, body: ViewIn) -> ViewOut:
    """Show an episode in the 3D view of one page, at `viewer/{visitor}/`, or the live table again."""
    with named_in_path():
        replay = None if body.replay is None else body.replay.replay(services)
        goal = None if body.goal is None else services.goals.get(body.goal)
    return ViewOut(is_open=services.viewer.pages.ask(visitor, Wish(replay, body.shows, goal, body.handles)))


@views_router.post("/{visitor}/camera", status_code=204)
def frame(services: ServicesDep, visitor: VisitorPath) -> None:
    """Place the camera of one page's 3D view anew, so that the objects fill it."""
    services.viewer.pages.frame(visitor)


class PointedOut(BaseModel):
    """What is at a place in a view."""

    name: str | None = Field(description='Of an object, "pusher", "lamp", or null for nothing of these.')


@views_router.get("/{visitor}/pointed")
def pointed(services: ServicesDep, visitor: VisitorPath, x: Share, y: Share) -> PointedOut:
    """Name what stands at a place in one page's 3D view."""
    return PointedOut(name=services.viewer.pages.pointed_at(visitor, x, y))


presets_router = APIRouter(prefix="/api/presets", tags=["presets"], responses=problems(), route_class=BoundedRoute)


class PresetOut(BaseModel):
    """A table and its goal."""

    id: str
    title: str
    text: str
    objects: int
    missing: list[str] = Field(description="Objects that are not on this machine or have no field yet.")
    image: str | None = Field(description="Path of a picture, below the page's own.")


class PresetList(BaseModel):
    """All of them, easiest first."""

    presets: list[PresetOut]


class PresetMade(BaseModel):
    """What a preset has made."""

    scene: SceneOut
    goal: GoalOut


@presets_router.get("", name="list_all")
def list_presets(services: ServicesDep) -> PresetList:
    """List tables to begin with."""
    usable = set(services.objects.names()) & set(services.fields.names())
    return PresetList(
        presets=[
            PresetOut(
                id=one.id,
                title=one.title,
                text=one.text,
                objects=len(one.objects),
                missing=[name for name in one.objects if name not in usable],
                image=_image(one.id),
            )
            for one in PRESETS
        ]
    )


@presets_router.post("/{preset_id}", status_code=201, responses=problems(404, 409, 503, 507))
@slow
def make(services: ServicesDep, preset_id: str = Path(description="Identifier of a preset.")) -> PresetMade:
    """Make a preset's scene, which is then shown, and its goal image."""
    with named_in_path():
        chosen = preset(preset_id)
    scene, goal = set_up(chosen, services.runner, services.goals)
    return PresetMade(scene=scene_out(services, scene), goal=GoalOut.of(goal))


def _image(name: str) -> str | None:
    path = f"presets/{name}.webp"
    return path if (static_folder() / path).is_file() else None


_ORDER = ("three", "other-light", "low-sun", "four", "pair", "first")
stories_router = APIRouter(prefix="/api/stories", tags=["stories"], responses=problems())


class StoryOut(BaseModel):
    """A recorded episode of an example."""

    name: str = Field(description="Of the story, and of the example at /api/presets.")
    title: str
    text: str
    objects: list[str]
    moved: list[str] = Field(description="Objects that were in the wrong place.")
    goal_look_s: float = Field(description="When in its replay the goal image is looked at [s].")
    step_s: list[float] = Field(description="When in its replay each step is over [s].")
    left_mm: list[dict[str, float]] = Field(description="True distance of each object from its goal, after each step.")
    pushes: int
    took_s: float = Field(description="How long the episode took when it was recorded [s].")
    light_off_deg: float = Field(description="Error of the first estimate of the light [deg].")
    outcome: Literal["reached", "out of steps", "refused"]
    goal_image: str = Field(description="Path of the goal image, below the page's own.")
    now_image: str = Field(description="Likewise of what the goal camera saw after each step: squares, row by row.")
    now_columns: int = Field(description="Pictures in each row of it.")


class StoryList(BaseModel):
    """All of them."""

    stories: list[StoryOut]


@stories_router.get("", name="list_all", responses=problems(409))
def list_stories() -> StoryList:
    """List the stories, in the order in which the page plays them."""
    stories = Stories()
    listed = [stories.shown(name) for name in stories.names()]
    listed.sort(key=lambda story: _ORDER.index(story["name"]) if story["name"] in _ORDER else len(_ORDER))
    return StoryList(stories=[StoryOut.model_validate({**story, **_pictures(story["name"])}) for story in listed])


def _pictures(name: str) -> dict[str, str]:
    return {f"{part}_image": f"stories/{name}/{part}.webp" for part in ("goal", "now")}
