"""Compare lamps that are estimated from simulated photographs with true ones; poses come from masks alone.

Three objects lie on a table under a lamp: a near one with a cone, or a distant one for comparison. Up to four views
are taken, exposed such that little is saturated, with a white balance of their own, noise, and eight bits of sRGB.
Masks are exact.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.errors import check_ranges, check_seed
from osfcore.estimation.camera_response import linear_from_encoded, srgb_of_linear
from osfcore.experiments.harness import EvaluationStep
from osfcore.experiments.statistics import mean, median, spread
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light, SpotLamp
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE
from osfcore.photo.lamp import photo_lamp
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses import FINE_ACROSS, PhotoModels, estimate_photo
from osfcore.random_streams import Stream, stream_rng, stream_seed
from osfcore.world.imaging import Lamp, TableSurface, wooden_texture
from osfcore.world.scenes import Conditions, SceneRequest
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
    """Draw a scene and take its photographs.

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
    with closing(Tabletop(library, cameras=chosen, request=request, conditions=conditions)) as world:
        world.arrange(stream_seed(seed, Stream.LAMP_SCENE, number, int(is_near)))
        observed, truth = world.render(chosen, masks=True, with_pusher=False), world.truth()
    photos = tuple(_taken(observed, k, rng) for k in range(views))
    poses = {name: truth.pose(name) for name in truth.names if any(name in photo.masks for photo in photos)}
    return LampScene(photos, poses, spot if is_near else None, light.direction)


def random_spot(rng: np.random.Generator) -> SpotLamp:
    """Draw a near lamp that is aimed at the table, about its centre."""
    distance = float(np.exp(rng.uniform(*np.log(_DISTANCES_M))))
    azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(*_ELEVATIONS_DEG))
    aim = np.array([*rng.uniform(-_AIM_M, _AIM_M, 2), 0.0])
    outer = rng.uniform(*_OUTER_DEG)
    place = distance * Light.from_angles(azimuth, elevation).direction
    return SpotLamp(place, aim, outer * rng.uniform(*_INNER_SHARE), outer)


def _taken(observed: Observation, view: int, rng: np.random.Generator) -> Photograph:
    """Return a view as a camera stores it."""
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


# The evaluation.


_RIGHT_DEG, _RIGHT_PERCENT = 5.0, 15.0
_CLOSE_M, _CLOSE_DEG = 0.015, 10.0
_FAR_EVERY = 4  # near lamps there is a distant one
_OF = ("mean", "median", "p90", "max")
_MOST_TASKS = 1000
_MOST_VIEWS = 4


@dataclass(frozen=True, slots=True)
class EvaluateLamps:
    """What to measure.

    Attributes:
        folder: for report.json.
        tasks: scenes with a near lamp; a fourth as many, rounded up, have a distant one. Every other table is of wood.
        views: photographs of each scene.
        seed: of everything random.
    """

    folder: Path
    tasks: int = 20
    views: int = 1
    seed: int = 0


@dataclass(frozen=True, slots=True)
class LampScore:
    """Errors of the lamp of one scene.

    Attributes:
        number: of the scene.
        is_near: whether its lamp is near.
        is_wooden: whether its table has a grain.
        direction_deg: error of the direction, seen from the table's centre.
        std_deg: its estimated standard deviation.
        true_m: distance from there; None for a distant lamp.
        distance_m: that was estimated; None if it cannot be determined.
        aim_mm: from the point that the lamp looks at to the estimated one; None for a distant lamp, or where the end of
            its cone is not seen.
        is_diffuse: the light was called diffuse.
        poses: objects that were found.
        right_poses: of them, those within 15 mm and 10 deg, symmetries counted.
        seconds: that the lamp took.
    """

    number: int
    is_near: bool
    is_wooden: bool
    direction_deg: float
    std_deg: float
    true_m: float | None
    distance_m: float | None
    aim_mm: float | None
    is_diffuse: bool
    poses: int
    right_poses: int
    seconds: float

    @property
    def distance_percent(self) -> float | None:
        """Error of the distance as a share of the true one [%]; None where either is unknown."""
        if self.true_m is None or self.distance_m is None:
            return None
        return 100 * abs(self.distance_m / self.true_m - 1)


