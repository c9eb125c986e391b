"""One observation of a random scene, as anybody's cameras might have taken it, with the truth beside it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from osfcore.errors import InvalidInput, check_seed
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera, image_side
from osfcore.geometry.states import MAX_OBJECTS, Observation
from osfcore.io.files import folder_at_once, write_json
from osfcore.io.observation_file import write_observation
from osfcore.io.scene_file import Scene, scene_to_json
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.scene_request import SceneRequest
from osfcore.world.tabletop import Tabletop

TRUTH_FILE = "truth.json"


@dataclass(frozen=True, slots=True)
class CollectObservation:
    """An observation of a random scene.

    Attributes:
        out: folder to write; must not exist or be empty.
        names: the objects, or None for a random choice.
        objects: how many objects, where `names` is None.
        seed: of choice, scene and light.
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
    out = config.out.absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InvalidInput("output folder", out, "new or empty")
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
    _write(out, observation, truth)
    return observation


def _names(config: CollectObservation, library: AssetLibrary, known: Collection[str] | None) -> tuple[str, ...] | None:
    """The objects; None leaves the choice, or the complaint that there are none, to the world."""
    if config.names is not None or known is None:
        return config.names
    choice = [name for name in library.names() if name in known]
    if not choice:
        return None
    most = min(len(choice), MAX_OBJECTS)
    if not 1 <= config.objects <= most:
        raise InvalidInput("number of objects", config.objects, f"between 1 and {most}")
    rng = stream_rng(config.seed, Stream.COLLECTED_NAMES)
    return tuple(choice[i] for i in rng.choice(len(choice), config.objects, replace=False))


def _write(out: Path, observation: Observation, truth: dict[str, object]) -> None:
    """Truth and observation, all or nothing."""
    with folder_at_once(out) as partial:
        write_json(partial / TRUTH_FILE, truth)
        write_observation(partial, observation)
