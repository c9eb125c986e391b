"""What an MCAP file tells of an episode, in Foxglove's schemas.

Topics, on a clock of simulated time that begins at 0, 0.2 s an action:

    /tf                FrameTransforms    from `world` (z up, [m]) to NAME (the truth), `estimate/NAME`, `goal/NAME`,
                                          `pusher`, `light`, and `goal_camera` (x right, y down, z forward)
    /scene             SceneUpdate        table, objects with their colours, pusher and lamp, each in its frame
    /estimate, /goal   SceneUpdate        the objects where they are thought to be, and where they should be
    /plan              SceneUpdate        the pusher's way in the best future of each plan
    /goal/image        CompressedImage    the goal, and /goal/calibration (CameraCalibration) its camera
    /frames            CompressedImage    goal, table and estimate side by side, one for each round
    /log               Log                what was noticed, and how it ended
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove import channels
from foxglove.messages import (
    CameraCalibration,
    CompressedImage,
    CubePrimitive,
    CylinderPrimitive,
    FoxgloveMessage,
    FrameTransforms,
    LogLevel,
    SceneUpdate,
    SpherePrimitive,
)
from foxglove.messages import Log as LogMessage
from PIL import Image

from app.episodes.file_names import FRAMES_FOLDER, GOAL_FILE
from app.episodes.mcap.shapes import at_origin, colour_of, entity, line, stamp, time_ns, transform, triangles, vector
from app.episodes.trajectory import Round, Trajectory
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.io.files import reading_png
from osfcore.objects.asset import TexturedMesh

_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])
_TABLE_M, _LAMP_M = 0.02, 0.05  # thickness and width that are drawn
_WOOD, _LAMP = (0.6, 0.5, 0.4, 1.0), (1.0, 0.9, 0.4, 1.0)
_THOUGHT, _WANTED, _PLANNED = (0.3, 0.6, 1.0, 0.4), (0.9, 0.7, 0.2, 0.4), (0.3, 0.6, 1.0, 1.0)


class Log:
    """A file being written: channels by topic, made when they are first written to.

    Args:
        context: of the file.
    """

    def __init__(self, context: foxglove.Context) -> None:
        self._context = context
        self._channels: dict[str, Any] = {}

    def put(self, topic: str, message: FoxgloveMessage, action: int) -> None:
        """Write a message at the time after some actions."""
        if topic not in self._channels:
            kind = getattr(channels, f"{type(message).__name__}Channel")
            self._channels[topic] = kind(topic, context=self._context)
        self._channels[topic].log(message, log_time=time_ns(action))


def log_transforms(log: Log, trajectory: Trajectory) -> None:
    """Where everything is after each action, where it was thought to be after each round, and where it should be."""
    names = trajectory.names
    fixed = [transform("goal_camera", goal_camera().T_world_camera, 0)]
    if trajectory.goal is not None:
        fixed += [transform(f"goal/{name}", trajectory.goal[n], 0) for n, name in enumerate(names)]
    log.put("/tf", FrameTransforms(transforms=fixed), 0)
    for action, state in enumerate(trajectory.states):
        here = [transform(name, state.poses[n], action) for n, name in enumerate(names)]
        here.append(transform("light", Pose(state.light.position, _NO_TURN), action))
        if state.pusher is not None:
            here.append(transform("pusher", Pose(state.pusher, _NO_TURN), action))
        log.put("/tf", FrameTransforms(transforms=here), action)
    for round_ in trajectory.rounds:
        poses, action = round_.estimate.state.poses, round_.action
        thought = [transform(f"estimate/{name}", poses[n], action) for n, name in enumerate(names)]
        log.put("/tf", FrameTransforms(transforms=thought), action)


def log_scene(log: Log, trajectory: Trajectory, meshes: Mapping[str, TexturedMesh]) -> None:
    """What everything looks like; frames tell where it is."""
    table = CubePrimitive(
        pose=at_origin(-_TABLE_M / 2), size=vector(TABLE_SIDE_M, TABLE_SIDE_M, _TABLE_M), color=colour_of(_WOOD)
    )
    hand = CylinderPrimitive(
        pose=at_origin(), size=vector(2 * PUSHER_RADIUS_M, 2 * PUSHER_RADIUS_M, PUSHER_HEIGHT_M),
        bottom_scale=1.0, top_scale=1.0, color=colour_of((*PUSHER_ALBEDO, 1.0)),
    )  # fmt: skip
    lamp = SpherePrimitive(pose=at_origin(), size=vector(_LAMP_M, _LAMP_M, _LAMP_M), color=colour_of(_LAMP))
    things = [
        entity("table", "world", cubes=[table]),
        entity("pusher", "pusher", cylinders=[hand]),
        entity("light", "light", spheres=[lamp]),
        *(entity(name, name, triangles=[triangles(mesh)]) for name, mesh in meshes.items()),
    ]
    log.put("/scene", SceneUpdate(entities=things), 0)
    ghosts = {"estimate": _THOUGHT} if trajectory.rounds else {}
    for which, colour in (ghosts if trajectory.goal is None else {**ghosts, "goal": _WANTED}).items():
        copies = [entity(n, f"{which}/{n}", triangles=[triangles(mesh, colour)]) for n, mesh in meshes.items()]
        log.put(f"/{which}", SceneUpdate(entities=copies), 0)


def log_plans(log: Log, rounds: Sequence[Round]) -> None:
    """The pusher's way in the best future of each plan, from when it was drawn: before the actions of its round."""
    before = 0
    for round_ in rounds:
        if round_.plan is not None:
            way = line(round_.plan.best.pusher[0], _PLANNED)
            log.put("/plan", SceneUpdate(entities=[entity("plan", "world", before, lines=[way])]), before)
        before = round_.action


def log_images(log: Log, folder: Path, rounds: Sequence[Round]) -> None:
    """The goal and its camera, and the frame of each round."""
    goal = folder / GOAL_FILE
    if goal.is_file():
        with reading_png(goal, "it is no image"), Image.open(goal) as image:
            camera = goal_camera().resized(*image.size)
        flat = camera.intrinsics.reshape(-1).tolist()
        projection = np.pad(camera.intrinsics, ((0, 0), (0, 1))).reshape(-1).tolist()
        calibration = CameraCalibration(
            timestamp=stamp(0), frame_id="goal_camera", width=camera.width, height=camera.height,
            K=flat, P=projection, R=np.eye(3).reshape(-1).tolist(),
        )  # fmt: skip
        log.put("/goal/calibration", calibration, 0)
        log.put("/goal/image", _image(goal, "goal_camera", 0), 0)
    for round_, path in zip(rounds, sorted((folder / FRAMES_FOLDER).glob("*.png")), strict=False):
        log.put("/frames", _image(path, "", round_.action), round_.action)


def _image(path: Path, frame: str, action: int) -> CompressedImage:
    return CompressedImage(timestamp=stamp(action), frame_id=frame, data=path.read_bytes(), format="png")


def log_words(log: Log, report: Mapping[str, Any]) -> None:
    """What was noticed, and how it ended."""
    noticed = [(LogLevel.Warning, one["text"], one["step"]) for one in report.get("noticed", ())]
    end = report.get("text") or "It was ended early."
    for level, text, action in [*noticed, (LogLevel.Info, end, report.get("steps_done", 0))]:
        log.put("/log", LogMessage(timestamp=stamp(action), level=level, message=text, name="osf"), action)
