"""Masks of an object once the others are found: what lies in front of it spoils a mask that was proposed from a box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool

from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.object_window import WindowFrame, object_windows
from osfcore.photo.poses.photo_doubt import fits_outline
from osfcore.photo.poses.photo_steps import PhotoObject
from osfcore.photo.poses.pose_loss import draw
from osfcore.photo.poses.surfels import Surfels

_SIDE = 240  # of a mask whose object is drawn [px]


def without_others(
    photos: Sequence[Photograph], name: str, found: Sequence[PhotoObject], surfels: Mapping[str, Surfels]
) -> list[Photograph]:
    """Photographs in which the others' masks hold whatever may hide an object, and its own mask none of it.

    An outline drawn in the pose that was found is added to each other's mask. What such an outline and a mask that it
    fits both claim is taken from the object's own.

    Args:
        photos: with masks.
        name: of the object; photographs without a mask of it are left as they are.
        found: all objects.
        surfels: of each object, by name.
    """
    return [_without_others(photo, name, found, surfels) if name in photo.masks else photo for photo in photos]


def _without_others(
    photo: Photograph, name: str, found: Sequence[PhotoObject], surfels: Mapping[str, Surfels]
) -> Photograph:
    masks, own = dict(photo.masks), photo.masks[name].copy()
    for other in found:
        if other.name == name or other.name not in masks:
            continue
        drawn = _outline(photo, other, surfels[other.name])
        if fits_outline(other.best):
            own &= ~(drawn & masks[other.name])
        masks[other.name] = masks[other.name] | drawn
    return replace(photo, masks={**masks, name: own})


def _outline(photo: Photograph, found: PhotoObject, surfels: Surfels) -> Bool[np.ndarray, "h w"]:
    """The pixels of a photograph that an object covers, as far as its window reaches."""
    window = object_windows([photo], found.name, _SIDE)[0]
    index, _ = draw(surfels, window, found.best.pose[None])
    return _placed(index[0] >= 0, window.frame, photo.masks[found.name].shape)


def _placed(drawn: Bool[np.ndarray, "a b"], frame: WindowFrame, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """A window's pixels in the whole photograph."""
    high, wide = shape
    whole = cv2.resize(drawn.astype(np.float32), (frame.right - frame.left, frame.bottom - frame.top)) > 0.5
    top, left, bottom, right = max(frame.top, 0), max(frame.left, 0), min(frame.bottom, high), min(frame.right, wide)
    placed = np.zeros((high, wide), bool)
    placed[top:bottom, left:right] = whole[top - frame.top : bottom - frame.top, left - frame.left : right - frame.left]
    return placed
