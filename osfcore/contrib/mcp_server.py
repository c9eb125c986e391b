"""A running service as tools of the Model Context Protocol, for assistants that speak it.

Each tool is one question to `osfcore.contrib.client.Client`. Its docstring is what an assistant reads.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, ParamSpec, TypeVar

import anyio
import numpy as np
from jaxtyping import Float32
from mcp.server import MCPServer
from mcp.server.mcpserver import Context, Image
from mcp.server.mcpserver.exceptions import ToolError
from pydantic import Field

from osfcore.contrib.client import Client, Episode, Goal, RemoteScene
from osfcore.errors import OsfError
from osfcore.io.image_file import encode_png, to_uint8
from osfcore.io.json_codec import Entry, Vector3
from osfcore.io.scene_file import ObjectJson

P = ParamSpec("P")
T = TypeVar("T")
_POLL_S = 0.5
_INSTRUCTIONS = """\
A pusher rearranges known objects on a simulated table until the table looks like a goal. Usual order: list_tables or
new_table, look, goal_from_poses or goal_from_photo, start_episode, follow_episode until it is over, look.
World frame: origin at the centre of the table, z up, table top at z = 0; objects lie within 0.22 m of the origin in x
and y. Lengths are in metres. Quaternions are (w, x, y, z). A pose maps coordinates of the object to the world."""

Table = Annotated[str | None, Field(description="Identifier of a table; none: the table that the page shows.")]
GoalId = Annotated[str, Field(description="Identifier of a goal.")]
EpisodeId = Annotated[str, Field(description="Identifier of an episode.")]
Seed = Annotated[int, Field(description="Of everything random.")]


class TableNow(Entry):
    """A table as it is now, in the world frame."""

    id: str
    time_s: float = Field(description="Simulated time since the table was made [s].")
    objects: list[ObjectJson]
    light: Vector3 = Field(description="Position of the lamp [m]; it shines toward the origin.")
    pusher: Vector3 | None = Field(description="Centre of the pusher [m].")

    @staticmethod
    def of(scene: RemoteScene) -> TableNow:
        """Take what an assistant needs of a table."""
        state = scene.state
        return TableNow(
            id=scene.id,
            time_s=scene.time_s,
            objects=[ObjectJson.of(name, state.pose(name)) for name in state.names],
            light=state.light.position.tolist(),
            pusher=None if state.pusher is None else state.pusher.tolist(),
        )


class GoalMade(Entry):
    """A goal that an episode can be started with."""

    id: str
    name: str
    problem: str = Field(description="Why the goal does not suit the table, in one sentence; empty if it does.")


class EpisodeNow(Entry):
    """An episode as it is now."""

    id: str
    status: str = Field(description="queued, running, paused, done, failed, cancelled or interrupted.")
    is_over: bool
    actions: int = Field(description="Carried out so far; each is 0.2 s of pushing.")
    most_actions: int = Field(description="That it may take.")
    doing: str
    outcome: str | None = Field(description="Why it ended, in one sentence.")
    to_goal_mm: dict[str, float] | None = Field(description="Estimated distance of each object from its goal [mm].")
    to_goal_deg: dict[str, float] | None = Field(description="Estimated angle of each object from its goal [deg].")
    files: list[str] = Field(description="That download can fetch.")

    @staticmethod
    def of(episode: Episode) -> EpisodeNow:
        """Take what an assistant needs of an episode."""
        last = episode.steps[-1] if episode.steps else None
        return EpisodeNow(
            id=episode.id,
            status=episode.status,
            is_over=episode.is_over,
            actions=episode.done,
            most_actions=episode.total,
            doing=episode.note,
            outcome=episode.error or episode.text,
            to_goal_mm=None if last is None else last.to_goal_mm,
            to_goal_deg=None if last is None else last.to_goal_deg,
            files=episode.files,
        )


class _Tools:
    """The tools; public methods become tools."""

    def __init__(self, osf: Client) -> None:
        self._osf = osf

    def list_tables(self) -> list[TableNow]:
        """List the tables and the true poses of the objects on each. The page shows one of them."""
        return [TableNow.of(scene) for scene in self._osf.scenes()]

    def list_objects(self) -> list[str]:
        """List the names of the objects that can be put on a table."""
        return list(self._osf.objects())

    def new_table(
        self,
        objects: Annotated[list[str] | None, Field(description="Names; none: some are drawn.")] = None,
        count: Annotated[int, Field(description="How many to draw, 1 to 8, where no names are given.")] = 3,
        seed: Annotated[int | None, Field(description="The same seed gives the same table; none: a new one.")] = None,
    ) -> TableNow:
        """Make a table with objects at random places, and show it on the page."""
        return TableNow.of(self._osf.new_scene(objects, count=count, seed=seed))

    def look(
        self,
        camera: Annotated[str, Field(description='"goal" looks from above, "0" to "3" from the sides.')] = "goal",
        table: Table = None,
        size: Annotated[int | None, Field(description="Side of the picture [px]; none: that of the camera.")] = None,
    ) -> Image:
        """Take a picture of a table with one of its cameras."""
        return _picture(self._osf.image(camera, table, size=size))

    def goal_from_poses(
        self,
        objects: Annotated[list[ObjectJson], Field(description="Those that shall lie elsewhere; the others stay.")],
        table: Table = None,
    ) -> GoalMade:
        """Make a goal in which objects have other poses [m, world frame]. They come to rest as if let go there."""
        return self._made(self._osf.goal_of({one.name: one.pose() for one in objects}, scene=table), table)

    def goal_from_photo(
        self,
        path: Annotated[str, Field(description="JPEG, PNG, WebP or HEIC file on this machine.")],
        table: Table = None,
    ) -> GoalMade:
        """Make a goal of a photo that shows how the table shall look, taken as the camera "goal" sees the table."""
        return self._made(self._osf.upload_goal(Path(path).expanduser()), table)

    def goal_picture(self, goal: GoalId) -> Image:
        """Show the picture of a goal."""
        return _picture(self._osf.goal_image(self._osf.goal(goal)))

    def start_episode(
        self,
        goal: GoalId,
        table: Table = None,
        actions: Annotated[int, Field(description="Most actions to take, of 0.2 s each.")] = 100,
        seed: Seed = 0,
    ) -> EpisodeNow:
        """Begin to push objects until the table looks like a goal, and return at once; follow_episode waits."""
        return EpisodeNow.of(next(self._osf.episode(self._osf.goal(goal), scene=table, seed=seed, steps=actions)))

    def list_episodes(self) -> list[EpisodeNow]:
        """List the latest episodes, newest first."""
        return [EpisodeNow.of(episode) for episode in self._osf.episodes()]

    def follow_episode(
        self,
        episode: EpisodeId,
        context: Context,
        seconds: Annotated[float, Field(ge=0, le=600, description="Longest time to wait [s]; 0 asks once.")] = 30.0,
    ) -> EpisodeNow:
        """Wait until an episode is over or the time has passed, with reports of progress, and tell how it stands."""
        end, told = time.monotonic() + seconds, -1
        while True:
            now = self._osf.latest(episode)
            if now.done != told:
                told = now.done
                anyio.from_thread.run(context.report_progress, now.done, now.total or None, now.note)
            if now.is_over or time.monotonic() >= end:
                return EpisodeNow.of(now)
            time.sleep(min(_POLL_S, max(0.0, end - time.monotonic())))

    def episode_picture(
        self,
        episode: EpisodeId,
        step: Annotated[int, Field(description="Number of the look at the table; 0 is the first.")],
    ) -> Image:
        """Show goal, table, estimate and what the cameras saw at one step of an episode, side by side."""
        return _picture(self._osf.frame(self._osf.latest(episode), step))

    def stop_episode(self, episode: EpisodeId) -> EpisodeNow:
        """Stop an episode. What was pushed stays where it is."""
        self._osf.cancel(self._osf.latest(episode))
        return EpisodeNow.of(self._osf.latest(episode))

    def download(
        self,
        episode: EpisodeId,
        file: Annotated[str, Field(description='Of the files of the episode, such as "video.mp4".')],
        folder: Annotated[str, Field(description="Folder on this machine that exists.")],
    ) -> str:
        """Write a file of an episode, such as its video or report, to this machine, and return where it is."""
        return str(self._osf.download(self._osf.latest(episode), file, Path(folder).expanduser()).absolute())

    def _made(self, goal: Goal, table: str | None) -> GoalMade:
        return GoalMade(id=goal.id, name=goal.name, problem=self._osf.goal_problem(goal, table))


def mcp_server(osf: Client, version: str) -> MCPServer:
    """Return a server that offers a service as tools.

    Args:
        osf: client of the service.
        version: of this program.
    """
    server = MCPServer("osf-manipulation", instructions=_INSTRUCTIONS, version=version, log_level="ERROR")
    tools = _Tools(osf)
    for name in vars(_Tools):
        if not name.startswith("_"):
            server.add_tool(_told(getattr(tools, name)))
    return server


def _told(tool: Callable[P, T]) -> Callable[P, T]:
    """Let errors of ours arrive as their sentence; the protocol's library keeps the words of any other to itself."""

    @wraps(tool)
    def told(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return tool(*args, **kwargs)
        except OsfError as error:
            raise ToolError(str(error)) from error

    return told


def _picture(image: Float32[np.ndarray, "h w 3"]) -> Image:
    return Image(data=encode_png(to_uint8(image)), format="png")
