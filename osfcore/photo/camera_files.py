"""Cameras of photographs from files: ours, and those of ROS, OpenCV, Kalibr, RealSense, FoundationPose and others.

| file                    | what it is                                                                              |
| .json                   | camera.json of `osf photo calibrate`, or a camera of scene.json                         |
| .yaml                   | ROS's camera_info, 1 or 2, as a file or as printed by `ros2 topic echo`                 |
| .json, .yaml            | what OpenCV's FileStorage writes: camera_matrix, distortion_coefficients                |
| .yaml                   | Kalibr's camchain of one pinhole camera                                                 |
| .json                   | NDDS's _camera_settings.json of one viewpoint                                           |
| .json                   | fx, fy, cx or ppx, cy or ppy and coefficients, as RealSense, Azure Kinect and BOP write |
| .json                   | K with resolution (height, width), as happypose; intrinsic_matrix by columns, as Open3D |
| .txt                    | K as 3 x 3 numbers (FoundationPose's cam_K.txt), or 3 x 4 or 4 x 4, as ScanNet writes   |

Pixel centres are at +0.5 in ours and at whole numbers in all others. Distortion is that of `osfcore.photo.lens`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from osfcore.errors import CorruptFile, InvalidInput, OsfError, check_ranges, shown
from osfcore.geometry.poses import Pose
from osfcore.io.files import read_json
from osfcore.io.json_codec import decode
from osfcore.io.scene_file import rigid_pose
from osfcore.photo.calibration import CalibrationJson, Size
from osfcore.photo.lens import Lens, lens_of
from osfcore.photo.read_photograph import content_of

_MOST_RADIAL = 2.0
_FOCAL_RANGE = 0.2, 50.0  # per longest side
_SHAPE = 0.005  # by which the ratio of a photograph's sides may differ: reduced photographs have whole pixels
_MIDDLE = 0.35, 0.65  # of the sides: where a principal point is that belongs to a photograph of this size
_MAX_BYTES = 1_000_000
_OWNER = "the camera"
_KINDS = (
    "camera.json of 'osf photo calibrate', ROS's camera_info, what OpenCV's FileStorage, Kalibr or RealSense write, or "
    "a .txt with K"
)


@dataclass(frozen=True, eq=False, slots=True)
class KnownCamera:
    """A camera that was calibrated.

    Attributes:
        size: width and height of its photographs [px]; None if the file does not say.
        lens: in these pixels.
        T_world_camera: where it stands; None if unknown.
    """

    size: Size | None
    lens: Lens
    T_world_camera: Pose | None

    def lens_at(self, size: Size) -> Lens:
        """Return the lens for photographs of this width and height [px].

        Raises:
            InvalidInput: if they have another shape, so that another camera took them, or they were cropped; or if K of
                photographs of unknown size is not of these.
        """
        if self.size is None:
            for side, centre in zip(size, self.lens.intrinsics[:2, 2].tolist(), strict=True):
                if not _MIDDLE[0] < centre / side < _MIDDLE[1]:
                    given = f"{centre:g} of {side} pixels"
                    allowed = "near the photo's middle; K must be of photos of this size, uncropped"
                    raise InvalidInput("principal point of the camera", given, allowed)
            _check_focal(self.lens, size)
            return self.lens
        scale = np.divide(size, self.size)
        if abs(scale[0] / scale[1] - 1) > _SHAPE:
            allowed = f"of the shape that the camera was calibrated with, {self.size[0]} x {self.size[1]}, uncropped"
            raise InvalidInput("size of the photo [px]", f"{size[0]} x {size[1]}", allowed)
        return self.lens.scaled(scale)


def known_camera(data: object) -> KnownCamera:
    """Return the camera of parsed JSON in our own form; cameras of scene.json are taken, too.

    Raises:
        InvalidInput: if something is missing or out of range.
    """
    entry = decode(CalibrationJson, data, "camera")
    check_ranges(("radial of the camera", entry.radial, -_MOST_RADIAL, _MOST_RADIAL))
    K = np.array(entry.K)
    if not np.array_equal(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], (0, 0, 0, 0, 1)):
        raise InvalidInput("K of the camera", K.tolist(), "[[f, 0, x], [0, f, y], [0, 0, 1]]")
    pose = None if entry.T_world_camera is None else rigid_pose(entry.T_world_camera, entry.name)
    return _checked(Lens(K, (entry.radial,)), (entry.width, entry.height), pose)


def read_camera(path: Path) -> KnownCamera:
    """Read a camera from a file in one of the forms above.

    Raises:
        CorruptFile: if it cannot be read or is no camera; the message says why.
    """
    if path.suffix.lower() == ".json":
        return read_json(path, _any_camera)
    try:
        text = content_of(path, shown(path), _MAX_BYTES).decode("utf-8-sig")
        numbers = _numbers(text)
        return _of_matrix(numbers) if numbers is not None and numbers.size else _any_camera(_parsed(text))
    except UnicodeDecodeError:
        raise CorruptFile(shown(path), f"it is no text; a camera is {_KINDS}") from None
    except CorruptFile:
        raise
    except OsfError as error:
        raise CorruptFile(shown(path), str(error).rstrip(".")) from None


def _checked(lens: Lens, size: Size | None, pose: Pose | None = None) -> KnownCamera:
    """Refuse a K that cannot be of pictures of this size."""
    if size is not None:
        _check_focal(lens, size)
        side = max(size)
        for number in (0, 1):
            check_ranges(("principal point of the camera [px]", lens.intrinsics[number, 2], -side, 2 * side))
    return KnownCamera(size, lens, pose)


def _check_focal(lens: Lens, size: Size) -> None:
    low, high = np.multiply(_FOCAL_RANGE, max(size)).tolist()
    for number in (0, 1):
        check_ranges(("focal length of the camera [px]", lens.intrinsics[number, number], low, high))


# Texts that are no JSON.


class _Loader(yaml.SafeLoader):
    """YAML with the matrices of OpenCV's FileStorage."""


