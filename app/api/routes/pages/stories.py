"""Stories: recorded episodes that come with the program, to be watched before anything is run."""

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from app.api.routes import problems
from app.services.examples.stories import Stories

_ORDER = ("three", "other-light", "low-sun", "four", "pair", "first")
router = APIRouter(prefix="/api/stories", tags=["stories"], responses=problems())


class StoryOut(BaseModel):
    """A recorded episode of an example."""

    model_config = ConfigDict(extra="ignore")

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


@router.get("", responses=problems(409))
def list_all() -> StoryList:
    """List the stories, in the order in which the page plays them."""
    stories = Stories()
    told = [stories.told(name) for name in stories.names()]
    told.sort(key=lambda story: _ORDER.index(story["name"]) if story["name"] in _ORDER else len(_ORDER))
    return StoryList(stories=[StoryOut.model_validate({**story, **_pictures(story["name"])}) for story in told])


def _pictures(name: str) -> dict[str, str]:
    return {f"{part}_image": f"stories/{name}/{part}.webp" for part in ("goal", "now")}
