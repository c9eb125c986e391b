"""Episodes as MCAP files, for Foxglove, Lichtblick, and whatever else reads MCAP.

Topics, on a clock of simulated time that begins at 0, 0.2 s an action:

    /tf                FrameTransforms    from `world` (z up, [m]) to NAME (the truth), `estimate/NAME`, `goal/NAME`,
                                          `pusher`, `light`, and `goal_camera` (x right, y down, z forward)
    /scene             SceneUpdate        table, objects with their colours, pusher and lamp, each in its frame
    /estimate, /goal   SceneUpdate        the objects where they are thought to be, and where they should be
    /plan              SceneUpdate        the pusher's way in the best future of each plan
    /goal/image        CompressedImage    the goal, and /goal/calibration (CameraCalibration) its camera
    /frames            CompressedImage    goal, table and estimate side by side, one for each round
    /log               Log                what was noticed, and how it ended

Foxglove's quaternions are (x, y, z, w), its colours RGBA in [0, 1].

Raises:
    MissingExtra: on import, if what writes MCAP is not installed.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from osfcore.extras import need
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M, STEP_S, TABLE_SIDE_M
from osfcore.io.files import reading_png, write_atomically
from osfcore.objects.asset import TexturedMesh
from osfcore.objects.asset_library import AssetLibrary

from .file_names import FRAMES_FOLDER, GOAL_FILE
from .record import read_episode
from .trajectory import Round, Trajectory

need("mcap", "An MCAP file")
import foxglove  # noqa: E402
from foxglove import channels, messages  # noqa: E402

Rgba = tuple[float, float, float, float]
_NANOSECONDS = 1_000_000_000
_LINE_PX = 2.0


def time_ns(action: int) -> int:
    """Simulated time after some actions [ns]."""
    return round(action * STEP_S * _NANOSECONDS)


def stamp(action: int) -> messages.Timestamp:
    """The same as messages have it."""
    return messages.Timestamp(*divmod(time_ns(action), _NANOSECONDS))


def transform(child: str, pose: Pose, action: int) -> messages.FrameTransform:
    """`T_world_child`, after some actions."""
    w, x, y, z = pose.quaternion.tolist()
    return messages.FrameTransform(
        timestamp=stamp(action), parent_frame_id="world", child_frame_id=child,
        translation=vector(*pose.position.tolist()), rotation=messages.Quaternion(x=x, y=y, z=z, w=w),
    )  # fmt: skip


def entity(name: str, frame: str, action: int = 0, **primitives: Any) -> messages.SceneEntity:  # noqa: ANN401  lists of theirs
    """Shapes that move with a frame, from after some actions on."""
    return messages.SceneEntity(id=name, frame_id=frame, frame_locked=True, timestamp=stamp(action), **primitives)


def triangles(mesh: TexturedMesh, colour: Rgba | None = None) -> messages.TriangleListPrimitive:
    """A mesh in its own frame, in one colour or in those that its texture has at the vertices.

    Triangles rather than embedded glTF, of which viewers disagree which axis is up.
    """
    points, indices = _points(mesh.vertices), mesh.faces.reshape(-1).tolist()
    if colour is not None:
        return messages.TriangleListPrimitive(pose=at_origin(), points=points, indices=indices, color=colour_of(colour))
    height, width = mesh.texture.shape[:2]
    columns = (mesh.uv[:, 0] * (width - 1)).round().astype(int)
    rows = ((1 - mesh.uv[:, 1]) * (height - 1)).round().astype(int)
    colours = [colour_of((r, g, b, 1.0)) for r, g, b in (mesh.texture[rows, columns] / 255).tolist()]
    return messages.TriangleListPrimitive(pose=at_origin(), points=points, indices=indices, colors=colours)


def at_origin(height_m: float = 0.0) -> messages.Pose:
    """A pose at the frame's origin, or above it."""
    unturned = messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    return messages.Pose(position=vector(0.0, 0.0, height_m), orientation=unturned)


def vector(x: float, y: float, z: float) -> messages.Vector3:
    """A vector, or sizes along the axes."""
    return messages.Vector3(x=x, y=y, z=z)


def colour_of(rgba: Rgba) -> messages.Color:
    """A colour."""
    r, g, b, a = rgba
    return messages.Color(r=r, g=g, b=b, a=a)


def _points(positions: Float[np.ndarray, "P 3"]) -> list[messages.Point3]:
    return [messages.Point3(x=x, y=y, z=z) for x, y, z in positions.tolist()]


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

    def put(self, topic: str, message: messages.FoxgloveMessage, action: int) -> None:
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
    log.put("/tf", messages.FrameTransforms(transforms=fixed), 0)
    for action, state in enumerate(trajectory.states):
        here = [transform(name, state.poses[n], action) for n, name in enumerate(names)]
        here.append(transform("light", Pose(state.light.position, _NO_TURN), action))
        if state.pusher is not None:
            here.append(transform("pusher", Pose(state.pusher, _NO_TURN), action))
        log.put("/tf", messages.FrameTransforms(transforms=here), action)
    for round_ in trajectory.rounds:
        poses, action = round_.estimate.state.poses, round_.action
        thought = [transform(f"estimate/{name}", poses[n], action) for n, name in enumerate(names)]
        log.put("/tf", messages.FrameTransforms(transforms=thought), action)