def _matrix_node(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix_node)


def _parsed(text: str) -> object:
    """Return what the first document of a YAML text says; OpenCV's header is no YAML, and is left out."""
    body = text.partition("\n")[2] if text.startswith("%YAML") else text
    if body.startswith("# oST"):
        raise InvalidInput("format of the camera", "oST", "ROS's .yaml, which cameracalibrator.py writes beside it")
    if body.lstrip().startswith("<"):
        raise InvalidInput("format of the camera", "XML", f"{_KINDS}; OpenCV writes .yaml and .json, too")
    try:
        documents = yaml.load_all(body, Loader=_Loader)
        return next((document for document in documents if document is not None), None)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        where = getattr(error, "problem_mark", None)
        place = "" if where is None else f" (line {where.line + 1})"
        raise InvalidInput("format of the camera", f"neither JSON nor YAML{place}", _KINDS) from None


_BLANKS = str.maketrans(dict.fromkeys(",;[]()", " "))  # what programs write between numbers and around rows


def _numbers(text: str) -> Float[np.ndarray, "N"] | None:
    """Return the numbers of a text of nothing but numbers; None if there is anything else in it."""
    try:
        return np.array(text.translate(_BLANKS).split(), float)
    except ValueError:
        return None


def _of_matrix(numbers: Float[np.ndarray, "N"]) -> KnownCamera:
    if numbers.size in (12, 16):
        rows = numbers.reshape(-1, 4)
        if np.array_equal([*rows[:3, 3], *rows[3:].ravel()], (0, 0, 0, 0, 0, 0, 1)[: numbers.size - 9]):
            numbers = rows[:3, :3].ravel()
    if numbers.size != 9:
        raise InvalidInput("text of the camera", f"{numbers.size} numbers", "the 3 x 3 numbers of K")
    return KnownCamera(None, lens_of(numbers.reshape(3, 3), "", (), _OWNER), None)


# Cameras of other programs. Their members are known by several names, of which capitals and underscores do not count.


_MATRIX = ("cameramatrix", "k", "camk", "intrinsicmatrix", "intrinsics", "mtx", "m1")
_COEFFICIENTS = ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "d", "dist", "coeffs", "distortion", "d1")
_MODEL = ("distortionmodel", "distortiontype", "model")
_WIDTH, _HEIGHT = ("imagewidth", "width", "w"), ("imageheight", "height", "h")
_SKEW = ("skew", "s")
_SCALARS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in OpenCV's order
_LIKE_COEFFICIENTS = ("distcoef", "distortioncoef", "distortionpar")  # dist_coeff, distortion_coefs and so on


def _any_camera(data: object) -> KnownCamera:
    """Return the camera of a parsed file.

    Raises:
        InvalidInput: if it is none that is known.
    """
    if isinstance(data, Mapping) and {"name", "K", "width", "height"} <= data.keys():
        return known_camera(data)
    members = _named(data)
    chain = [name for name in members if name.startswith("cam") and name[3:].isdecimal()]
    if len(chain) > 1:
        raise InvalidInput("number of cameras in the file", len(chain), "1; keep the one that took the photo")
    if chain:
        members = _named(members[chain[0]])
    inner = members.get("intrinsics")
    if isinstance(inner, Mapping) and "data" not in inner:  # Azure Kinect
        members |= {"intrinsics": None, **_named(inner.get("parameters", inner))}
    members = _of_ndds(members)
    if str(members.get("cameramodel", "pinhole")).lower() != "pinhole":
        raise InvalidInput("camera_model of the camera", shown(members["cameramodel"]), "pinhole")
    size = _size(members)
    K, size = _cropped(_matrix(members), size, members.get("roi"))
    model = "fisheye" if members.get("fisheyemodel") else _first(members, _MODEL)
    others = tuple(name for name in members if name.startswith(_LIKE_COEFFICIENTS))
    coefficients = _first(members, (*_COEFFICIENTS, *others))
    if coefficients is None and "k1" in members:
        coefficients = [members.get(name, 0.0) for name in _SCALARS]
    values = () if coefficients is None else _array(coefficients, "distortion").ravel().tolist()
    return _checked(lens_of(K, str(model or ""), values, _OWNER), size)


