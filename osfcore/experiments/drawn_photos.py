"""Draw photographs of tables whose poses are known: scans under a hard lamp, through a phone's lens, sensor and JPEG.

Six objects, or as many as there are, lie on a wooden or plain table; two of them are clutter that nobody marks. The
camera stands anywhere in front of the table, as a person would hold it. The picture is blurred, exposed, balanced and
given the tone curve of a phone, which the estimation takes for sRGB; then come noise and JPEG. Further photographs of a
table are taken from other places with the same lens. Folders are written as `osfcore.experiments.photos` reads them,
without depth. Masks are exact.
"""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass, replace
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

_MOST, _MOST_VIEWS = 1000, 8
_OBJECTS, _CLUTTER = 6, 2
_WIDTH, _HEIGHT = 800, 600
_FOCAL = 0.75, 1.3  # of the width: 67 to 42 degrees across
_DISTANCE_M, _ELEVATION_DEG = (0.55, 0.95), (22.0, 65.0)
_AIM_M = 0.06
_APART_DEG = 25.0, 80.0  # by which a further photograph is taken from another side
_AMBIENT, _SPECULAR = (0.15, 0.75), (0.0, 0.25)
_BRIGHT, _LEVEL = 97.0, (0.5, 0.9)  # percentile that is exposed to this level
_BALANCE, _TONE = 0.12, (0.85, 1.2)  # of gains; exponents of the tone curve
_BLUR_PX, _NOISE, _QUALITY = (0.4, 1.1), (0.004, 0.02), (70, 93)
_FEWEST = 400  # pixels of an object that is marked


def write_drawn_photos(library: AssetLibrary, folder: Path, seed: int, count: int, views: int = 1) -> None:
    """Write photographs into folders of their own.

    Args:
        library: with the objects' meshes.
        folder: is made; folders in it are `drawn_000` and so on, `drawn_000_1` for a table's second photograph.
        seed: of everything random.
        count: number of tables.
        views: photographs of each table.

    Raises:
        InvalidInput: if a number is out of range.
    """
    check_ranges(("drawn photographs", count, 1, _MOST), ("photographs of a table", views, 1, _MOST_VIEWS))
    for number in range(count):
        write_drawn_table(library, folder / f"drawn_{number:03d}", seed, number, views)


def write_drawn_table(library: AssetLibrary, folder: Path, seed: int, number: int, views: int = 1) -> None:
    """Write `photo.json`, a photograph and a mask of each object that is marked, for each view of one table.

    Args:
        library: with the objects' meshes.
        folder: of the first view; those of others have its name and their number, `drawn_000_1`.
        seed: of everything random.
        number: of the table.
        views: number of photographs.
    """
    rng = stream_rng(seed, Stream.DRAWN_PHOTO, number)
    wooden = rng.random() < 0.5
    table = TableSurface(texture=wooden_texture(rng)) if wooden else TableSurface(tuple(rng.uniform(0.1, 0.9, 3)))
    ambient = rng.uniform(*_AMBIENT)
    lamp = Lamp(ambient, 1 - ambient, specular=rng.uniform(*_SPECULAR))
    first, conditions = _Place.drawn(rng), Conditions(lamp=lamp, table=table)
    hands = [rng, *(stream_rng(seed, Stream.DRAWN_PHOTO, number, view) for view in range(1, views))]
    cameras = tuple((first.beside(hand) if k else first).camera(f"photo{k}") for k, hand in enumerate(hands))
    count = min(_OBJECTS, len(library.names()))
    request = SceneRequest(count=count)
    with closing(Tabletop(library, cameras=cameras, request=request, conditions=conditions)) as world:
        world.arrange(stream_seed(seed, Stream.DRAWN_PHOTO, number))
        seen, truth = world.render(cameras, masks=True, with_pusher=False), world.truth()
    assert seen.masks is not None
    for view, (camera, hand) in enumerate(zip(cameras, hands, strict=True)):
        place = folder.with_name(f"{folder.name}_{view}") if view else folder
        place.mkdir(parents=True, exist_ok=True)
        Image.fromarray(_taken(seen.images[view], hand)).save(
            place / "photo.jpg", quality=int(hand.integers(*_QUALITY)), subsampling=2
        )
        marked = {}
        for k, name in enumerate(truth.names[: max(count - _CLUTTER, 1)]):
            mask = seen.masks[view, k]
            if mask.sum() >= _FEWEST and not (mask[[0, -1]].any() or mask[:, [0, -1]].any()):
                cv2.imwrite(str(place / f"mask_{name}.png"), 255 * mask.astype(np.uint8))
                marked[name] = camera.T_world_camera.inverse() @ truth.pose(name)
        poses = {n: {"position": p.position.tolist(), "quaternion": p.quaternion.tolist()} for n, p in marked.items()}
        write_json(
            place / "photo.json",
            {
                "image": "photo.jpg",
                "K": camera.intrinsics.tolist(),
                "masks": {name: f"mask_{name}.png" for name in marked},
                "poses_camera_object": {"ground_truth": poses},
                "T_table_camera": camera.T_world_camera.matrix().tolist(),
                **({"table": folder.name} if views > 1 else {}),
            },
        )


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a person holds the phone, and its focal length.

    Attributes:
        azimuth, elevation: of the way from the aim to the camera [rad].
        distance: from it [m].
        aim: x and y of the point of the table that is looked at [m].
        focal: [px].
    """

    azimuth: float
    elevation: float
    distance: float
    aim: tuple[float, float]
    focal: float

    @staticmethod
    def drawn(rng: np.random.Generator) -> _Place:
        azimuth, elevation = rng.uniform(-np.pi, np.pi), math.radians(rng.uniform(*_ELEVATION_DEG))
        distance, (x, y) = rng.uniform(*_DISTANCE_M), rng.uniform(-_AIM_M, _AIM_M, 2)
        return _Place(azimuth, elevation, distance, (x, y), rng.uniform(*_FOCAL) * _WIDTH)

    def beside(self, rng: np.random.Generator) -> _Place:
        """Return another place with the same lens."""
        apart = math.radians(rng.uniform(*_APART_DEG)) * rng.choice((-1, 1))
        return replace(_Place.drawn(rng), azimuth=self.azimuth + apart, focal=self.focal)

    def camera(self, name: str) -> Camera:
        level, aim = math.cos(self.elevation), np.array([*self.aim, 0.03])
        way = np.array([level * math.cos(self.azimuth), level * math.sin(self.azimuth), math.sin(self.elevation)])
        pose = Camera.look_at(name, aim + self.distance * way, aim).T_world_camera
        K = np.array([[self.focal, 0, _WIDTH / 2], [0, self.focal, _HEIGHT / 2], [0, 0, 1]])
        return Camera(name, pose, K, _WIDTH, _HEIGHT)


def _taken(image: Float[np.ndarray, "h w 3"], rng: np.random.Generator) -> np.ndarray:
    """Return a view as a phone stores it, in eight bits."""
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), rng.uniform(*_BLUR_PX))
    gain = rng.uniform(*_LEVEL) / np.percentile(image, _BRIGHT) * np.exp(rng.normal(0, _BALANCE, 3))
    exposed = gain * image
    noise = rng.uniform(*_NOISE) * np.sqrt(np.maximum(exposed, 0.02))
    exposed = np.clip(exposed + noise * rng.standard_normal(image.shape), 0, 1)
    return to_uint8(srgb_of_linear(exposed ** rng.uniform(*_TONE)))
