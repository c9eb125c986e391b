"""Draw photographs of tables whose poses are known: scans under a hard lamp, through a phone's lens, sensor and JPEG.

Six objects lie on a wooden or plain table; two of them are clutter that nobody marks. The camera stands anywhere in
front of the table, as a person would hold it. The picture is blurred, exposed, balanced and given the tone curve of a
phone, which the estimation takes for sRGB; then come noise and JPEG. Folders are written as
`osfcore.experiments.photos` reads them, without depth. Masks are exact.
"""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from osfcore.errors import check_ranges
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng, stream_seed
from osfcore.world.imaging import Lamp, TableSurface, wooden_texture
from osfcore.world.scenes import Conditions, SceneRequest
from osfcore.world.tabletop import Tabletop

_MOST = 1000
_OBJECTS, _CLUTTER = 6, 2
_WIDTH, _HEIGHT = 800, 600
_FOCAL = 0.75, 1.3  # of the width: 67 to 42 degrees across
_DISTANCE_M, _ELEVATION_DEG = (0.55, 0.95), (22.0, 65.0)
_AIM_M = 0.06
_AMBIENT, _SPECULAR = (0.15, 0.75), (0.0, 0.25)
_BRIGHT, _LEVEL = 97.0, (0.5, 0.9)  # percentile that is exposed to this level
_BALANCE, _TONE = 0.12, (0.85, 1.2)  # of gains; exponents of the tone curve
_BLUR_PX, _NOISE, _QUALITY = (0.4, 1.1), (0.004, 0.02), (70, 93)
_FEWEST = 400  # pixels of an object that is marked


def write_drawn_photos(library: AssetLibrary, folder: Path, seed: int, count: int) -> None:
    """Write photographs into folders of their own.

    Args:
        library: with the objects' meshes.
        folder: is made; folders in it are `drawn_000` and so on.
        seed: of everything random.
        count: number of photographs.

    Raises:
        InvalidInput: if the number is out of range.
    """
    check_ranges(("drawn photographs", count, 1, _MOST))
    for number in range(count):
        place = folder / f"drawn_{number:03d}"
        place.mkdir(parents=True, exist_ok=True)
        write_drawn_photo(library, place, seed, number)


def write_drawn_photo(library: AssetLibrary, folder: Path, seed: int, number: int) -> None:
    """Write `photo.json`, a photograph and a mask of each object that is marked.

    Args:
        library: with the objects' meshes.
        folder: must exist.
        seed: of everything random.
        number: of the photograph.
    """
    rng = stream_rng(seed, Stream.DRAWN_PHOTO, number)
    wooden = rng.random() < 0.5
    table = TableSurface(texture=wooden_texture(rng)) if wooden else TableSurface(tuple(rng.uniform(0.1, 0.9, 3)))
    ambient = rng.uniform(*_AMBIENT)
    lamp = Lamp(ambient, 1 - ambient, specular=rng.uniform(*_SPECULAR))
    camera, conditions = _camera(rng), Conditions(lamp=lamp, table=table)
    request = SceneRequest(count=_OBJECTS)
    with closing(Tabletop(library, cameras=(camera,), request=request, conditions=conditions)) as world:
        world.arrange(stream_seed(seed, Stream.DRAWN_PHOTO, number))
        seen, truth = world.render((camera,), masks=True, with_pusher=False), world.truth()
    assert seen.masks is not None
    Image.fromarray(_taken(seen.images[0], rng)).save(
        folder / "photo.jpg", quality=int(rng.integers(*_QUALITY)), subsampling=2
    )
    marked = {}
    for k, name in enumerate(truth.names[: _OBJECTS - _CLUTTER]):
        mask = seen.masks[0, k]
        if mask.sum() >= _FEWEST and not (mask[[0, -1]].any() or mask[:, [0, -1]].any()):
            cv2.imwrite(str(folder / f"mask_{name}.png"), 255 * mask.astype(np.uint8))
            marked[name] = camera.T_world_camera.inverse() @ truth.pose(name)
    poses = {n: {"position": p.position.tolist(), "quaternion": p.quaternion.tolist()} for n, p in marked.items()}
    write_json(
        folder / "photo.json",
        {
            "image": "photo.jpg",
            "K": camera.intrinsics.tolist(),
            "masks": {name: f"mask_{name}.png" for name in marked},
            "poses_camera_object": {"ground_truth": poses},
        },
    )


def _camera(rng: np.random.Generator) -> Camera:
    azimuth, elevation = rng.uniform(-np.pi, np.pi), math.radians(rng.uniform(*_ELEVATION_DEG))
    distance, aim = rng.uniform(*_DISTANCE_M), np.array([*rng.uniform(-_AIM_M, _AIM_M, 2), 0.03])
    way = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    focal = rng.uniform(*_FOCAL) * _WIDTH
    pose = Camera.look_at("photo", aim + distance * way, aim).T_world_camera
    return Camera(
        "photo", pose, np.array([[focal, 0, _WIDTH / 2], [0, focal, _HEIGHT / 2], [0, 0, 1]]), _WIDTH, _HEIGHT
    )


def _taken(image: Float[np.ndarray, "h w 3"], rng: np.random.Generator) -> np.ndarray:
    """Return a view as a phone stores it, in eight bits."""
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), rng.uniform(*_BLUR_PX))
    gain = rng.uniform(*_LEVEL) / np.percentile(image, _BRIGHT) * np.exp(rng.normal(0, _BALANCE, 3))
    exposed = gain * image
    noise = rng.uniform(*_NOISE) * np.sqrt(np.maximum(exposed, 0.02))
    exposed = np.clip(exposed + noise * rng.standard_normal(image.shape), 0, 1)
    return to_uint8(srgb_of_linear(exposed ** rng.uniform(*_TONE)))
