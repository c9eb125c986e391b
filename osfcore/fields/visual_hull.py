"""The place of an object from its silhouettes alone, and a check that cameras and silhouettes agree.

Linear programs intersect the cones of the silhouettes' rectangles, which gives a region in the image set's own unit of
length. The silhouettes then carve a coarse grid in this region. With right cameras, the rest covers every silhouette.
With a misread camera convention it does not, or nothing is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.optimize import linprog

from osfcore.errors import CorruptFile
from osfcore.geometry.cameras import Camera
from osfcore.io.image_set import OPAQUE, ImageSet

MIN_COVER = 0.85  # of a silhouette, by what all views share
MAX_WRONG_SHARE = 0.1  # more contradicting views than that: not single images are wrong but the convention
MIN_SIDE, MAX_COORDINATE = 1e-6, 1e8  # of an object, in the set's unit: what a field's file and its rays can hold
MAX_OFFSET = 1e4  # coordinates in sizes of the object: beyond it single precision blurs the voxels
_AGREEING = 0.95  # share of views that must see a cell, so that single wrong images do not carve everything away
_EXACT_COVER = 0.99
_VOTERS = 256
_SLACK_PX = 1.0
_SLACK_SHARE = 0.02  # of the image's side, for cameras that were estimated
_FAR = 50.0  # times the spread of the cameras: further away nothing is bounded


@dataclass(frozen=True, eq=False, slots=True)
class Hull:
    """The coarse visual hull of a set.

    Attributes:
        box: least and greatest corner of the hull, in the set's unit; of the searched region if the hull is empty.
        occupied: cells of the grid over the searched region that belong to the hull; indices run along x, y, z.
        cover: share of each silhouette that the hull covers.
        is_bounded: whether the views enclose a bounded region.
    """

    box: Float[np.ndarray, "2 3"]
    occupied: Bool[np.ndarray, "r r r"]
    cover: Float[np.ndarray, "n"]
    is_bounded: bool


def silhouette_box(*sets: ImageSet, where: Path | str = "The image set") -> Float[np.ndarray, "2 3"]:
    """Return the axis-aligned box of the object: least and greatest corner, in the set's unit of length.

    Args:
        *sets: images of one object, each with a silhouette. More images give a tighter box.
        where: folder of the image set, for messages.

    Raises:
        CorruptFile: if the views enclose no bounded region, silhouettes contradict each other (single wrong ones are
            named), or a field could not hold an object of that size at that place.
    """
    hull = carve(*sets)
    if not hull.is_bounded:
        raise CorruptFile(where, "its views do not enclose the object: all look from about one place or direction")
    wrong = np.flatnonzero(hull.cover < MIN_COVER)
    if not hull.occupied.any() or len(wrong) > MAX_WRONG_SHARE * len(hull.cover):
        how = "share no volume" if not hull.occupied.any() else "contradict each other"
        expected = "RT must be world-to-camera with OpenCV axes (x right, y down, z forward), K in pixels of the image"
        raise CorruptFile(where, f"the silhouettes of different images {how}: {expected}")
    if len(wrong):
        cameras = [camera for images in sets for camera in images.cameras]
        names = ", ".join(cameras[i].name for i in wrong[:5]) + (", ..." if len(wrong) > 5 else "")
        expected = "check their RT, K and masks"
        raise CorruptFile(where, f"the silhouettes of {names} contradict those of all other images: {expected}")
    side, farthest = float(np.ptp(hull.box, axis=0).max()), float(np.abs(hull.box).max())
    if not (side >= MIN_SIDE and farthest <= MAX_COORDINATE and farthest <= MAX_OFFSET * side):
        found = f"its object is {side:.3g} large and lies at coordinates up to {farthest:.3g}"
        bounds = f"coordinates up to {MAX_COORDINATE:g} and up to {MAX_OFFSET:g} times the size"
        raise CorruptFile(where, f"{found}; a size from {MIN_SIDE:g}, {bounds} can be held")
    return hull.box


def carve(*sets: ImageSet, resolution: int = 32) -> Hull:
    """Carve the visual hull on a grid of `resolution` cells a side, even from views that contradict each other.

    Views are numbered through all sets; each image must have a silhouette. A cell stays if all silhouettes meet it, so
    that the hull is too large by up to about a cell.
    """
    views = [
        _View(camera, rgba[..., 3] >= OPAQUE, camera.intrinsics @ camera.T_world_camera.inverse().matrix()[:3])
        for images in sets
        for camera, rgba in zip(images.cameras, images.rgba, strict=True)
    ]
    region, is_bounded = _region(views)
    cell = (region[1] - region[0]) / resolution
    axes = [region[0, i] + cell[i] * (np.arange(resolution) + 0.5) for i in range(3)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = float(np.linalg.norm(cell)) / 2
    voters = np.unique(np.linspace(0, len(views) - 1, min(_VOTERS, len(views))).astype(int))
    votes = np.zeros(len(centres), np.int32)
    for i in voters:
        votes += views[i].meets(centres, radius)
    occupied = votes >= _AGREEING * len(voters)
    cover = np.array([view.cover(centres[occupied], radius) for view in views])
    unanimous = votes == len(voters)
    # With exact cameras what all views share explains them all and is tighter; else it has been carved into.
    if all(view.cover(centres[unanimous], radius) > _EXACT_COVER for view in views):
        occupied = unanimous
    left = centres[occupied]
    box = np.stack([left.min(axis=0) - cell / 2, left.max(axis=0) + cell / 2]) if len(left) else region
    return Hull(box, occupied.reshape((resolution,) * 3), cover, is_bounded)


@dataclass(frozen=True, eq=False, slots=True)
class _View:
    """A silhouette, and the matrix that projects points in the world to its pixels."""

    camera: Camera
    mask: Bool[np.ndarray, "h w"]
    P: Float[np.ndarray, "3 4"]

    def project(self, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return columns, rows [px] and depths. Points behind the camera are put outside of the image."""
        projected = points @ self.P[:, :3].T + self.P[:, 3]
        depth = projected[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.where(depth[:, None] > 0, projected[:, :2] / depth[:, None], -1e6)
        pixels = np.clip(np.nan_to_num(pixels, nan=-1e6), -1e6, 1e6)
        return np.floor(pixels[:, 0]).astype(np.int32), np.floor(pixels[:, 1]).astype(np.int32), depth

    def meets(self, centres: Float[np.ndarray, "n 3"], radius: float) -> Bool[np.ndarray, "n"]:
        """Return whether balls around the centres meet the silhouette, or may do so beyond a border that it touches."""
        height, width = self.mask.shape
        distance = cv2.distanceTransform(1 - self.mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        u, v, depth = self.project(centres)
        reach = self.camera.intrinsics[0, 0] * radius / np.maximum(depth, 1e-12) + _SLACK_PX
        left, right, top, bottom = self.mask[:, 0], self.mask[:, -1], self.mask[0], self.mask[-1]
        is_hidden = ((u < 0) & left.any()) | ((u >= width) & right.any())
        is_hidden |= ((v < 0) & top.any()) | ((v >= height) & bottom.any())
        is_near = distance[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] <= reach
        return (depth > 0) & (is_near | is_hidden)

    def cover(self, centres: Float[np.ndarray, "n 3"], radius: float) -> float:
        """Return the share of the silhouette within reach of balls around the centres."""
        height, width = self.mask.shape
        u, v, depth = self.project(centres)
        is_seen = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        if not is_seen.any():
            return 0.0
        absent = np.ones((height, width), np.uint8)
        absent[v[is_seen], u[is_seen]] = 0
        distance = cv2.distanceTransform(absent, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        reach = self.camera.intrinsics[0, 0] * radius / float(np.median(depth[is_seen])) + _SLACK_PX
        return float(np.mean(distance[self.mask] <= reach))

    def half_spaces(self) -> Float[np.ndarray, "k 4"]:
        """Return rows (n, d) with n x + d >= 0 for every point of the object: in front, within the mask's rectangle.

        The object may continue beyond an image border that the silhouette touches. That side then bounds nothing, nor
        do the two adjacent sides.
        """
        height, width = self.mask.shape
        columns, rows = np.flatnonzero(self.mask.any(axis=0)), np.flatnonzero(self.mask.any(axis=1))
        slack_u, slack_v = _SLACK_PX + _SLACK_SHARE * width, _SLACK_PX + _SLACK_SHARE * height
        is_cut_u = columns[0] == 0 or columns[-1] == width - 1
        is_cut_v = rows[0] == 0 or rows[-1] == height - 1
        planes = [self.P[2]]
        if columns[0] > 0 and not is_cut_v:
            planes.append(self.P[0] - (columns[0] - slack_u) * self.P[2])
        if columns[-1] < width - 1 and not is_cut_v:
            planes.append((columns[-1] + 1 + slack_u) * self.P[2] - self.P[0])
        if rows[0] > 0 and not is_cut_u:
            planes.append(self.P[1] - (rows[0] - slack_v) * self.P[2])
        if rows[-1] < height - 1 and not is_cut_u:
            planes.append((rows[-1] + 1 + slack_v) * self.P[2] - self.P[1])
        stacked = np.stack(planes)
        return stacked / np.linalg.norm(stacked[:, :3], axis=1, keepdims=True)


def _region(views: Sequence[_View]) -> tuple[Float[np.ndarray, "2 3"], bool]:
    """Return a box around the intersection of the views' cones, and whether it is bounded.

    Contradicting views are left out. If the rest encloses no bounded region, the box is as large as the silhouettes,
    around the point at which the views look.
    """
    origins = np.array([view.camera.T_world_camera.position for view in views])
    centre = origins.mean(axis=0)
    scale = float(np.median(np.linalg.norm(origins - centre, axis=1))) or 1.0
    planes = [view.half_spaces() for view in views]
    for rows in planes:  # in coordinates (x - centre) / scale, so that solver tolerances mean the same for any unit
        rows[:, 3] = (rows[:, :3] @ centre + rows[:, 3]) / scale
    focus, is_met = _focus(planes)
    box = _bounds(np.concatenate([rows for rows, met in zip(planes, is_met, strict=True) if met] or planes))
    is_finite = box is not None and bool(np.all(np.abs(box) < 0.99 * _FAR))
    if box is None or not is_finite:
        focus = centre + scale * focus
        distances = np.linalg.norm(origins - focus, axis=1)
        sizes = [np.sqrt(view.mask.sum()) / view.camera.intrinsics[0, 0] for view in views]
        half = max(float(np.median(distances * sizes)), 1e-6 * scale)
        is_contradictory = box is None or np.mean(~is_met) > MAX_WRONG_SHARE
        return np.stack([focus - half, focus + half]), bool(is_contradictory)
    return centre + scale * box, True


def _focus(planes: Sequence[Float[np.ndarray, "_ 4"]]) -> tuple[Float[np.ndarray, "3"], Bool[np.ndarray, "n"]]:
    """Return the point with the least summed violation of the views' cones, and which cones contain it."""
    rows = np.concatenate(planes)
    owner = np.repeat(np.arange(len(planes)), [len(p) for p in planes])
    slack = sparse.csr_array((-np.ones(len(rows)), (np.arange(len(rows)), owner)), shape=(len(rows), len(planes)))
    A = sparse.hstack([sparse.csr_array(-rows[:, :3]), slack])
    cost = np.concatenate([np.zeros(3), np.ones(len(planes))])
    limits = [(-_FAR, _FAR)] * 3 + [(0, None)] * len(planes)
    solution = linprog(cost, A_ub=A, b_ub=rows[:, 3], bounds=limits)
    if solution.x is None:  # never seen; numbers so odd that the solver gives up contradict each other
        return np.zeros(3), np.zeros(len(planes), bool)
    return solution.x[:3], solution.x[3:] < 1e-6


def _bounds(rows: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "2 3"] | None:
    """Return the least and greatest coordinates of the intersection of half spaces; None if it is empty."""
    box = np.zeros((2, 3))
    for axis in range(3):
        for side, sign in enumerate((1, -1)):
            cost = np.zeros(3)
            cost[axis] = sign
            solution = linprog(cost, A_ub=-rows[:, :3], b_ub=rows[:, 3], bounds=[(-_FAR, _FAR)] * 3)
            if solution.x is None:
                return None
            box[side, axis] = solution.x[axis]
    return box if np.all(box[1] > box[0]) else None
