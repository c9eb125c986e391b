"""Masks of the first look for worlds that have none: a person draws a box around each object, GrabCut its outline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from osfcore.control.sight import without_cameras
from osfcore.control.world_protocol import World
from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.photometry.camera_response import srgb_of_linear
from osfcore.geometry.states import Observation
from osfcore.io.image_file import to_uint8
from osfcore.photo.segmentation import Box, propose_masks

CameraBoxes = Mapping[str, Mapping[str, Box]]


class OutlinedWorld:
    """Wraps a world; where that has no masks, boxes tell what they are.

    Args:
        world: that looks and moves.
        boxes: by names of camera and object, x0, y0, x1, y1 [px] of what `observe` delivers. Cameras in which an object
            has none are left out of looks with masks: no mask would mean that it is not visible there.
    """

    def __init__(self, world: World, boxes: CameraBoxes) -> None:
        self._world, self._boxes = world, boxes

    def reset(self, seed: int) -> Observation:
        """As the wrapped world does it."""
        return self._world.reset(seed)

    def observe(self, *, masks: bool = False) -> Observation:
        """As the wrapped world sees it, with outlines on demand.

        Raises:
            UnknownName: if a box is in no camera, or around no object, that there is.
            InvalidInput: if no camera has a box around each object, or nothing is found in one.
        """
        seen = self._world.observe(masks=masks)
        return self._outlined(seen) if masks and seen.masks is None else seen

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """As the wrapped world does it."""
        self._world.act(action)

    def close(self) -> None:
        """Release what the wrapped world holds."""
        self._world.close()

    def _outlined(self, seen: Observation) -> Observation:
        cameras = [camera.name for camera in seen.cameras]
        for camera, boxes in self._boxes.items():
            if camera not in cameras:
                raise UnknownName("camera", camera, cameras)
            for name in boxes:
                if name not in seen.names:
                    raise UnknownName("object on the table", name, seen.names)
        unmarked = frozenset(camera for camera in cameras if set(self._boxes.get(camera, ())) != set(seen.names))
        if len(unmarked) == len(cameras):
            allowed = "around each object in at least one camera, for the robot delivers no masks"
            raise InvalidInput("boxes", "missing", allowed)
        marked = without_cameras(seen, unmarked)
        pictures = [to_uint8(srgb_of_linear(image)) for image in marked.images]
        pairs = zip(marked.cameras, pictures, strict=True)
        masks = np.stack([_outlines(picture, self._boxes[camera.name], seen.names) for camera, picture in pairs])
        return replace(marked, masks=masks)


def _outlines(
    picture: UInt8[np.ndarray, "h w 3"], boxes: Mapping[str, Box], names: tuple[str, ...]
) -> Bool[np.ndarray, "N h w"]:
    """GrabCut from each box, a click in its middle telling what is the object, and what is none of the others."""
    clicks = {name: np.array([[(x0 + x1) / 2, (y0 + y1) / 2]]) for name, (x0, y0, x1, y1) in boxes.items()}
    found = propose_masks(picture, boxes, clicks)
    return np.stack([found[name] for name in names])