def _of_ndds(members: dict[str, Any]) -> dict[str, Any]:
    """Return the members of the one viewpoint of NDDS; those that were given of all other files."""
    views = members.get("camerasettings")
    if not isinstance(views, list):
        return members
    if len(views) != 1:
        raise InvalidInput("number of cameras in the file", len(views), "1; keep the one that took the photo")
    view = _named(views[0])
    return {**_named(view.get("intrinsicsettings")), **_named(view.get("capturedimagesize"))}


def _cropped(
    K: Float[np.ndarray, "3 3"], size: Size | None, roi: object
) -> tuple[Float[np.ndarray, "3 3"], Size | None]:
    """Return K and size of the part of a sensor that ROS's region of interest (roi) says; all zeros is the whole."""
    if not isinstance(roi, Mapping):
        return K, size
    members = _named(roi)
    numbers = _array([members.get(name, 0) for name in ("xoffset", "yoffset", "width", "height")], "roi")
    if numbers.shape != (4,) or not np.all(numbers[2:]):
        return K, size
    left, top, width, height = numbers.tolist()
    return K - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]]), _size({"width": width, "height": height})


def _named(data: object) -> dict[str, Any]:
    """Return the members of an object by their names without capitals and underscores."""
    if not isinstance(data, Mapping):
        raise InvalidInput("file of the camera", shown(repr(data)), _KINDS)
    return {str(key).lower().replace("_", ""): value for key, value in data.items()}


def _first(members: Mapping[str, Any], names: tuple[str, ...]) -> Any:  # noqa: ANN401
    return next((members[name] for name in names if members.get(name) is not None), None)


def _matrix(members: Mapping[str, Any]) -> Float[np.ndarray, "3 3"]:
    """Return K, which may be a matrix, 9 numbers, or four numbers alone (Kalibr) or by name."""
    given = _first(members, _MATRIX)
    if given is None:
        four = [_first(members, names) for names in (("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy"))]
        if any(value is None for value in four):
            what = "camera_matrix, K, or fx, fy, cx and cy of the camera"
            raise InvalidInput(what, "missing", f"given; a camera is {_KINDS}")
        given = four
    numbers = _array(given, "K")
    if numbers.size == 4:
        fx, fy, x, y = numbers.ravel().tolist()
        skew = _array([_first(members, _SKEW) or 0.0], "skew")
        return np.array([[fx, skew.sum(), x], [0, fy, y], [0, 0, 1]])
    if numbers.size != 9:
        raise InvalidInput(f"K of {_OWNER}", shown(numbers.tolist()), "3 x 3 numbers")
    K = numbers.reshape(3, 3)
    return K.T if np.array_equal(K[:, 2], (0, 0, 1)) else K  # column by column, as Open3D has it


def _array(value: object, what: str) -> Float[np.ndarray, "..."]:
    """Return numbers that are a list, nested or not, or a matrix of ROS or OpenCV with its data."""
    try:
        return np.array(value["data"] if isinstance(value, Mapping) else value, float)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InvalidInput(f"{what} of {_OWNER}", shown(repr(value)), "a list of numbers") from None


def _size(members: Mapping[str, Any]) -> Size | None:
    """Return width and height of the pictures; None if the file does not say."""
    sides = [_first(members, _WIDTH), _first(members, _HEIGHT)]
    if sides == [None, None]:
        sides = _first(members, ("imagesize", "resolution"))
        if sides is None:
            return None
        if "resolution" in members and "cameramodel" not in members and isinstance(sides, list):
            sides = sides[::-1]  # height first, as happypose has it; Kalibr has width first
    numbers = _array(sides, "size").ravel()
    if numbers.size != 2 or not all(math.isfinite(n) and 1 <= n <= 1e5 and n == int(n) for n in numbers.tolist()):
        raise InvalidInput(f"size of the pictures of {_OWNER} [px]", shown(repr(sides)), "a width and a height")
    return int(numbers[0]), int(numbers[1])
