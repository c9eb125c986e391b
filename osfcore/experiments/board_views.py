"""Synthetic photographs of a printed board, and how far the camera that is found in them is from the true one.

A view is drawn in linear light with 3 x 3 samples a pixel: the print on a table of a random colour, blurred and lit
unevenly; it is then encoded as sRGB, gets noise and is stored as JPEG, as a camera would do.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_exp, rotation_angle
from osfcore.io.image_file import to_uint8
from osfcore.photo.board import Board, BoardView, locate_board, locate_board_through_lens, page_image

_DISTANCES_M = (0.4, 1.0)
_ELEVATIONS_DEG = (25.0, 80.0)
_ROLLS_DEG = (-15.0, 15.0)
_FIELDS_OF_VIEW_DEG = (50.0, 65.0)  # horizontal
_TARGET_M = 0.05  # by which the camera's axis may miss the print's centre, along x and y
_NEARBY_M = 0.2  # around the print's centre
_SAMPLES = 3
_PAGE_STEP = 2000  # [pixels per m]; in multiples of it the default board's edges fall between pixels
_REFLECTANCES = (0.04, 0.85)  # of ink and paper
_BLUR_PX = 0.7
_NOISE = 0.02
_JPEG_QUALITY = 80
_NEWTON_STEPS = 6


@dataclass(frozen=True, eq=False, slots=True)
class Photograph:
    """A synthetic photograph and the truth about it.

    Attributes:
        image: RGB as encoded by a camera.
        T_world_camera: pose of the camera in the print's frame.
        intrinsics: of the camera, 3 x 3 [px].
    """

    image: UInt8[np.ndarray, "h w 3"]
    T_world_camera: Pose
    intrinsics: Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False, slots=True)
class ViewErrors:
    """Errors of cameras that were found, view by view; NaN where none was found.

    Attributes:
        rotation_rad: angle between the orientations [rad].
        origin_m: distance between where the print's centre lies in the camera's frame and where it should [m].
        nearby_m: the largest such distance of points on the table within 20 cm of the centre [m].
        camera_m: distance between the camera's positions in the print's frame [m].
        focal_share: error of the focal length, as a share of it.
        rms_px: reprojection error, as `locate_board` reports it [px].
        corners: number of points that were found.
        refusals: why no camera was found, of each view; empty where one was.
    """

    rotation_rad: Float[np.ndarray, "views"]
    origin_m: Float[np.ndarray, "views"]
    nearby_m: Float[np.ndarray, "views"]
    camera_m: Float[np.ndarray, "views"]
    focal_share: Float[np.ndarray, "views"]
    rms_px: Float[np.ndarray, "views"]
    corners: Float[np.ndarray, "views"]
    refusals: tuple[str, ...]


def random_camera(
    rng: np.random.Generator,
    size: tuple[int, int],
    distances_m: tuple[float, float] = _DISTANCES_M,
    elevations_deg: tuple[float, float] = _ELEVATIONS_DEG,
) -> tuple[Pose, Float[np.ndarray, "3 3"]]:
    """Draw the pose `T_world_camera` and the intrinsics of a camera that looks at a print, from any side.

    Args:
        rng: draws it.
        size: width and height of its image [px].
        distances_m: least and largest distance from the point that it looks at, some cm beside the print's centre [m].
        elevations_deg: least and largest angle above the table [deg].
    """
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*elevations_deg))
    direction = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    target = np.array([*rng.uniform(-_TARGET_M, _TARGET_M, 2), 0])
    level = Camera.look_at("photograph", target + rng.uniform(*distances_m) * direction, target).T_world_camera
    roll = Pose(np.zeros(3), quaternion_exp(np.array([0, 0, np.deg2rad(rng.uniform(*_ROLLS_DEG))])))
    focal = size[0] / 2 / np.tan(np.deg2rad(rng.uniform(*_FIELDS_OF_VIEW_DEG)) / 2)
    return level @ roll, np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])


def board_photograph(
    rng: np.random.Generator,
    size: tuple[int, int],
    board: Board | None = None,
    camera: tuple[Pose, Float[np.ndarray, "3 3"]] | None = None,
    blur_px: float = _BLUR_PX,
    radial: float = 0.0,
) -> Photograph:
    """Take a photograph of a page with a board that lies on a table, its centre at the origin and its top along +y.

    Args:
        rng: draws the camera if none is given, the table, the light and the noise.
        size: width and height of the photograph [px].
        board: on the page; the default one if not given.
        camera: its pose `T_world_camera` and intrinsics.
        blur_px: standard deviation of the lens's blur [px].
        radial: k1 of the lens, as OpenCV counts it; negative for a barrel.
    """
    pose, intrinsics = camera or random_camera(rng, size)
    pixels_per_m = _PAGE_STEP * math.ceil(4 * intrinsics[0, 0] / _DISTANCES_M[0] / _PAGE_STEP)
    paper = page_image(board or Board(), pixels_per_m)  # what is paper, not ink
    width, height = size[0] * _SAMPLES, size[1] * _SAMPLES
    # From the print's pixels to the table, and on to the finely sampled image, both as OpenCV counts them.
    rows, columns = paper.shape
    to_table = np.array([[1, 0, -columns / 2], [0, -1, rows / 2], [0, 0, pixels_per_m]]) / pixels_per_m
    centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    fine, to_camera = np.diag([_SAMPLES, _SAMPLES, 1.0]), pose.inverse().matrix()[:3, [0, 1, 3]]
    warp = np.linalg.inv(centre) @ fine @ intrinsics @ to_camera @ to_table @ centre
    ink, white = _REFLECTANCES
    lens = _lens(size, intrinsics, radial)
    cover = _seen(np.ones(paper.shape, np.float32), warp, (width, height), lens)
    print_light = _seen((ink + (white - ink) * paper).astype(np.float32), warp, (width, height), lens)
    texture = rng.uniform(0.6, 1.4, (24, 32)).astype(np.float32)
    table = (1 - cover) * cv2.resize(texture, (width, height), interpolation=cv2.INTER_CUBIC)
    layers = [_reduced(layer, size, blur_px)[..., None] for layer in (print_light, table)]
    light = layers[0] + layers[1] * rng.uniform(0.15, 0.5, 3)
    (slope_x, slope_y), exposure = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.5, 1.05)  # it falls off across the image
    across, down = ((np.arange(side) + 0.5) / side - 0.5 for side in size)
    falloff = 1 + slope_x * across + slope_y * down[:, None]
    light = np.clip(light * (exposure * falloff / falloff.max())[..., None], 0, 1)
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    values += rng.normal(0, _NOISE, values.shape)
    file = io.BytesIO()
    Image.fromarray(to_uint8(values)).save(file, "JPEG", quality=_JPEG_QUALITY)
    return Photograph(np.array(Image.open(file)), pose, intrinsics)


def board_errors(
    count: int,
    rng: np.random.Generator,
    size: tuple[int, int],
    *,
    is_focal_known: bool = True,
    board: Board | None = None,
    radial: float | None = None,
) -> ViewErrors:
    """Return the errors of cameras found with the board, in random views.

    Args:
        count: of views.
        rng: draws them.
        size: width and height of the photographs [px].
        is_focal_known: whether the intrinsics are given.
        board: that lies on the table; the default one if not given.
        radial: k1 of a lens, which is looked for as well; None for a lens without distortion that is taken for such.
    """
    board = board or Board()
    rows, refusals = [], []
    for _ in range(count):
        view = board_photograph(rng, size, board, radial=radial or 0.0)
        intrinsics = view.intrinsics if is_focal_known else None
        try:
            if radial is None:
                found = locate_board(view.image, board, intrinsics)
            else:
                found = locate_board_through_lens(view.image, board, intrinsics)[0]
            rows.append(_error(found, view))
            refusals.append("")
        except InvalidInput as refusal:
            rows.append(np.full(7, np.nan))
            refusals.append(str(refusal))
    table = np.array(rows).reshape(-1, 7)
    return ViewErrors(*table.T, refusals=tuple(refusals))


def _error(found: BoardView, true: Photograph) -> Float[np.ndarray, "7"]:
    """Return the figures of `ViewErrors`, in their order."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = _NEARBY_M * np.stack([np.cos(angles), np.sin(angles), np.zeros(12)], axis=1)
    points = np.concatenate([np.zeros((1, 3)), around])
    there = [pose.inverse().apply(points) for pose in (found.T_world_camera, true.T_world_camera)]
    distances = np.linalg.norm(there[0] - there[1], axis=1)
    focal_share = found.intrinsics[0, 0] / true.intrinsics[0, 0] - 1
    return np.array(
        [
            rotation_angle(found.T_world_camera.quaternion, true.T_world_camera.quaternion),
            distances[0],
            distances.max(),
            np.linalg.norm(found.T_world_camera.position - true.T_world_camera.position),
            focal_share,
            found.reprojection_rms_px,
            found.corner_count,
        ]
    )


