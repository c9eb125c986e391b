"""Contact sheets of photographed objects: the photo, outlines, and what the surfels look like."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.estimation.photometry.camera_response import srgb_of_linear
from osfcore.geometry.poses import Pose
from osfcore.io.image_file import to_uint8, write_png
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.estimate_photo import FINE_ACROSS, PhotoModels
from osfcore.photo.poses.object_window import object_windows
from osfcore.photo.poses.photo_steps import PhotoObject
from osfcore.photo.poses.pose_loss import draw

_SIDE = 180  # of a mask [px]
_MASK_COLOUR, _FOUND_COLOUR = (255, 60, 60), (60, 220, 60)


def sheet(models: PhotoModels, photo: Photograph, found: PhotoObject) -> UInt8[np.ndarray, "H W 3"]:
    """Photo; photo with the outlines of the mask (red) and of what was found (green); the object in its pose.

    Args:
        models: of the objects.
        photo: in whose frame the pose is told.
        found: in it.
    """
    window = object_windows([photo], found.name, _SIDE)[0]
    surfels, pose = models.surfels(found.name, FINE_ACROSS), found.best.pose
    index = draw(surfels, window, Pose(pose.position[None], pose.quaternion[None]))[0][0]
    shown = index >= 0
    picture = to_uint8(srgb_of_linear(window.image))
    outlined = picture.copy()
    for mask, colour in ((window.mask, _MASK_COLOUR), (shown, _FOUND_COLOUR)):
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(outlined, contours, -1, colour, 1)
    albedo = np.where(shown[..., None], surfels.albedo[np.maximum(index, 0)], 0)
    return np.hstack([picture, outlined, to_uint8(srgb_of_linear(albedo))])


def write_sheet(path: Path, models: PhotoModels, photo: Photograph, found: PhotoObject) -> None:
    """Write a sheet as PNG.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_png(path, sheet(models, photo, found))
