"""Image sets and observations of the simulated table, as files."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, check_ranges, check_seed
from osfcore.geometry.cameras import (
    DEFAULT_IMAGE_SIDE,
    FIELD_OF_VIEW_DEG,
    SCENE_CENTRE,
    Camera,
    default_cameras,
    goal_camera,
    image_side,
)
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import MAX_OBJECTS, Observation, SceneState
from osfcore.io.files import folder_at_once, new_folder, write_json, writing
from osfcore.io.image_file import to_uint8
from osfcore.io.observation_file import write_observation
from osfcore.io.scene_file import Scene, scene_to_json
from osfcore.objects.asset_library import AssetLibrary
from osfcore.progress import Progress
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.imaging import RayTracer, TracedMesh
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

# Image sets for training fields: one object alone, or the bare table, under many lights, in the OSF format.
#
# Layout: DIR/{train,test}/anno.json, a list of dicts (`filename`, `RT` 3 x 4 world-to-camera in OpenCV axes, `K` 3
# x 3, `light_pos` 3-vector in the world, `resolution`), with 8-bit RGBA PNGs beside it. The world of an object set
# is the object's frame. Every image has its own view and its own light, drawn independently for train and test.

FRAME_FILL = 0.87  # share of the image's side that the bounding sphere spans
TEST_IMAGES = 40
MIN_IMAGES = 60
MAX_IMAGES = 5000
_SAMPLES = 4
TRUTH_FILE = "truth.json"
# Makes an image from a random generator, its number in the split and the size of the split. Returns the camera, the
# light's position, and RGBA (h, w, 4).
Shoot = Callable[[np.random.Generator, int, int], tuple[Camera, np.ndarray, np.ndarray]]


@dataclass(frozen=True, slots=True)
class CollectObject:
    """Images of one object.

    Attributes:
        name: which object.
        out: folder to write; must not exist or be empty.
        images: train and test images together; one in eight, at least 40, are for testing.
        size: side of the square images [px].
        seed: seed of views and lights.
    """

    name: str
    out: Path
    images: int = 300
    size: int = DEFAULT_IMAGE_SIDE
    seed: int = 0


@dataclass(frozen=True, slots=True)
class CollectTable:
    """Images of the bare table.

    Attributes:
        out: folder to write; must not exist or be empty.
        images: train and test images together; one in eight, at least 40, are for testing.
        size: side of the square images [px].
        seed: seed of views and lights.
    """

    out: Path
    images: int = 300
    size: int = DEFAULT_IMAGE_SIDE
    seed: int = 0


def collect_object(config: CollectObject, library: AssetLibrary) -> Iterator[Progress]:
    """Write the images of one object, from all sides under lights from all directions.

    Raises:
        UnknownName, MissingAssets: if the object is not in the library.
        InvalidInput: if a number is out of range or the folder is not empty.
    """
    library.check(config.name)
    mesh = TracedMesh(library.load(config.name).mesh)
    tracer = RayTracer({config.name: mesh})
    # The cone that touches the sphere has half-angle asin(radius / distance).
    half_angle = np.arctan(FRAME_FILL * np.tan(np.deg2rad(FIELD_OF_VIEW_DEG) / 2))
    distance = mesh.radius_m / np.sin(half_angle)

    def shoot(rng: np.random.Generator, number: int, count: int) -> tuple[Camera, np.ndarray, np.ndarray]:
        camera = Camera.look_at("view", distance * _spread(rng, number, count), (0, 0, 0), size=config.size)
        light = _spread(rng, int(rng.integers(count)), count)  # the unit vector toward it
        picture = tracer.render_alone(config.name, light, camera, samples=_SAMPLES)
        alpha = picture.coverage[0]
        own_colour = picture.rgb / np.maximum(alpha, 1e-6)[..., None]  # straight alpha
        return camera, light, np.concatenate([own_colour, alpha[..., None]], axis=-1)

    yield from _write_set(config, shoot, config.name)


def collect_table(config: CollectTable) -> Iterator[Progress]:
    """Write images of the bare table: half from the default and goal cameras, half from anywhere above the table.

    Images are opaque, the background beyond the table's edge included: they are what a scene's camera sees.

    Raises:
        InvalidInput: if a number is out of range or the folder is not empty.
    """
    tracer = RayTracer({})
    fixed = (*default_cameras(image_side(config.size)), goal_camera(config.size))
    nothing = Pose(np.zeros((0, 3)), np.zeros((0, 4)))

    def shoot(rng: np.random.Generator, number: int, count: int) -> tuple[Camera, np.ndarray, np.ndarray]:
        light = Light.random(rng, MIN_LIGHT_ELEVATION_DEG)
        camera = fixed[(number // 2) % len(fixed)] if number % 2 == 0 else _anywhere(rng, config.size)
        (picture,) = tracer.render(SceneState((), nothing, light, None), (camera,), samples=_SAMPLES)
        opaque = np.ones((config.size, config.size, 1), np.float32)
        return camera, light.position, np.concatenate([picture.rgb, opaque], axis=-1)

    yield from _write_set(config, shoot, "table")


def _write_set(config: CollectObject | CollectTable, shoot: Shoot, what: str) -> Iterator[Progress]:
    """Write both splits into a folder, which takes its name only when everything is there."""
    image_side(config.size)
    images = config.images
    check_ranges(("number of images", images, MIN_IMAGES, MAX_IMAGES))
    if config.seed < 0:
        raise InvalidInput("seed", config.seed, "0 or more")
    out = new_folder(config.out)
    test = max(TEST_IMAGES, images // 8)
    done = 0
    with writing(out), folder_at_once(out) as partial:
        for part, (split, count) in enumerate((("train", images - test), ("test", test))):
            rng = stream_rng(config.seed, Stream.COLLECTED_IMAGES, part)
            folder = partial / split
            folder.mkdir(parents=True)
            annotations = []
            for number in range(count):
                camera, light, rgba = shoot(rng, number, count)
                annotations.append(_save(folder / f"{number:04d}.png", camera, light, rgba))
                done += 1
                yield Progress(done, images, f"Image {done} of {images} of {what}")
            (folder / "anno.json").write_text(json.dumps(annotations), encoding="utf-8")


def _save(path: Path, camera: Camera, light: np.ndarray, rgba: Float[np.ndarray, "h w 4"]) -> dict[str, object]:
    """Write one image; return its entry in anno.json."""
    if not cv2.imwrite(str(path), cv2.cvtColor(to_uint8(rgba), cv2.COLOR_RGBA2BGRA)):
        raise OSError(f"{path.name} could not be written")
    return {
        "filename": path.name,
        "RT": camera.T_world_camera.inverse().matrix()[:3].tolist(),
        "K": camera.intrinsics.tolist(),
        "light_pos": np.asarray(light, float).tolist(),
        "resolution": camera.width,
    }


def _spread(rng: np.random.Generator, number: int, count: int) -> Float[np.ndarray, "3"]:
    """Draw one of `count` unit vectors that cover the sphere evenly: a point of the number-th of equal-area rings."""
    return _at_height(rng, 1 - 2 * (number + rng.uniform()) / count)


def _at_height(rng: np.random.Generator, z: float) -> Float[np.ndarray, "3"]:
    """Draw a unit vector with a given z."""
    angle = rng.uniform(-np.pi, np.pi)
    radius = np.sqrt(max(1 - z * z, 0))
    return np.array([radius * np.cos(angle), radius * np.sin(angle), z])


def _anywhere(rng: np.random.Generator, size: int) -> Camera:
    """Draw a camera 0.5 to 1.1 m from the table's centre, 15 deg or more above the table, looking near its centre."""
    direction = _at_height(rng, rng.uniform(np.sin(np.deg2rad(15)), 1))
    target = (*rng.uniform(-0.1, 0.1, 2), SCENE_CENTRE[2])
    return Camera.look_at("view", rng.uniform(0.5, 1.1) * direction, target, size=size)


