"""camera.json: a calibrated camera as a file.

    {"name", "T_world_camera": 4x4 | null, "K": 3x3, "width", "height", "radial", "focal_std_px", "corner_std_px",
     "expected_error_mm": {"mean", "worst"}, "reprojection_px": {photo: rms}}

A camera as in scene.json, of photographs without distortion; `radial` is k1 of `osfcore.photo.lens`, which straightens
them. Pixels are those of the photographs as they were sent.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat

from osfcore.errors import InvalidInput, check_ranges
from osfcore.geometry.poses import Pose
from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, Matrix3, Matrix4, Text, decode, encode
from osfcore.photo.calibration.calibrate import Calibration
from osfcore.photo.lens import Lens

_MOST_RADIAL = 2.0
_FOCAL_RANGE = 0.2, 50.0  # per longest side
_SHAPE = 0.005  # by which the ratio of a photograph's sides may differ: reduced photographs have whole pixels


class ExpectedError(Entry):
    """How far from its place a point of the table's workspace may be located."""

    mean: FiniteFloat = Field(description="[mm]")
    worst: FiniteFloat = Field(description="[mm]")


class CalibrationJson(Entry):
    """A calibrated camera."""

    name: Text
    T_world_camera: Matrix4 | None = Field(None, description="Maps camera coordinates to world coordinates [m].")
    K: Matrix3 = Field(description="Intrinsics [px], of photos without distortion.")
    width: int = Field(ge=1, description="[px]")
    height: int = Field(ge=1, description="[px]")
    radial: FiniteFloat = Field(0.0, description="k1 of the lens.")
    focal_std_px: FiniteFloat | None = Field(None, description="Standard deviation of the focal length.")
    corner_std_px: FiniteFloat | None = Field(None, description="By which corners of the board scatter.")
    expected_error_mm: ExpectedError | None = None
    reprojection_px: dict[Text, FiniteFloat] = Field({}, description="By photo, root mean square.")


@dataclass(frozen=True, eq=False, slots=True)
class KnownCamera:
    """A camera that was calibrated.

    Attributes:
        size: width and height of its photographs [px].
        lens: in these pixels.
        T_world_camera: where it stands; None if it was not told.
    """

    size: tuple[int, int]
    lens: Lens
    T_world_camera: Pose | None

    def lens_at(self, size: tuple[int, int]) -> Lens:
        """The lens for photographs of this width and height [px].

        Raises:
            InvalidInput: if they have another shape, so that another camera took them, or they were cropped.
        """
        scale = np.divide(size, self.size)
        if abs(scale[0] / scale[1] - 1) > _SHAPE:
            allowed = f"of the shape that the camera was calibrated with, {self.size[0]} x {self.size[1]}, uncropped"
            raise InvalidInput("size of the photo [px]", f"{size[0]} x {size[1]}", allowed)
        K = self.lens.intrinsics * np.array([[scale[0]], [scale[1]], [1.0]])
        return Lens(K, self.lens.radial)


def calibration_to_json(found: Calibration, name: str) -> dict[str, Any]:
    """A calibration as plain lists and numbers."""
    pose = None if found.T_world_camera is None else found.T_world_camera.matrix().tolist()
    is_seen = found.table.seen_share > 0
    error = ExpectedError(mean=1e3 * found.table.mean_m, worst=1e3 * found.table.worst_m) if is_seen else None
    return encode(
        CalibrationJson(
            name=name,
            T_world_camera=pose,
            K=found.lens.intrinsics.tolist(),
            width=found.size[0],
            height=found.size[1],
            radial=found.lens.radial,
            focal_std_px=found.focal_std_px,
            corner_std_px=found.noise_px,
            expected_error_mm=error,
            reprojection_px=dict(found.rms_px),
        )
    )


def known_camera(data: object) -> KnownCamera:
    """The camera of parsed JSON; cameras of scene.json are taken, too.

    Raises:
        InvalidInput: if something is missing or out of range.
    """
    entry = decode(CalibrationJson, data, "camera")
    check_ranges(("radial of the camera", entry.radial, -_MOST_RADIAL, _MOST_RADIAL))
    K = _checked(np.array(entry.K), max(entry.width, entry.height))
    pose = None if entry.T_world_camera is None else _rigid(np.array(entry.T_world_camera))
    return KnownCamera((entry.width, entry.height), Lens(K, entry.radial), pose)


def read_camera(path: Path) -> KnownCamera:
    """The camera in a file.

    Raises:
        CorruptFile: if it cannot be read or is no camera; the message says why.
    """
    return read_json(path, known_camera)


def _checked(K: Float[np.ndarray, "3 3"], side: int) -> Float[np.ndarray, "3 3"]:
    if not np.array_equal(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], (0, 0, 0, 0, 1)):
        raise InvalidInput("K of the camera", K.tolist(), "[[f, 0, x], [0, f, y], [0, 0, 1]]")
    low, high = np.multiply(_FOCAL_RANGE, side).tolist()
    for number in (0, 1):
        check_ranges(("focal length of the camera [px]", K[number, number], low, high))
        check_ranges(("principal point of the camera [px]", K[number, 2], -side, 2 * side))
    return K


def _rigid(matrix: Float[np.ndarray, "4 4"]) -> Pose:
    R = matrix[:3, :3]
    if (
        not np.allclose(R @ R.T, np.eye(3), atol=1e-4)
        or np.linalg.det(R) < 0
        or not np.allclose(matrix[3], (0, 0, 0, 1))
    ):
        raise InvalidInput("T_world_camera of the camera", matrix.tolist(), "a rotation and a translation, 4 x 4")
    return Pose.from_matrix(matrix)
