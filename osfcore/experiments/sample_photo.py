"""The sample photograph of the page: real scans on a wooden table, lit and seen as no goal camera sees its table.

It is drawn with the ray tracer and encoded as a phone encodes, with the focal length in its EXIF data. Its boxes are as
a person would drag them.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.imaging import Lamp, RayTracer, TableSurface, TracedMesh, masks_of, wooden_texture

PHOTO, BOXES = "table.jpg", "table.json"
_STANDING = {  # x, y [m], and by how much each is turned [deg]
    "003_cracker_box": (-0.07, 0.06, -35.0), "006_mustard_bottle": (0.11, 0.04, 160.0),
    "005_tomato_soup_can": (0.05, -0.12, 100.0),
}  # fmt: skip
_WIDTH, _HEIGHT = 1024, 768
_EQUIVALENT_MM, _FILM_DIAGONAL_MM = 28, 43.27  # of a phone
_PLACE, _TARGET = (0.22, -0.5, 0.36), (0.02, 0.0, 0.06)
_LAMP_AZIMUTH_DEG, _LAMP_ELEVATION_DEG = 215.0, 40.0
_MARGIN = 6  # around an object [px]


def write_sample_photo(library: AssetLibrary, folder: Path) -> None:
    """Write `table.jpg`, and in `table.json` a box around each object, by name: left, top, right, bottom [px].

    Args:
        library: with the objects' meshes.
        folder: must exist.
    """
    surface = TableSurface(texture=wooden_texture(stream_rng(0, Stream.SAMPLE_WOOD)))
    meshes = {name: TracedMesh(library.load(name).mesh) for name in _STANDING}
    tracer = RayTracer(meshes, lamp=Lamp(intensity=0.9, colour=(1.0, 0.93, 0.82)), table=surface)
    (seen,) = tracer.render(_state(library), (_camera(),))
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = _EQUIVALENT_MM
    picture = Image.fromarray(to_uint8(srgb_of_linear(np.clip(seen.rgb, 0, 1))))
    picture.save(folder / PHOTO, quality=82, optimize=True, exif=exif)
    boxes = {name: _box(mask) for name, mask in zip(_STANDING, masks_of(seen, len(_STANDING)), strict=True)}
    write_json(folder / BOXES, boxes)


def _state(library: AssetLibrary) -> SceneState:
    places = [(x, y, library.size_m(name)[2] / 2) for name, (x, y, _) in _STANDING.items()]
    turns = [quaternion_exp(np.array([0.0, 0.0, math.radians(turn)])) for _, _, turn in _STANDING.values()]
    light = Light.from_angles(math.radians(_LAMP_AZIMUTH_DEG), math.radians(_LAMP_ELEVATION_DEG))
    return SceneState(tuple(_STANDING), Pose(np.array(places), np.array(turns)), light, None)


def _camera() -> Camera:
    focal = _EQUIVALENT_MM / _FILM_DIAGONAL_MM * math.hypot(_WIDTH, _HEIGHT)
    pose = Camera.look_at("photo", _PLACE, _TARGET).T_world_camera
    K = np.array([[focal, 0, _WIDTH / 2], [0, focal, _HEIGHT / 2], [0, 0, 1]])
    return Camera("photo", pose, K, _WIDTH, _HEIGHT)


def _box(mask: np.ndarray) -> list[int]:
    rows, columns = np.nonzero(mask)
    left, top = int(columns.min()) - _MARGIN, int(rows.min()) - _MARGIN
    right, bottom = int(columns.max()) + 1 + _MARGIN, int(rows.max()) + 1 + _MARGIN
    return [max(left, 0), max(top, 0), min(right, _WIDTH), min(bottom, _HEIGHT)]
