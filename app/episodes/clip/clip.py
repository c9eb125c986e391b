"""Making a clip of an episode from its trajectory: 1920 x 1080, H.264, a quarter of a minute at most."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from app.episodes.clip.layout import HEIGHT, SIDE, VIEW, WIDTH, Layout, closing_card, length_text
from app.episodes.clip.scene_view import SceneView
from app.episodes.file_names import GOAL_FILE, REPORT_FILE, TRAJECTORY_FILE
from app.episodes.replay_clock import Moment, ReplayClock
from app.episodes.trajectory import Trajectory, read_trajectory
from osfcore.errors import CannotWrite, OsfError
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.files import as_mapping, file_at_once, read_json, reading_png
from osfcore.io.image_file import to_uint8
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.imaging import RayTracer, TracedMesh

FPS = 30
LONGEST_S, CARD_S, PAUSE_S = 12.0, 2.5, 0.6
_MOVED_M = 0.01  # objects that need not go so far have no golden copy
_DRAWN_EVERY = 2  # frames: the scene is traced so often while something moves


class NoClip(OsfError):
    """An episode of which there is nothing to show."""

    def __init__(self) -> None:
        super().__init__("There is nothing to make a clip of: it has pushed nothing, or an earlier version ran it.")


@dataclass(frozen=True, slots=True)
class ClipFacts:
    """What the closing card tells that the trajectory does not.

    Attributes:
        is_reached: whether the goal was.
        verdict: how it ended, a sentence.
        seconds: that it took; None if unknown.
        far_m: distance of the farthest object from its goal after each action, as the report has it [m]; by the
            trajectory and its goal if None.
    """

    is_reached: bool
    verdict: str
    seconds: float | None = None
    far_m: Float[np.ndarray, "A"] | None = None

    @staticmethod
    def of_report(report: Mapping[str, Any], actions: int) -> ClipFacts:
        """What a report tells of an episode of so many actions; distances between its steps are interpolated."""
        steps = report.get("steps", ())
        offsets = [step.get("truly_to_goal_mm") or step.get("to_goal_mm") for step in steps]
        far_m = None
        if offsets and all(offsets):
            far_mm = [max(of.values()) for of in offsets]
            far_m = np.interp(np.arange(actions + 1), [step["step"] for step in steps], far_mm) / 1000
        verdict = str(report.get("text") or "It was ended early.")
        return ClipFacts(report.get("outcome") == "reached", verdict, report.get("seconds"), far_m)


@dataclass(frozen=True, slots=True)
class ClipStep:
    """How far a clip is: frames drawn, of all."""

    done: int
    total: int
    note: str = "Drawing the clip"


def clip_of(folder: Path, library: AssetLibrary, path: Path, executor: Executor | None = None) -> Iterator[ClipStep]:
    """Make a clip of what an episode has left in its folder.

    Args:
        folder: with `report.json`, `trajectory.npz`, and `goal.png` if the goal was an image.
        library: meshes of the objects.
        path: an MP4.
        executor: traces side by side, if given.

    Raises:
        NoClip: if the episode has pushed nothing, or an earlier version ran it.
        CorruptFile, UnknownName, MissingAssets: if something in the folder is damaged, or an object is not here.
        CannotWrite: if it cannot be encoded or written.
    """
    if not (folder / TRAJECTORY_FILE).is_file() or not (folder / REPORT_FILE).is_file():
        raise NoClip
    trajectory, report = read_trajectory(folder / TRAJECTORY_FILE), read_json(folder / REPORT_FILE, as_mapping)
    if len(trajectory.states) < 2 or trajectory.goal is None:
        raise NoClip
    meshes = {name: TracedMesh(library.load(name).mesh) for name in trajectory.names}
    photo = folder / GOAL_FILE
    goal = _photo(photo) if photo.is_file() else _rendered(trajectory, meshes)
    facts = ClipFacts.of_report(report, len(trajectory.states) - 1)
    yield from write_clip(path, trajectory, goal, meshes, facts, executor)


def _photo(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    with reading_png(path, "it is no image"), Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def _rendered(trajectory: Trajectory, meshes: Mapping[str, TracedMesh]) -> UInt8[np.ndarray, "h w 3"]:
    """What the goal camera would see of a goal that was given as poses."""
    assert trajectory.goal is not None
    state = SceneState(trajectory.names, trajectory.goal, trajectory.states[0].light, None)
    return to_uint8(RayTracer(meshes).render(state, (goal_camera(SIDE),))[0].rgb)


def write_clip(
    path: Path,
    trajectory: Trajectory,
    goal: UInt8[np.ndarray, "h w 3"],
    meshes: Mapping[str, TracedMesh],
    facts: ClipFacts,
    executor: Executor | None = None,
) -> Iterator[ClipStep]:
    """Draw and encode a clip; the file appears only when it is whole.

    Args:
        path: an MP4.
        trajectory: of an episode that is over, with its goal.
        goal: how the table should look.
        meshes: of the objects.
        facts: for the closing card.
        executor: traces side by side, if given.

    Raises:
        CannotWrite: if it cannot be encoded or written.
    """
    film = _Film(trajectory, goal, meshes, facts, executor)
    with file_at_once(path) as partial:
        encoder = imageio_ffmpeg.write_frames(
            str(partial), (WIDTH, HEIGHT), fps=FPS, codec="libx264", macro_block_size=2, ffmpeg_log_level="error",
            output_params=["-crf", "20", "-preset", "veryfast", "-movflags", "+faststart", "-f", "mp4"],
        )  # fmt: skip
        try:
            encoder.send(None)
            for number, frame in enumerate(film.frames()):
                encoder.send(np.ascontiguousarray(frame))
                yield ClipStep(number + 1, film.count)
        except OSError as error:
            raise CannotWrite(path, error.strerror or "it could not be encoded") from error
        finally:
            encoder.close()


class _Film:
    """The frames of one clip."""

    def __init__(
        self,
        trajectory: Trajectory,
        goal: np.ndarray,
        meshes: Mapping[str, TracedMesh],
        facts: ClipFacts,
        executor: Executor | None,
    ) -> None:
        self._trajectory, self._facts = trajectory, facts
        self._clock = ReplayClock(trajectory)
        self._speed = max(1.0, self._clock.length_s / LONGEST_S)
        self._view = SceneView(meshes, *VIEW[2:], executor)
        self._goal_view = RayTracer(meshes)
        self._layout = Layout(goal, self._far_m())
        self._drawn: tuple[float, bool, np.ndarray, np.ndarray] | None = None
        self._shows_goal = False

    @property
    def count(self) -> int:
        """Of the frames."""
        return self._played + round(FPS * (PAUSE_S + CARD_S))

    @property
    def _played(self) -> int:
        return max(round(FPS * self._clock.length_s / self._speed), 1)

    def frames(self) -> Iterator[UInt8[np.ndarray, "1080 1920 3"]]:
        """All of them."""
        frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for number in range(self._played):
            frame = self._frame(self._clock.moment(number / FPS * self._speed), number)
            yield frame
        frame = self._frame(self._clock.moment(self._clock.length_s), 0)
        yield from [frame] * round(FPS * PAUSE_S)
        facts = self._facts
        card = closing_card(frame, self._headline(), self._details(), facts.verdict, is_reached=facts.is_reached)
        for number in range(round(FPS * CARD_S)):
            share = min((number + 1) / (0.4 * FPS), 1.0)
            yield card if share == 1 else ((1 - share) * frame + share * card).astype(np.uint8)

    def _frame(self, moment: Moment, number: int) -> np.ndarray:
        if moment.look is None and not self._shows_goal and self._trajectory.goal is not None:
            self._shows_goal = True
            start = self._trajectory.states[0]
            moved = self._distances(start.poses) > _MOVED_M
            self._view.show_goal(start.names, self._trajectory.goal, moved, start.light)
        scene, now = self._scene(moment, number)
        if moment.look is not None:
            view, stage = self._view.with_look(scene, moment.look), _LOOKING[moment.look.look]
        elif moment.plan is not None and moment.plan.plan is not None:
            view, stage = self._view.with_plan(scene, moment.plan.plan), "Planning, and pushing"
        else:
            view, stage = scene, "There" if self._facts.is_reached else "Out of pushes"
        return self._layout.frame(view, now, stage, moment.action)

    def _scene(self, moment: Moment, number: int) -> tuple[np.ndarray, np.ndarray]:
        """The 3D view and the goal camera's; traced again only where something has moved, and not for every frame."""
        key = moment.action, self._shows_goal
        if self._drawn is None or (key != self._drawn[:2] and (number % _DRAWN_EVERY == 0 or key[1] != self._drawn[1])):
            state = self._trajectory.state_at(moment.action)
            now = self._goal_view.render(state, (goal_camera(SIDE),), samples=2)[0].rgb
            self._drawn = *key, self._view.scene(state), to_uint8(now)
        return self._drawn[2], self._drawn[3]

    def _distances(self, poses: Pose) -> Float[np.ndarray, "N"]:
        goal = self._trajectory.goal
        if goal is None:
            return np.zeros(len(poses.position))
        return np.linalg.norm((poses.position - goal.position)[:, :2], axis=1)

    def _far_m(self) -> Float[np.ndarray, "A"]:
        if self._facts.far_m is not None:
            return self._facts.far_m
        return np.array([self._distances(state.poses).max(initial=0.0) for state in self._trajectory.states])

    def _headline(self) -> str:
        far = self._far_m()
        return f"{length_text(far[0])} to {length_text(far[-1])}"

    def _details(self) -> str:
        count = len(self._trajectory.states) - 1
        parts = [f"{count} {'push' if count == 1 else 'pushes'}"]
        if self._facts.seconds is not None:
            parts.append(f"{self._facts.seconds:.0f} s")
        if self._trajectory.rounds:
            found = self._trajectory.rounds[0].estimate.state.light.direction
            cosine = float(np.clip(found @ self._trajectory.states[0].light.direction, -1, 1))
            parts.append(f"light found to {np.rad2deg(np.arccos(cosine)):.1f}°")
        return ", ".join(parts)


_LOOKING = {"first": "Looking: where is everything, and where is the lamp?", "goal": "Reading the photo"}
