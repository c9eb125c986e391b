"""Clips of episodes for people to share: 1920 x 1080, H.264, a quarter of a minute at most."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from osfcore.errors import OsfError
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.files import as_mapping, read_json, reading_png
from osfcore.io.image_file import to_uint8
from osfcore.io.video_file import mp4_at_once
from osfcore.objects.asset_library import AssetLibrary
from osfcore.planning.mppi import PlanSketch
from osfcore.world.imaging import RayTracer, TracedMesh

from .file_names import GOAL_FILE, REPORT_FILE, TRAJECTORY_FILE
from .trajectory import LookFrame, Moment, ReplayClock, Trajectory, read_trajectory

WIDTH, HEIGHT = 1920, 1080
VIEW = (40, 128, 1396, 700)  # left, top, width, height [px]
SIDE = 412  # of the two pictures
_GOAL, _NOW = (1468, 160), (1468, 628)
_CURVE = (40, 852, 1396, 188)
_PLOT = (180, 884, 1080, 122)  # within it
_GROUND, _PANEL = (19, 21, 23), (27, 30, 33)
_TEXT, _MUTED = (233, 231, 226), (155, 162, 169)
_ACCENT, _WARM = (99, 184, 194), (240, 172, 48)
TITLE = "Show a photo, and the table becomes it"
SUBTITLE = "Object-centric neural scattering functions: poses and light from images alone"


class Layout:
    """Frames of one clip.

    Args:
        goal: how the table should look.
        far_m: distance of the farthest object from its goal after each action [m].
    """

    def __init__(self, goal: UInt8[np.ndarray, "h w 3"], far_m: Float[np.ndarray, "A"]) -> None:
        self._far_m = far_m
        self._still = self._background(goal)

    def frame(
        self, view: UInt8[np.ndarray, "h w 3"], now: UInt8[np.ndarray, "s s 3"], stage: str, action: float
    ) -> UInt8[np.ndarray, "1080 1920 3"]:
        """One frame.

        Args:
            view: the 3D view.
            now: the table as the goal's camera sees it.
            stage: what is being done.
            action: how many have been executed; between two whole numbers one is under way.
        """
        frame = self._still.copy()
        _put(frame, view, VIEW[:2])
        _put(frame, _sized(now), _NOW)
        self._draw_curve(frame, action)
        picture = Image.fromarray(frame)
        draw = ImageDraw.Draw(picture)
        left, top, _, height = VIEW
        box = draw.textbbox((left + 28, top + height - 52), stage, _font(28))
        draw.rounded_rectangle((box[0] - 16, box[1] - 12, box[2] + 16, box[3] + 12), 12, fill=(0, 0, 0))
        draw.text((left + 28, top + height - 52), stage, _TEXT, _font(28))
        far = np.interp(action, np.arange(len(self._far_m)), self._far_m)
        draw.text((1405, 930), length_text(far), _TEXT, _font(52), anchor="rm")
        draw.text((1405, 982), "to go", _MUTED, _font(24), anchor="rm")
        return np.asarray(picture)

    def _background(self, goal: np.ndarray) -> UInt8[np.ndarray, "1080 1920 3"]:
        picture = Image.new("RGB", (WIDTH, HEIGHT), _GROUND)
        draw = ImageDraw.Draw(picture)
        draw.text((40, 76), TITLE, _TEXT, _font(46), anchor="lm")
        draw.text((1880, 79), SUBTITLE, _MUTED, _font(24), anchor="rm")
        for (x, y), caption in ((_GOAL, "The photo"), (_NOW, "The table, from the same place")):
            draw.text((x, y - 10), caption, _MUTED, _font(24), anchor="ls")
        left, top, width, height = _CURVE
        draw.rounded_rectangle((left, top, left + width, top + height), 12, fill=_PANEL)
        draw.text((left + 24, 912), "Farthest", _MUTED, _font(24), anchor="lm")
        draw.text((left + 24, 944), "object", _MUTED, _font(24), anchor="lm")
        x, y, w, h = _PLOT
        draw.line((x, y + h, x + w, y + h), fill=(60, 66, 72), width=2)
        draw.text((x, y + h + 18), "0", _MUTED, _font(18), anchor="mm")
        draw.text((x + w, y + h + 18), f"{len(self._far_m) - 1} pushes", _MUTED, _font(18), anchor="mm")
        frame = np.asarray(picture).copy()
        _put(frame, _sized(goal), _GOAL)
        return frame

    def _draw_curve(self, frame: np.ndarray, action: float) -> None:
        x, y, w, h = _PLOT
        last, top = max(len(self._far_m) - 1, 1), max(self._far_m.max(), 1e-3)
        at = np.append(np.arange(np.floor(action) + 1), action)
        values = np.interp(at, np.arange(len(self._far_m)), self._far_m)
        points = np.column_stack([x + w * at / last, y + h * (1 - values / top)])
        sixteenths = np.round(points * 16).astype(np.int32)
        area = np.concatenate([points, [[points[-1, 0], y + h], [x, y + h]]]).round().astype(np.int32)
        filled = frame.copy()
        cv2.fillPoly(filled, [area], _ACCENT, cv2.LINE_AA)
        cv2.addWeighted(filled, 0.18, frame, 0.82, 0, dst=frame)
        cv2.polylines(frame, [sixteenths], False, _ACCENT, 4, cv2.LINE_AA, shift=4)
        cv2.circle(frame, tuple(points[-1].round().astype(int)), 8, _TEXT, -1, cv2.LINE_AA)


def closing_card(
    last: UInt8[np.ndarray, "1080 1920 3"], headline: str, details: str, verdict: str, *, is_reached: bool
) -> UInt8[np.ndarray, "1080 1920 3"]:
    """The last frame, dark, with what it came to.

    Args:
        last: frame of the clip.
        headline: such as "9.3 cm to 2 mm".
        details: such as "18 pushes, 95 s".
        verdict: how it ended, a sentence.
        is_reached: whether that is good news.
    """
    dimmed = cv2.GaussianBlur(last, (0, 0), 9)
    picture = Image.fromarray((dimmed * 0.28).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    middle = WIDTH // 2
    draw.text((middle, 430), headline, _TEXT, _font(130), anchor="mm")
    draw.text((middle, 560), details, _TEXT, _font(46), anchor="mm")
    draw.text((middle, 650), verdict, _ACCENT if is_reached else _WARM, _font(38), anchor="mm")
    draw.text((middle, 1000), SUBTITLE, _MUTED, _font(26), anchor="mm")
    return np.asarray(picture)


def length_text(metres: float) -> str:
    """A distance for people."""
    return f"{1000 * metres:.1f} mm" if metres < 0.01 else f"{100 * metres:.1f} cm"


def _put(frame: np.ndarray, part: np.ndarray, corner: tuple[int, int]) -> None:
    x, y = corner
    frame[y : y + part.shape[0], x : x + part.shape[1]] = part


def _sized(picture: np.ndarray) -> UInt8[np.ndarray, "s s 3"]:
    """A picture as a square; what is not square keeps its proportions on the panel's colour."""
    height, width = picture.shape[:2]
    scale = SIDE / max(height, width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    square = np.full((SIDE, SIDE, 3), _PANEL, np.uint8)
    _put(square, fitted, ((SIDE - size[0]) // 2, (SIDE - size[1]) // 2))
    return square


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


# The 3D view of a clip: the true scene by ray tracing, with what the program sees, wants and plans drawn over it.


GOLD, CYAN, VIOLET, GREEN = (240, 172, 48), (92, 214, 226), (178, 110, 255), (76, 199, 100)
_EYE, _TARGET, _FIELD_OF_VIEW_DEG = (0.0, -1.0, 0.78), (0.0, -0.01, 0.02), 28.0
_SQUARE = 512  # of the camera from which the view's is made; its sides may differ and be larger
_PART = 1000  # width at most that a camera may have [px]
_BACKDROP = np.array([0.072, 0.078, 0.086], np.float32)
_SMALLER = 4  # outlines of estimates are found in images this much smaller
_GHOST, _HIDDEN_M = 0.42, 0.002
_PLAN_Z_M = 0.012  # above the table, at which ways of the pusher are drawn
_MOST_DOTS = 60  # candidates drawn of each object


class SceneView:
    """Draws one episode from one place.

    Args:
        meshes: of its objects.
        width: of the view [px].
        height: of the view [px].
        executor: traces the parts of the view side by side, if given.
    """

    def __init__(
        self, meshes: Mapping[str, TracedMesh], width: int, height: int, executor: Executor | None = None
    ) -> None:
        self._tracer = RayTracer(meshes, executor=executor)
        self._size = width, height
        self._parts = _cameras(width, height)
        self._small = _cameras(width // _SMALLER, height // _SMALLER)
        self._copies: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # golden ones: rgb, coverage, depth
        self._outlines: list[np.ndarray] = []

    def show_goal(self, names: tuple[str, ...], goal: Pose, moved: np.ndarray, light: Light) -> None:
        """From now on golden copies of the objects that are to move stand where they should be."""
        chosen = [name for name, is_moved in zip(names, moved, strict=True) if is_moved]
        if not chosen:
            return
        poses = Pose(goal.position[moved], goal.quaternion[moved])
        rgb, coverage, depth = self._trace(SceneState(tuple(chosen), poses, light, None), self._parts, 2)
        self._copies = rgb, coverage.max(axis=0), depth
        self._outlines = _contours(coverage)

    def scene(self, state: SceneState) -> UInt8[np.ndarray, "h w 3"]:
        """The scene, with golden copies where they are visible."""
        rgb, _, depth = self._trace(state, self._parts, 2)
        rgb[~np.isfinite(depth)] = _BACKDROP
        if self._copies is not None:
            copies_rgb, share, copies_depth = self._copies
            seen = np.where(copies_depth < depth - _HIDDEN_M, _GHOST * share, 0)[..., None]
            glow = 0.35 + 0.65 * copies_rgb.mean(axis=-1, keepdims=True)
            rgb = (1 - seen) * rgb + seen * glow * np.array(GOLD, np.float32) / 255
        image = to_uint8(rgb)
        cv2.polylines(image, self._outlines, isClosed=True, color=GOLD, thickness=2, lineType=cv2.LINE_AA)
        return image

    def with_look(self, image: UInt8[np.ndarray, "h w 3"], look: LookFrame) -> UInt8[np.ndarray, "h w 3"]:
        """The image with the estimator at work: candidates as dots, its best guess as outlines."""
        colour = CYAN if look.look == "first" else GOLD
        dots = image.copy()
        for x, y in self._projected(look.candidates.position[:_MOST_DOTS].reshape(-1, 3)):
            if abs(x) < 1e4 and abs(y) < 1e4:  # also false for NaN
                cv2.circle(dots, (round(x), round(y)), 4, colour, -1, cv2.LINE_AA)
        image = cv2.addWeighted(dots, 0.55, image, 0.45, 0)
        _, coverage, _ = self._trace(replace(look.state, pusher=None), self._small, 3)
        outlines = _contours([cv2.resize(share, self._size, interpolation=cv2.INTER_CUBIC) for share in coverage])
        cv2.polylines(image, outlines, isClosed=True, color=colour, thickness=2, lineType=cv2.LINE_AA)
        return image

    def with_plan(self, image: UInt8[np.ndarray, "h w 3"], plan: PlanSketch) -> UInt8[np.ndarray, "h w 3"]:
        """The image with ways of the pusher, cheap ones green, and the best one in violet."""
        ways = image.copy()
        ranks = np.linspace(0, 1, max(len(plan.ways), 2))
        for way, rank in reversed(list(zip(plan.ways, ranks, strict=False))):
            shade = tuple(int((1 - rank) * g + rank * 120) for g in GREEN)
            self._line(ways, way, shade, 2)
        image = cv2.addWeighted(ways, 0.6, image, 0.4, 0)
        self._line(image, plan.best.pusher[0][:, :2], VIOLET, 4)
        return image

    def _line(self, image: np.ndarray, way: np.ndarray, colour: tuple[int, ...], thickness: int) -> None:
        points = self._projected(np.column_stack([way, np.full(len(way), _PLAN_Z_M)]))
        sixteenths = np.round(np.clip(points, -1e4, 1e4) * 16).astype(np.int32)  # of a pixel
        cv2.polylines(image, [sixteenths], False, colour, thickness, cv2.LINE_AA, shift=4)

    def _projected(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
        return self._parts[0].project(points)  # the first part begins at the view's left border

    def _trace(
        self, state: SceneState, cameras: tuple[Camera, ...], samples: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pictures = self._tracer.render(state, cameras, samples=samples)
        return (
            np.concatenate([picture.rgb for picture in pictures], axis=1),
            np.concatenate([picture.coverage for picture in pictures], axis=2),
            np.concatenate([picture.depth for picture in pictures], axis=1),
        )


def _cameras(width: int, height: int) -> tuple[Camera, ...]:
    """Cameras side by side that together see the view: one may not be as wide as it is."""
    square = Camera.look_at("clip", _EYE, _TARGET, size=_SQUARE, fov_y_deg=_FIELD_OF_VIEW_DEG)
    focal = square.intrinsics[0, 0] * height / _SQUARE
    count = -(-width // _PART)
    edges = np.linspace(0, width, count + 1).round().astype(int)
    cameras = []
    for left, right in itertools.pairwise(edges):
        K = np.array([[focal, 0, width / 2 - left], [0, focal, height / 2], [0, 0, 1.0]])
        cameras.append(replace(square, intrinsics=K, width=int(right - left), height=height))
    return tuple(cameras)


def _contours(coverage: Iterable[Float[np.ndarray, "h w"]]) -> list[np.ndarray]:
    """Outlines of objects, each given by the share of every pixel that it covers."""
    masks = [(share > 0.5).astype(np.uint8) for share in coverage]
    found = [cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0] for mask in masks]
    return [contour for contours in found for contour in contours if len(contour) > 12]


# The film, from the trajectory of an episode


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
    """What the closing card shows that the trajectory does not.

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
        """Return what a report has of an episode of so many actions; distances between its steps are interpolated."""
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
    if photo.is_file():
        with reading_png(photo, "it is no image"), Image.open(photo) as image:
            goal = np.asarray(image.convert("RGB"))
    else:  # it was given as poses: what the goal camera would see of them
        wanted = SceneState(trajectory.names, trajectory.goal, trajectory.states[0].light, None)
        goal = to_uint8(RayTracer(meshes).render(wanted, (goal_camera(SIDE),))[0].rgb)
    facts = ClipFacts.of_report(report, len(trajectory.states) - 1)
    yield from write_clip(path, trajectory, goal, meshes, facts, executor)


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
    with mp4_at_once(path, WIDTH, HEIGHT, FPS, "-crf", "20", "-preset", "veryfast") as put:
        for number, frame in enumerate(film.frames()):
            put(frame)
            yield ClipStep(number + 1, film.count)


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
        assert trajectory.goal is not None, "without one there is no clip"
        self._trajectory, self._goal, self._facts = trajectory, trajectory.goal, facts
        self._clock = ReplayClock(trajectory)
        self._speed = max(1.0, self._clock.length_s / LONGEST_S)
        self._played = max(round(FPS * self._clock.length_s / self._speed), 1)
        self.count = self._played + round(FPS * (PAUSE_S + CARD_S))
        self._view = SceneView(meshes, *VIEW[2:], executor)
        self._goal_view = RayTracer(meshes)
        far_m = facts.far_m
        if far_m is None:
            far_m = np.array([self._distances(state).max(initial=0.0) for state in trajectory.states])
        self._far_m, self._layout = far_m, Layout(goal, far_m)
        self._drawn: tuple[float, bool, np.ndarray, np.ndarray] | None = None
        self._shows_goal = False

    def frames(self) -> Iterator[UInt8[np.ndarray, "1080 1920 3"]]:
        """All of them."""
        for number in range(self._played):
            yield self._frame(self._clock.moment(number / FPS * self._speed), number)
        frame = self._frame(self._clock.moment(self._clock.length_s), 0)
        yield from [frame] * round(FPS * PAUSE_S)
        facts, headline = self._facts, f"{length_text(self._far_m[0])} to {length_text(self._far_m[-1])}"
        card = closing_card(frame, headline, self._details(), facts.verdict, is_reached=facts.is_reached)
        for number in range(round(FPS * CARD_S)):
            share = min((number + 1) / (0.4 * FPS), 1.0)
            yield card if share == 1 else ((1 - share) * frame + share * card).astype(np.uint8)

    def _frame(self, moment: Moment, number: int) -> np.ndarray:
        if moment.look is None and not self._shows_goal:
            self._shows_goal = True
            start = self._trajectory.states[0]
            self._view.show_goal(start.names, self._goal, self._distances(start) > _MOVED_M, start.light)
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

    def _distances(self, state: SceneState) -> Float[np.ndarray, "N"]:
        return np.linalg.norm((state.poses.position - self._goal.position)[:, :2], axis=1)

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