# One observation of a random scene, with the truth beside it.


@dataclass(frozen=True, slots=True)
class CollectObservation:
    """An observation of a random scene.

    Attributes:
        out: folder to write; must not exist or be empty.
        names: the objects, or None for a random choice.
        objects: how many objects, where `names` is None.
        seed: seed of choice, scene and light.
        size: side of the square images [px].
        goal: the goal camera's view alone, without pusher and masks.
    """

    out: Path
    names: tuple[str, ...] | None = None
    objects: int = 3
    seed: int = 0
    size: int = DEFAULT_IMAGE_SIDE
    goal: bool = False


def collect_observation(
    config: CollectObservation, library: AssetLibrary, known: Collection[str] | None = None
) -> Observation:
    """Write observation.json with its images, and truth.json with poses and light, which no estimator may see.

    Args:
        config: what to write.
        library: where the objects' meshes are.
        known: names to choose from at random, among the library's; all of them if None.

    Raises:
        UnknownName, MissingAssets: if an object is not in the library.
        InvalidInput: if a number is out of range or the folder is not empty.
        NoRoom: if the objects do not fit side by side.
        CannotWrite: if the disk refuses.
    """
    image_side(config.size)
    check_seed(config.seed)
    out = new_folder(config.out)
    cameras = (goal_camera(config.size),) if config.goal else default_cameras(config.size)
    world = Tabletop(library, cameras=cameras, request=SceneRequest(_names(config, library, known), config.objects))
    try:
        world.arrange(config.seed)
        observation = world.render(cameras, masks=not config.goal, with_pusher=not config.goal)
        truth = scene_to_json(Scene(world.truth(), cameras))
    finally:
        world.close()
    if config.goal:
        del truth["pusher"]
    with folder_at_once(out) as partial:
        write_json(partial / TRUTH_FILE, truth)
        write_observation(partial, observation)
    return observation


def _names(config: CollectObservation, library: AssetLibrary, known: Collection[str] | None) -> tuple[str, ...] | None:
    """Choose the objects; None leaves the choice, or the error that there are none, to the world."""
    choice = [name for name in library.names() if name in (known or ())]
    if config.names is not None or not choice:
        return config.names
    check_ranges(("number of objects", config.objects, 1, min(len(choice), MAX_OBJECTS)))
    rng = stream_rng(config.seed, Stream.COLLECTED_NAMES)
    return tuple(choice[i] for i in rng.choice(len(choice), config.objects, replace=False))
