"""Observations at the resolutions the estimator works at, and the parts of them that show one object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from osfcore.estimation.objective.object_models import QUALITY, ObjectModels
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.geometry.cameras import MIN_IMAGE_SIDE, Camera
from osfcore.geometry.poses import rotate
from osfcore.geometry.states import Observation
from osfcore.render.types import Quality, SceneBatch

FINE_SIDE = 128  # more pixels would cost time and tell little
_BESIDE_PX = 3  # of its silhouette that an object may come to cover in one step
_MARGIN_PX = 3  # around an object's sphere
_OTHER_SHARE = 0.3  # of a pixel that others may cover before it tells nothing about an object


@dataclass(frozen=True, eq=False, slots=True)
class ObservedViews:
    """An observation at one resolution.

    Attributes:
        cameras: V cameras.
        images: linear RGB.
        masks: share of each pixel that shows each object, or None.
        pusher: centre of the pusher [m], or None.
        quality: of what is rendered to compare with.
        only: pixels that count, where not all do.
    """

    cameras: tuple[Camera, ...]
    images: Float32[np.ndarray, "V h w 3"]
    masks: Float32[np.ndarray, "V N h w"] | None
    pusher: Float[np.ndarray, "3"] | None
    quality: Quality = QUALITY
    only: Bool[np.ndarray, "V h w"] | None = None


def views_of(observation: Observation, side: int, *, samples: int = 1) -> ObservedViews:
    """An observation at the resolution at which it is compared with renderings.

    Args:
        observation: images are reduced by area averaging, never enlarged.
        side: longest side of the result [px]; the other does not fall below 16 px.
        samples: rays along each side of a rendered pixel.
    """
    height, width = observation.images.shape[1:3]
    scale = min(1.0, side / max(height, width))
    size = (max(MIN_IMAGE_SIDE, round(width * scale)), max(MIN_IMAGE_SIDE, round(height * scale)))
    cameras = tuple(camera.resized(*size) for camera in observation.cameras)
    images = np.stack([_resize(image, size) for image in observation.images])
    masks = observation.masks
    if masks is not None:
        masks = np.stack([[_resize(mask, size) for mask in view] for view in masks.astype(np.float32)])
        masks = masks.reshape(len(cameras), len(observation.names), size[1], size[0])
    return ObservedViews(cameras, images, masks, observation.pusher, replace(QUALITY, samples_per_side=samples))


def _resize(image: np.ndarray, size: tuple[int, int]) -> Float32[np.ndarray, "h w *c"]:
    image = np.ascontiguousarray(image, np.float32)
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, eq=False, slots=True)
class ObjectView:
    """The windows of V views around one object; all of one size.

    Attributes:
        cameras: that see the windows alone.
        rgb: the object over black (paper eq. 5: image times mask).
        mask: share of each pixel that shows it.
        valid: pixels in which no other object hides it.
        area: of the mask [px]; at least 1.
        quality: of what is rendered to compare with.
    """

    cameras: tuple[Camera, ...]
    rgb: Float32[np.ndarray, "V h w 3"]
    mask: Float32[np.ndarray, "V h w"]
    valid: Bool[np.ndarray, "V h w"]
    area: Float32[np.ndarray, "V"]
    quality: Quality


def crop_to_masks(views: ObservedViews, number: int, *, margin: int = 3) -> ObjectView:
    """The windows around one object's masks.

    Args:
        views: with masks; views in which the object's is empty are left out, and at least one must not be.
        number: of the object.
        margin: around the largest mask [px].
    """
    assert views.masks is not None
    shown = [v for v, mask in enumerate(views.masks[:, number]) if mask.max() > 0.5]
    own = views.masks[shown, number]
    others = np.delete(views.masks[shown], number, axis=1)
    covered = others.max(axis=1) if others.shape[1] else np.zeros_like(own)
    corners, (width, height) = _crop_windows(own > 0.5, margin)

    def cut(array: np.ndarray) -> np.ndarray:
        return np.stack([a[y : y + height, x : x + width] for a, (x, y) in zip(array, corners, strict=True)])

    cameras = tuple(
        crop_camera(views.cameras[v], x, y, width, height) for v, (x, y) in zip(shown, corners, strict=True)
    )
    mask, valid = cut(own), cut(covered) < _OTHER_SHARE
    area = np.maximum((mask * valid).sum(axis=(1, 2)), 1)
    return ObjectView(cameras, cut(views.images[shown]) * mask[..., None], mask, valid, area, views.quality)


def crop_to_object(
    views: ObservedViews, models: ObjectModels, params: SceneParameters, number: int, *, reach: float = 0.0
) -> ObservedViews:
    """The windows around one object of a guess, without masks, or whole images if none shows it.

    Args:
        views: whole images; those that do not show the object are left out.
        models: fields, for the object's bounding sphere.
        params: the guess.
        number: of the object.
        reach: by how much the windows reach beyond that sphere [m].
    """
    resting = models.resting(params.names[number])
    centre = params.positions[number] + rotate(params.quaternions[number], resting.centre)
    height, width = views.images.shape[1:3]
    boxes = []
    for view, camera in enumerate(views.cameras):
        depth = float(camera.T_world_camera.inverse().apply(centre)[2])
        if depth < resting.radius:
            continue
        x, y = camera.project(centre)
        half = camera.intrinsics[0, 0] / depth * (resting.radius + reach) + _MARGIN_PX
        if -half < x < width + half and -half < y < height + half:
            boxes.append((view, x, y, half))
    if not boxes:
        return replace(views, masks=None)
    side = int(np.ceil(2 * max(half for *_, half in boxes)))
    w, h = min(max(side, MIN_IMAGE_SIDE), width), min(max(side, MIN_IMAGE_SIDE), height)
    corners = [(int(np.clip(x - w / 2, 0, width - w)), int(np.clip(y - h / 2, 0, height - h))) for _, x, y, _ in boxes]
    cameras = tuple(crop_camera(views.cameras[v], x, y, w, h) for (v, *_), (x, y) in zip(boxes, corners, strict=True))
    windows = [(v, slice(y, y + h), slice(x, x + w)) for (v, *_), (x, y) in zip(boxes, corners, strict=True)]
    images = np.stack([views.images[window] for window in windows])
    only = None if views.only is None else np.stack([views.only[window] for window in windows])
    return ObservedViews(cameras, images, None, views.pusher, views.quality, only)


def crop_to_silhouette(
    views: ObservedViews, models: ObjectModels, params: SceneParameters, number: int
) -> ObservedViews:
    """The windows around one object of a guess, of which only pixels in or just beside its silhouette count.

    Args:
        views: whole images.
        models: fields; the object is rendered alone for its silhouette.
        params: the guess.
        number: of the object.
    """
    own = crop_to_object(views, models, params, number)
    alone = SceneBatch((params.names[number],), params.positions[None, [number]], params.quaternions[None, [number]],
                       params.light[None], None)  # fmt: skip
    rendered = models.alone.render(alone, own.cameras, quality=QUALITY, outputs={"opacity"})
    assert rendered.opacity is not None
    silhouettes = (rendered.opacity[0, :, 0] > 0).astype(np.uint8)
    kernel = np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)
    only = np.stack([cv2.dilate(silhouette, kernel) for silhouette in silhouettes]).astype(bool)
    return replace(own, images=own.images * only[..., None], only=only) if only.any() else own


def crop_camera(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """The camera that sees a window of another's image.

    Args:
        camera: the other.
        x: left edge of the window in its image [px]; may lie outside.
        y: upper edge likewise [px].
        width: of the window [px].
        height: of the window [px].

    Raises:
        InvalidInput: if the window's sides are outside 16 to 1024 px.
    """
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= x, y
    return replace(camera, intrinsics=intrinsics, width=width, height=height)


def _crop_windows(masks: Bool[np.ndarray, "V h w"], margin: int) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Corners (x, y) of windows around masks, none of them empty, and their common width and height [px]."""
    height, width = masks.shape[1:]
    boxes = []
    for mask in masks:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        boxes.append((columns[0], columns[-1] + 1, rows[0], rows[-1] + 1))
    x0, x1, y0, y1 = np.array(boxes).T
    size = (
        int(np.clip((x1 - x0).max() + 2 * margin, min(MIN_IMAGE_SIDE, width), width)),
        int(np.clip((y1 - y0).max() + 2 * margin, min(MIN_IMAGE_SIDE, height), height)),
    )
    x = np.clip((x0 + x1 - size[0]) // 2, 0, width - size[0])
    y = np.clip((y0 + y1 - size[1]) // 2, 0, height - size[1])
    return list(zip(x.tolist(), y.tolist(), strict=True)), size