def _seen(
    layer: Float[np.ndarray, "H W"],
    warp: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    lens: Float[np.ndarray, "h w 2"] | None,
) -> Float[np.ndarray, "h w"]:
    """Return a flat layer as a camera of this finely sampled size sees it through its lens."""
    if lens is None:
        return cv2.warpPerspective(layer, warp, size)
    low = np.floor(np.minimum(lens.min(axis=(0, 1)), 0))
    columns, rows = (np.ceil(lens.max(axis=(0, 1))) - low + 2).astype(int).tolist()
    shift = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]])
    straight = cv2.warpPerspective(layer, shift @ warp, (columns, rows))
    return cv2.remap(straight, (lens - low).astype(np.float32), None, cv2.INTER_LINEAR)  # pyright: ignore


def _lens(
    size: tuple[int, int], intrinsics: Float[np.ndarray, "3 3"], radial: float
) -> Float[np.ndarray, "h w 2"] | None:
    """Return for each sample of the image its place without distortion [samples]; None where there is none."""
    if radial == 0:
        return None
    fine = np.diag([_SAMPLES, _SAMPLES, 1.0]) @ intrinsics
    columns, rows = np.meshgrid(np.arange(size[0] * _SAMPLES) + 0.5, np.arange(size[1] * _SAMPLES) + 0.5)
    bent = (np.stack([columns, rows], axis=-1) - fine[:2, 2]) / fine[[0, 1], [0, 1]]
    distance = np.linalg.norm(bent, axis=-1, keepdims=True)
    straight = distance.copy()
    for _ in range(_NEWTON_STEPS):
        straight -= (straight * (1 + radial * straight**2) - distance) / (1 + 3 * radial * straight**2)
    return bent * (straight / np.maximum(distance, 1e-9)) * fine[[0, 1], [0, 1]] + fine[:2, 2] - 0.5


def _reduced(layer: Float[np.ndarray, "H W"], size: tuple[int, int], blur_px: float) -> Float[np.ndarray, "h w"]:
    """Blur a finely sampled layer by the lens, and average it over each pixel."""
    return cv2.resize(cv2.GaussianBlur(layer, (0, 0), blur_px * _SAMPLES), size, interpolation=cv2.INTER_AREA)
