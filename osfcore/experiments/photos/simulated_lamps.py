"""Simulated photographs of a table under a lamp: near ones with a cone, and distant ones for comparison.

Three objects lie on the table; up to four views are taken, exposed such that little is saturated, with a white balance
of their own, noise, and eight bits of sRGB. Masks are exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from osfcore.estimation.photometry.camera_response import linear_from_encoded, srgb_of_linear
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.spot_lamp import SpotLamp
from osfcore.geometry.states import Observation
from osfcore.io.image_file import to_uint8
from osfcore.objects.asset_library import AssetLibrary
from osfcore.photo.photograph import Photograph
from osfcore.random_streams import Stream, stream_rng, stream_seed
from osfcore.world.conditions import Conditions
from osfcore.world.imaging.optics import Lamp, TableSurface
from osfcore.world.imaging.wood import wooden_texture
from osfcore.world.scene_request import SceneRequest
from osfcore.world.tabletop import Tabletop

_OBJECTS = 3
_SIDE = 320  # of a photograph [px]
_DISTANCES_M, _ELEVATIONS_DEG = (0.4, 1.5), (20.0, 80.0)
_AIM_M = 0.05
_OUTER_DEG, _INNER_SHARE = (20.0, 50.0), (0.5, 0.9)
_AMBIENT = 0.1, 0.5  # over ambient and diffuse together
_BRIGHT, _LEVEL = 99.0, (0.6, 0.95)  # percentile that is exposed to this level
_BALANCE, _NOISE = 0.1, 0.004
_FEWEST = 100  # pixels of an object; what shows less is not marked
_SATURATED, _BLACK = 251, 2  # of eight bits


@dataclass(frozen=True, eq=False, slots=True)
class LampScene:
    """Photographs of one table, and the truth.

    Attributes:
        photos: of one scene, on the table.
        poses: of the objects that are seen, in the world.
        spot: the lamp; None if it is distant.
        direction: unit vector from the table's centre toward the lamp.
    """

    photos: tuple[Photograph, ...]
    poses: Mapping[str, Pose]
    spot: SpotLamp | None
    direction: np.ndarray


def lamp_scene(
    library: AssetLibrary, among: Sequence[str], seed: int, number: int, views: int, *, is_near: bool, is_wooden: bool
) -> LampScene:
    """One scene and its photographs.

    Args:
        library: of meshes.
        among: which objects there are to choose from.
        seed: of everything random.
        number: of the scene.
        views: 1 to 4.
        is_near: whether its lamp is near.
        is_wooden: whether the table has a grain; it has one colour otherwise.
    """
    rng = stream_rng(seed, Stream.LAMP_SCENE, number, int(is_near))
    spot = random_spot(rng)
    light = spot.distant
    ambient = rng.uniform(*_AMBIENT)
    table = TableSurface(texture=wooden_texture(rng)) if is_wooden else TableSurface(tuple(rng.uniform(0.3, 0.8, 3)))
    conditions = Conditions(lamp=Lamp(ambient, 1 - ambient), table=table, spot=spot if is_near else None)
    request = SceneRequest(count=_OBJECTS, light=Light(light.position), among=tuple(among))
    cameras = default_cameras(_SIDE)
    first = int(rng.integers(len(cameras)))
    chosen = tuple(cameras[(first + k) % len(cameras)] for k in range(views))
    world = Tabletop(library, cameras=chosen, request=request, conditions=conditions)
    try:
        world.arrange(stream_seed(seed, Stream.LAMP_SCENE, number, int(is_near)))
        observed, truth = world.render(chosen, masks=True, with_pusher=False), world.truth()
    finally:
        world.close()
    photos = tuple(_taken(observed, k, rng) for k in range(views))
    poses = {name: truth.pose(name) for name in truth.names if any(name in photo.masks for photo in photos)}
    return LampScene(photos, poses, spot if is_near else None, light.direction)


def random_spot(rng: np.random.Generator) -> SpotLamp:
    """A near lamp that looks at the table, about its centre."""
    distance = float(np.exp(rng.uniform(*np.log(_DISTANCES_M))))
    azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(*_ELEVATIONS_DEG))
    aim = np.array([*rng.uniform(-_AIM_M, _AIM_M, 2), 0.0])
    outer = rng.uniform(*_OUTER_DEG)
    place = distance * Light.from_angles(azimuth, elevation).direction
    return SpotLamp(place, aim, outer * rng.uniform(*_INNER_SHARE), outer)


def _taken(observed: Observation, view: int, rng: np.random.Generator) -> Photograph:
    """A view as a camera stores it."""
    assert observed.masks is not None
    image, camera = observed.images[view], observed.cameras[view]
    gain = rng.uniform(*_LEVEL) / np.percentile(image, _BRIGHT) * np.exp(rng.normal(0, _BALANCE, 3))
    noisy = gain * image + rng.normal(0, _NOISE, image.shape)
    stored = to_uint8(srgb_of_linear(np.clip(noisy, 0, 1)))
    linear = linear_from_encoded(stored / 255.0, "srgb").astype(np.float32)
    exposed = np.all(stored < _SATURATED, axis=-1) & np.any(stored > _BLACK, axis=-1)
    shown = {name: observed.masks[view, k] for k, name in enumerate(observed.names)}
    masks = {name: mask for name, mask in shown.items() if mask.sum() >= _FEWEST}
    return Photograph(linear, exposed, camera.intrinsics, camera.T_world_camera, True, masks)