def log_scene(log: Log, trajectory: Trajectory, meshes: Mapping[str, TexturedMesh]) -> None:
    """What everything looks like; frames say where it is."""
    table = messages.CubePrimitive(
        pose=at_origin(-_TABLE_M / 2), size=vector(TABLE_SIDE_M, TABLE_SIDE_M, _TABLE_M), color=colour_of(_WOOD)
    )
    hand = messages.CylinderPrimitive(
        pose=at_origin(), size=vector(2 * PUSHER_RADIUS_M, 2 * PUSHER_RADIUS_M, PUSHER_HEIGHT_M),
        bottom_scale=1.0, top_scale=1.0, color=colour_of((*PUSHER_ALBEDO, 1.0)),
    )  # fmt: skip
    lamp = messages.SpherePrimitive(pose=at_origin(), size=vector(_LAMP_M, _LAMP_M, _LAMP_M), color=colour_of(_LAMP))
    things = [
        entity("table", "world", cubes=[table]),
        entity("pusher", "pusher", cylinders=[hand]),
        entity("light", "light", spheres=[lamp]),
        *(entity(name, name, triangles=[triangles(mesh)]) for name, mesh in meshes.items()),
    ]
    log.put("/scene", messages.SceneUpdate(entities=things), 0)
    ghosts = {"estimate": _THOUGHT} if trajectory.rounds else {}
    if trajectory.goal is not None:
        ghosts["goal"] = _WANTED
    for which, colour in ghosts.items():
        copies = [entity(n, f"{which}/{n}", triangles=[triangles(mesh, colour)]) for n, mesh in meshes.items()]
        log.put(f"/{which}", messages.SceneUpdate(entities=copies), 0)


def log_plans(log: Log, rounds: Sequence[Round]) -> None:
    """The pusher's way in the best future of each plan, from when it was drawn: before the actions of its round."""
    before = 0
    for round_ in rounds:
        if round_.plan is not None:
            way = messages.LinePrimitive(
                type=messages.LinePrimitiveLineType.LineStrip, pose=at_origin(), color=colour_of(_PLANNED),
                points=_points(round_.plan.best.pusher[0]), thickness=_LINE_PX, scale_invariant=True,
            )  # fmt: skip
            log.put("/plan", messages.SceneUpdate(entities=[entity("plan", "world", before, lines=[way])]), before)
        before = round_.action


def log_images(log: Log, folder: Path, rounds: Sequence[Round]) -> None:
    """The goal and its camera, and the frame of each round."""
    goal = folder / GOAL_FILE
    if goal.is_file():
        with reading_png(goal, "it is no image"), Image.open(goal) as image:
            camera = goal_camera().resized(*image.size)
        flat = camera.intrinsics.reshape(-1).tolist()
        projection = np.pad(camera.intrinsics, ((0, 0), (0, 1))).reshape(-1).tolist()
        calibration = messages.CameraCalibration(
            timestamp=stamp(0), frame_id="goal_camera", width=camera.width, height=camera.height,
            K=flat, P=projection, R=np.eye(3).reshape(-1).tolist(),
        )  # fmt: skip
        log.put("/goal/calibration", calibration, 0)
        log.put("/goal/image", _image(goal, "goal_camera", 0), 0)
    for round_, path in zip(rounds, sorted((folder / FRAMES_FOLDER).glob("*.png")), strict=False):
        log.put("/frames", _image(path, "", round_.action), round_.action)


def _image(path: Path, frame: str, action: int) -> messages.CompressedImage:
    return messages.CompressedImage(timestamp=stamp(action), frame_id=frame, data=path.read_bytes(), format="png")


def log_words(log: Log, report: Mapping[str, Any]) -> None:
    """What was noticed, and how it ended."""
    noticed = [(messages.LogLevel.Warning, one["text"], one["step"]) for one in report.get("noticed", ())]
    end = report.get("text") or "It was ended early."
    for level, text, action in [*noticed, (messages.LogLevel.Info, end, report.get("steps_done", 0))]:
        log.put("/log", messages.Log(timestamp=stamp(action), level=level, message=text, name="osf"), action)


def write_mcap(folder: Path, library: AssetLibrary, path: Path) -> float:
    """Write what an episode has left in its folder as one file; it appears only when it is whole.

    Args:
        folder: with `report.json`, `trajectory.npz`, `frames/`, and `goal.png` if the goal was an image.
        library: meshes of the objects.
        path: an MCAP file, which is replaced.

    Returns:
        How long the episode is in simulated time [s].

    Raises:
        NoEpisode: if there is none.
        CorruptFile, UnknownName, MissingAssets: if something in the folder is damaged, or an object is not here.
        CannotWrite: if the disk refuses.
    """
    episode = read_episode(folder)
    trajectory = episode.trajectory
    meshes = {name: library.load(name).mesh for name in trajectory.names}
    context, data = foxglove.Context(), io.BytesIO()
    with foxglove.open_mcap(data, context=context):
        log = Log(context)
        log_scene(log, trajectory, meshes)
        log_transforms(log, trajectory)
        log_plans(log, trajectory.rounds)
        log_images(log, folder, trajectory.rounds)
        log_words(log, episode.report)
    write_atomically(path, data.getvalue())
    return STEP_S * (len(trajectory.states) - 1)
