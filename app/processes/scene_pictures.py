"""Pictures of a simulated scene, encoded as PNG."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from app.processes.messages.scene_messages import TakeImage, TakeMask
from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera, image_side
from osfcore.inspection.overlays import tint_masks
from osfcore.io.image_file import encode_png, to_uint8

if TYPE_CHECKING:
    from osfcore.world.tabletop import Tabletop


def image_png(world: Tabletop, command: TakeImage) -> bytes:
    """What one camera sees, with the objects' masks laid over it on demand.

    Raises:
        UnknownName: if there is no such camera.
    """
    observation = world.render((_camera(command),), masks=command.masks, with_pusher=command.pusher)
    pixels = to_uint8(observation.images[0])
    return encode_png(pixels if observation.masks is None else tint_masks(pixels, observation.masks[0]))


def view_png(world: Tabletop, camera: Camera, *, with_pusher: bool) -> bytes:
    """What any camera would see."""
    return encode_png(to_uint8(world.render((camera,), with_pusher=with_pusher).images[0]))


def mask_png(world: Tabletop, command: TakeMask) -> bytes:
    """The visible pixels of one object, 0 and 255.

    Raises:
        UnknownName: if there is no such camera or object.
    """
    camera = _camera(command)
    if command.object not in world.names:
        raise UnknownName("object on the table", command.object, world.names)
    masks = world.render((camera,), masks=True).masks
    if masks is None:
        raise InvalidInput("renderer", "without masks", "one that makes masks")
    return encode_png(masks[0][world.names.index(command.object)].astype(np.uint8) * 255)


def _camera(command: TakeImage | TakeMask) -> Camera:
    cameras = {c.name: c for c in (*default_cameras(image_side(command.size)), goal_camera(command.size))}
    if command.camera not in cameras:
        raise UnknownName("camera", command.camera, cameras)
    return cameras[command.camera]
