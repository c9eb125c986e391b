"""One object from all around in one picture, by the project's own image model: what a thumbnail turns through."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.geometry.cameras import Camera
from osfcore.io.image_file import to_uint8
from osfcore.objects.asset import TexturedMesh
from osfcore.world.imaging.ray_tracer import RayTracer
from osfcore.world.imaging.traced_mesh import TracedMesh

VIEWS, SIDE = 24, 96
_FIELD_OF_VIEW_DEG = 24.0
_ELEVATION_RAD = np.deg2rad(22.0)
_LIGHT_TURN_RAD, _LIGHT_ELEVATION_RAD = np.deg2rad(-50.0), np.deg2rad(48.0)  # from the left, above the camera


def turntable(mesh: TexturedMesh, views: int = VIEWS, side: int = SIDE) -> UInt8[np.ndarray, "side width 4"]:
    """Views of an object that turns once under a lamp that stays, side by side.

    Args:
        mesh: the object.
        views: how many, 360 / views degrees apart.
        side: of each [px].

    Returns:
        RGBA, transparent around the object; not premultiplied.
    """
    traced = TracedMesh(mesh)
    tracer = RayTracer({"object": traced})
    distance = 1.02 * traced.radius_m / np.sin(np.deg2rad(_FIELD_OF_VIEW_DEG) / 2)
    pictures = []
    for azimuth in 2 * np.pi * np.arange(views) / views:
        position = distance * _direction(azimuth, _ELEVATION_RAD)
        camera = Camera.look_at("turn", position, (0, 0, 0), size=side, fov_y_deg=_FIELD_OF_VIEW_DEG)
        light = _direction(azimuth + _LIGHT_TURN_RAD, _LIGHT_ELEVATION_RAD)
        picture = tracer.render_alone("object", light, camera)
        alpha = picture.coverage[0]
        colour = picture.rgb / np.maximum(alpha, 1e-3)[..., None]
        pictures.append(np.concatenate([to_uint8(colour), to_uint8(alpha)[..., None]], axis=-1))
    return np.concatenate(pictures, axis=1)


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    level = np.cos(elevation)
    return np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])


def turntable_png(mesh: TexturedMesh) -> bytes:
    """The same as PNG."""
    picture = turntable(mesh)
    in_file_order = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
    return cv2.imencode(".png", in_file_order, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()
