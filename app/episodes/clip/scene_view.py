"""The 3D view of a clip: the true scene by ray tracing, with what the program sees, wants and plans drawn over it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from app.episodes.trajectory import LookFrame
from app.processes.plan_summary import PlanSketch
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.image_file import to_uint8
from osfcore.world.imaging import RayTracer, TracedMesh

GOLD, CYAN, VIOLET, GREEN = (240, 172, 48), (92, 214, 226), (178, 110, 255), (76, 199, 100)
_EYE, _TARGET, _FIELD_OF_VIEW_DEG = (0.0, -1.0, 0.78), (0.0, -0.01, 0.02), 28.0
_SQUARE = 512  # of the camera from which the view's is made; its sides may differ and be larger
_PART = 1000  # width at most that a camera may have [px]
_BACKDROP = np.array([0.072, 0.078, 0.086], np.float32)
_SMALLER = 4  # outlines of estimates are found in images this much smaller
_GHOST, _HIDDEN_M = 0.42, 0.002
_PLAN_Z_M = 0.012  # above the table, at which ways of the pusher are drawn
_MOST_DOTS = 60  # candidates drawn of each object


@dataclass(frozen=True, eq=False, slots=True)
class _Ghost:
    """Golden copies of the objects where they should be."""

    rgb: Float[np.ndarray, "h w 3"]
    share: Float[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]


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
        self._ghost: _Ghost | None = None
        self._outlines: list[np.ndarray] = []
        self._depth = np.zeros((height, width), np.float32)

    def show_goal(self, names: tuple[str, ...], goal: Pose, moved: np.ndarray, light: Light) -> None:
        """From now on golden copies of the objects that are to move stand where they should be."""
        chosen = [name for name, is_moved in zip(names, moved, strict=True) if is_moved]
        if not chosen:
            return
        poses = Pose(goal.position[moved], goal.quaternion[moved])
        rgb, coverage, depth = self._trace(SceneState(tuple(chosen), poses, light, None), self._parts, 2)
        self._ghost = _Ghost(rgb, coverage.max(axis=0), depth)
        self._outlines = [contour for share in coverage for contour in _contours(share)]

    def scene(self, state: SceneState) -> UInt8[np.ndarray, "h w 3"]:
        """The scene, with golden copies where they are visible."""
        rgb, _, depth = self._trace(state, self._parts, 2)
        rgb[~np.isfinite(depth)] = _BACKDROP
        if self._ghost is not None:
            seen = np.where(self._ghost.depth < depth - _HIDDEN_M, _GHOST * self._ghost.share, 0)[..., None]
            glow = 0.35 + 0.65 * self._ghost.rgb.mean(axis=-1, keepdims=True)
            rgb = (1 - seen) * rgb + seen * glow * np.array(GOLD, np.float32) / 255
        image = to_uint8(rgb)
        cv2.polylines(image, self._outlines, isClosed=True, color=GOLD, thickness=2, lineType=cv2.LINE_AA)
        return image

    def with_look(self, image: UInt8[np.ndarray, "h w 3"], look: LookFrame) -> UInt8[np.ndarray, "h w 3"]:
        """The image with the estimator at work: candidates as dots, its best guess as outlines."""
        colour = CYAN if look.look == "first" else GOLD
        dots = image.copy()
        for position in look.candidates.position[:_MOST_DOTS].reshape(-1, 3):
            self._dot(dots, position, colour)
        image = cv2.addWeighted(dots, 0.55, image, 0.45, 0)
        state = replace(look.state, pusher=None)
        _, coverage, _ = self._trace(state, self._small, 3)
        shares = [cv2.resize(share, self._size, interpolation=cv2.INTER_CUBIC) for share in coverage]
        outlines = [contour for share in shares for contour in _contours(share)]
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

    def _dot(self, image: np.ndarray, position: np.ndarray, colour: tuple[int, int, int]) -> None:
        x, y = self._projected(np.asarray(position, float)[None])[0]
        if np.isfinite([x, y]).all() and abs(x) < 1e4 and abs(y) < 1e4:
            cv2.circle(image, (round(x), round(y)), 4, colour, -1, cv2.LINE_AA)

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


def _contours(share: Float[np.ndarray, "h w"]) -> list[np.ndarray]:
    found = cv2.findContours((share > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    return [contour for contour in found if len(contour) > 12]
