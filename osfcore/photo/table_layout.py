"""Placement of a photographed layout on the simulated table: centred, and seen from the goal camera's side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, quaternion_exp, rotate
from osfcore.geometry.workspace import WORKSPACE_HALF_M
from osfcore.photo.found_scene import FoundLight, FoundScene

_LEAST_HORIZONTAL = 1e-3  # of a viewing direction: a camera that looks straight down has its image's top ahead
_LOWEST = float(np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG + 0.5)))  # of a unit vector toward a lamp


class NoPhotographedTable(OsfError):
    """A photograph in which no table was found."""

    def __init__(self) -> None:
        super().__init__(
            "The table could not be found in the photo: fewer than two of the marked objects stand on one plane. Mark "
            "another object on the table, correct the outlines, or take a photo with the printed board in view."
        )


@dataclass(frozen=True, eq=False, slots=True)
class TableLayout:
    """The contents of a photograph, placed on the simulated table.

    Attributes:
        poses: poses of the objects, by name.
        T_table_photo: pose of the photograph's table frame on the simulated table.
        T_table_camera: pose of the camera.
        light: the lamp; overhead if the photo shows no single lamp.
    """

    poses: Mapping[str, Pose]
    T_table_photo: Pose
    T_table_camera: Pose
    light: Light


def layout_of(
    found: FoundScene, choices: Mapping[str, int] | None = None, T_table_photo: Pose | None = None
) -> TableLayout:
    """Move objects, camera and lamp of a photograph onto our table.

    Args:
        found: the contents of the photograph.
        choices: index of the pose to use, by name of the object; the best pose otherwise.
        T_table_photo: pose of the photograph's table frame; None to put the objects in the middle.

    Raises:
        NoPhotographedTable: if the photograph's table is not known.
        InvalidInput: if an object lies outside the reach of the pusher.
    """
    if found.table is None:
        raise NoPhotographedTable
    camera = Pose.from_matrix(np.array(found.camera.T_world_camera))
    poses = {each.name: each.poses()[(choices or {}).get(each.name, 0)].pose() for each in found.objects}
    T = place_on_table(camera, list(poses.values())) if T_table_photo is None else T_table_photo
    placed = {name: T @ pose for name, pose in poses.items()}
    for name, pose in placed.items():
        if np.abs(pose.position[:2]).max() > WORKSPACE_HALF_M + 1e-6:
            allowed = f"within the {200 * WORKSPACE_HALF_M:.0f} cm square that the pusher reaches"
            raise InvalidInput(f"place of {name} in the photo", "too far aside", allowed)
    return TableLayout(placed, T, T @ camera, _light(found.light, T))


def _light(found: FoundLight | None, T_table_photo: Pose) -> Light:
    """Return the lamp on the simulated table, not below its least elevation; overhead if there is no single lamp."""
    if found is None or found.diffuse:
        return Light(np.array([0.0, 0.0, 1.0]))
    x, y, z = rotate(T_table_photo.quaternion, np.array(found.direction))
    z = max(float(z), _LOWEST)
    level = np.sqrt(1 - min(z, 1.0) ** 2) / max(float(np.hypot(x, y)), 1e-9)
    return Light(np.array([level * x, level * y, z]))


def place_on_table(T_photo_camera: Pose, objects: Sequence[Pose]) -> Pose:
    """Return `T_table_photo`, a turn about the vertical and a horizontal shift.

    The camera then looks along +y, as the goal camera does, and the bounding rectangle of the objects' centres has its
    middle above the table's. Photographs that share a frame (of a printed board) should share this pose, too.

    Args:
        T_photo_camera: pose of the camera in the photograph's table frame.
        objects: poses in that frame, at least one.

    Raises:
        InvalidInput: if the objects lie farther apart than the workspace is wide.
    """
    ahead = rotate(T_photo_camera.quaternion, np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
    x, y = ahead[0, :2] if np.linalg.norm(ahead[0, :2]) > _LEAST_HORIZONTAL else ahead[1, :2]
    turn = quaternion_exp(np.array([0.0, 0.0, np.pi / 2 - np.arctan2(y, x)]))
    turned = rotate(turn, np.array([pose.position for pose in objects]))[:, :2]
    low, high = turned.min(axis=0), turned.max(axis=0)
    width, extent = 2 * WORKSPACE_HALF_M, float((high - low).max())
    if extent > width:
        allowed = f"at most {100 * width:.0f} cm: the pusher reaches no farther; photograph objects that lie closer"
        raise InvalidInput("distance between the objects in the photo", f"{100 * extent:.0f} cm", allowed)
    return Pose(np.array([*-(low + high) / 2, 0.0]), turn)
