"""Masks as a person would get them: from a box around the object and one click on it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from osfcore.experiments.photos.folders import PhotoFolder
from osfcore.photo.photograph import Photograph
from osfcore.photo.segmentation import Box, propose_masks

LOOSE = 0.04  # of the box's sides, on each side: people do not draw to the pixel


def box_and_click(mask: Bool[np.ndarray, "h w"]) -> tuple[Box, Float[np.ndarray, "1 2"]]:
    """A loose box around a mask, and the point of it that is farthest from its border [px]."""
    rows, columns = np.nonzero(mask)
    left, top, right, bottom = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    across, down = LOOSE * (right - left), LOOSE * (bottom - top)
    height, width = mask.shape
    box = max(left - across, 0.0), max(top - down, 0.0), min(right + across, width), min(bottom + down, height)
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), mask.shape)
    return (float(box[0]), float(box[1]), float(box[2]), float(box[3])), np.array([[column + 0.5, row + 0.5]])


def masks_from_boxes(scene: PhotoFolder) -> dict[str, Bool[np.ndarray, "h w"]]:
    """What GrabCut makes of a box and a click for each mask of a scene.

    Raises:
        InvalidInput: if nothing is found in a box.
    """
    picture = _eight_bit(scene.encoded)
    marks = {name: box_and_click(mask) for name, mask in scene.photo.masks.items()}
    boxes, clicks = {name: box for name, (box, _) in marks.items()}, {name: on for name, (_, on) in marks.items()}
    return propose_masks(picture, boxes, clicks)


def mask_iou(used: Photograph, given: Photograph, name: str) -> float:
    """Intersection over union of the mask that was searched with and the given one."""
    mine, its = used.masks[name], given.masks[name]
    return float((mine & its).sum() / (mine | its).sum())


def _eight_bit(encoded: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    return np.ascontiguousarray(encoded if encoded.dtype == np.uint8 else (encoded // 257).astype(np.uint8))
