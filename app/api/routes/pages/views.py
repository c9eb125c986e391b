"""What the 3D view shows in one page: the live table, or an episode, as it is scrubbed and played there."""

from typing import Annotated

from fastapi import APIRouter, Path
from pydantic import BaseModel, Field

from app.api.bodies import BoundedRoute
from app.api.dependencies import Services, ServicesDep
from app.api.problems import named_in_path
from app.api.routes import problems
from app.api.schemas.common import Input
from app.api.schemas.limits import NAME, REPLAY_S, REPLAY_SPEED, VISITOR, sized, within
from app.services.examples.stories import Stories
from app.viewer.page_views import Replay, Shows, Wish
from osfcore.errors import InvalidInput

router = APIRouter(prefix="/api/views", tags=["views"], responses=problems(), route_class=BoundedRoute)
Visitor = Annotated[str, Path(**sized(NAME), pattern=f"^{VISITOR}$", description="What the page calls itself.")]


class ReplayIn(Input):
    """A recorded course on view in place of the live table: give either an episode or a story."""

    episode: str | None = Field(None, **sized(NAME), description="Identifier of an episode, perhaps of one that runs.")
    story: str | None = Field(None, **sized(NAME), description="Name of a recording that comes with the program.")
    at_s: float = Field(0.0, **within(REPLAY_S), description="The moment to show [s].")
    plays: bool = Field(False, description="Whether it goes on from there by itself.")
    speed: float = Field(1.0, **within(REPLAY_SPEED), description="Of going on; 1 is real time.")

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


class ViewOut(BaseModel):
    """How a page's view is."""

    is_open: bool = Field(description="Whether a browser shows it now; if not, it will begin with what was asked for.")


@router.put("/{visitor}", responses=problems(404, 409))
def show(services: ServicesDep, visitor: Visitor, body: ViewIn) -> ViewOut:
    """Show an episode in the 3D view of one page, at `viewer/{visitor}/`, or the live table again."""
    with named_in_path():
        replay = None if body.replay is None else body.replay.replay(services)
    return ViewOut(is_open=services.viewer.pages.ask(visitor, Wish(replay, body.shows)))