def lamp_report(scores: Sequence[LampScore]) -> dict[str, Any]:
    """Return figures by name, None where nothing is known, and the scores that they come from."""
    near, far = ([s for s in scores if s.is_near is is_near] for is_near in (True, False))
    angles = [s.direction_deg for s in near]
    known = [p for s in near if (p := s.distance_percent) is not None]
    return {
        "lamp_tasks": len(near),
        **spread("lamp_direction_deg", angles, _OF),
        **spread("lamp_distance_percent", known, _OF),
        **spread("lamp_aim_mm", [s.aim_mm for s in near if s.aim_mm is not None], _OF),
        "lamp_undetermined": sum(s.distance_m is None for s in near),
        "lamp_diffuse": sum(s.is_diffuse for s in near),
        "lamp_within_5deg": mean(a <= _RIGHT_DEG for a in angles),
        "lamp_within_15percent": mean(p <= _RIGHT_PERCENT for p in known),
        "distant_tasks": len(far),
        **spread("distant_direction_deg", [s.direction_deg for s in far], _OF),
        "distant_undetermined": sum(s.distance_m is None for s in far),
        "poses_total": sum(s.poses for s in scores),
        "poses_15mm_10deg": sum(s.right_poses for s in scores) / max(sum(s.poses for s in scores), 1),
        "lamp_s_median": median(s.seconds for s in scores),
        "scores": [asdict(s) for s in scores],
    }


def evaluate_lamps(config: EvaluateLamps, library: AssetLibrary, fields: FieldLibrary) -> Iterator[EvaluationStep]:
    """Estimate the lamps of random scenes; report.json goes to `config.folder`.

    Args:
        config: what to measure.
        library: of the objects' meshes.
        fields: of the objects; those without one are left out.

    Raises:
        InvalidInput: if a number is out of range, or fewer than three objects have a field and a mesh.
        CannotWrite: if the report cannot be written.
    """
    check_seed(config.seed)
    check_ranges(("scenes", config.tasks, 1, _MOST_TASKS), ("photographs of each scene", config.views, 1, _MOST_VIEWS))
    names = sorted(set(fields.names()) & set(library.names()))
    models = PhotoModels({name: fields.load(name) for name in names})
    cases = [(True, k) for k in range(config.tasks)] + [(False, k) for k in range(-(-config.tasks // _FAR_EVERY))]
    scores: list[LampScore] = []
    for done, (is_near, number) in enumerate(cases):
        yield EvaluationStep(done, len(cases), f"A {'near' if is_near else 'distant'} lamp")
        wooden = bool(number % 2)
        scene = lamp_scene(library, names, config.seed, number, config.views, is_near=is_near, is_wooden=wooden)
        rng = stream_rng(config.seed, Stream.PHOTO_SEARCH, number, int(is_near))
        scores.append(_score(models, scene, number, rng, is_wooden=wooden))
    report = lamp_report(scores)
    write_json(config.folder / "report.json", report)
    yield EvaluationStep(len(cases), len(cases), "Everything is measured", report)


def _score(
    models: PhotoModels, scene: LampScene, number: int, rng: np.random.Generator, *, is_wooden: bool
) -> LampScore:
    *_, last = estimate_photo(models, scene.photos, tuple(scene.poses), rng)
    surfels = [models.surfels(name, FINE_ACROSS) for name in scene.poses]
    start = time.perf_counter()
    found = photo_lamp(scene.photos, last.found, surfels)
    seconds = time.perf_counter() - start
    aim_mm = None
    if scene.spot is not None and found.distance_known and found.shape.radius is not None:
        aim_mm = 1e3 * float(np.linalg.norm(found.shape.aim_point - scene.spot.aim))
    right = 0
    for one in last.found:
        true, pose = scene.poses[one.name], one.best.pose
        turn_rad = rotation_error(CATALOGUE[one.name].symmetry, pose.quaternion, true.quaternion)
        is_close = np.linalg.norm(pose.position - true.position) <= _CLOSE_M
        right += bool(is_close and np.rad2deg(turn_rad) <= _CLOSE_DEG)
    return LampScore(
        number=number,
        is_near=scene.spot is not None,
        is_wooden=is_wooden,
        direction_deg=float(np.rad2deg(np.arccos(np.clip(found.direction @ scene.direction, -1, 1)))),
        std_deg=float(np.rad2deg(found.std)),
        true_m=None if scene.spot is None else scene.spot.distance,
        distance_m=found.distance if found.distance_known else None,
        aim_mm=aim_mm,
        is_diffuse=found.is_diffuse,
        poses=len(last.found),
        right_poses=right,
        seconds=seconds,
    )
