"""An estimator at work, as outlines over the pictures that it looks at: the best scene so far, and what it tries."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from osfcore.control.events import Looking
from osfcore.errors import OsfError
from osfcore.estimation.steps import UNPLACED_BELOW_M, EstimateStep
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.poses import Pose
from osfcore.objects.asset_library import AssetLibrary

TRIED = 6  # candidates of each object that are outlined
_UNKNOWN_M = 0.05
Polygon = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class ObjectOutlines:
    """An object in one picture; coordinates are shares of its width and height.

    Attributes:
        name: of the object.
        best: outline of the convex hull where it is taken to be.
        tried: the same of some candidates.
    """

    name: str
    best: Polygon
    tried: tuple[Polygon, ...]


@dataclass(frozen=True, slots=True)
class LookOutlines:
    """An estimator at one moment.

    Attributes:
        look: "first", "goal", "next" or "search".
        share: of the work that is done.
        loss: of the whole, in units of its stage; None where there is none.
        difference: of the rendered scene from the images, see `Looking`; None until there is one.
        stage: of the method; losses of one stage can be compared.
        is_over: whether this is the result.
        light_deg: azimuth from +x toward +y, and elevation, of the light so far.
        cameras: outlines of each object by camera; "goal" is the goal image.
    """

    look: str
    share: float
    loss: float | None
    difference: float | None
    stage: str
    is_over: bool
    light_deg: tuple[float, float]
    cameras: dict[str, tuple[ObjectOutlines, ...]]


class Outliner:
    """Outlines objects; keeps the hulls of those that it has met.

    Args:
        library: meshes of the objects.
    """

    def __init__(self, library: AssetLibrary) -> None:
        self._library = library
        self._hulls: dict[str, Float[np.ndarray, "P 3"]] = {}

    def outlines(self, looking: Looking) -> LookOutlines:
        """What a step of an estimator looks like over its pictures."""
        step = looking.step
        cameras = (goal_camera(),) if looking.look == "goal" else default_cameras()
        x, y, z = step.state.light.position
        return LookOutlines(
            looking.look,
            min(step.progress.done / max(step.progress.total, 1), 1.0),
            float(step.loss) if np.isfinite(step.loss) else None,
            looking.difference if np.isfinite(looking.difference) else None,
            step.stage,
            step.estimate is not None,
            (float(np.rad2deg(np.arctan2(y, x))), float(np.rad2deg(np.arcsin(np.clip(z, -1, 1))))),
            {
                camera.name: tuple(self._of_object(camera, step, number) for number in range(len(step.state.names)))
                for camera in cameras
            },
        )

    def _of_object(self, camera: Camera, step: EstimateStep, number: int) -> ObjectOutlines:
        name, candidates = step.state.names[number], step.candidates
        tried: list[Polygon] = []
        if candidates is not None:
            rows = np.unique(np.linspace(0, len(candidates.position) - 1, TRIED).astype(int))
            tried = [self._outline(camera, name, candidates[row, number]) for row in rows]
        best = self._outline(camera, name, step.state.poses[number])
        return ObjectOutlines(name, best, tuple(polygon for polygon in tried if polygon))

    def _outline(self, camera: Camera, name: str, pose: Pose) -> Polygon:
        """Empty for what was not looked at yet, or lies behind the camera."""
        corners = pose.apply(self._hull(name))
        if pose.position[2] < UNPLACED_BELOW_M or camera.T_world_camera.inverse().apply(corners)[:, 2].min() < 1e-3:
            return ()
        pixels = camera.project(corners) / (camera.width, camera.height)
        outline = cv2.convexHull(pixels.astype(np.float32))[:, 0]
        return tuple((round(float(x), 4), round(float(y), 4)) for x, y in outline)

    def _hull(self, name: str) -> Float[np.ndarray, "P 3"]:
        if name not in self._hulls:
            try:
                parts = np.concatenate(self._library.load_geometry(name).parts).astype(float)
                self._hulls[name] = parts[ConvexHull(parts).vertices]
            except (OsfError, QhullError):  # recognised by its field, but its mesh is not on this machine, or not yet
                signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
                return _UNKNOWN_M / 2 * signs
        return self._hulls[name]
