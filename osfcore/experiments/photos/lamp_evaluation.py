"""How far lamps that photographs tell are from true ones, in simulated scenes; poses are estimated from masks alone."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.errors import check_ranges, check_seed
from osfcore.experiments.photos.simulated_lamps import LampScene, lamp_scene
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.io.files import write_json
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE
from osfcore.photo.light.photo_light import photo_lamp
from osfcore.photo.poses.estimate_photo import FINE_ACROSS, PhotoModels, estimate_photo
from osfcore.photo.poses.photo_steps import PhotoObject
from osfcore.random_streams import Stream, stream_rng

_RIGHT_DEG, _RIGHT_PERCENT = 5.0, 15.0
_CLOSE_M, _CLOSE_DEG = 0.015, 10.0
_FAR_EVERY = 4  # near lamps there is a distant one
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
    """One scene.

    Attributes:
        number: of the scene.
        is_near: whether its lamp is near.
        is_wooden: whether its table has a grain.
        direction_deg: error of the direction, seen from the table's centre.
        std_deg: that was told of it.
        true_m: distance from there; None for a distant lamp.
        distance_m: that was found; None if it was said to be unknown.
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
    is_diffuse: bool
    poses: int
    right_poses: int
    seconds: float

    @property
    def distance_percent(self) -> float | None:
        """Error of the distance, of the true one; None where either is unknown."""
        if self.true_m is None or self.distance_m is None:
            return None
        return 100 * abs(self.distance_m / self.true_m - 1)


@dataclass(frozen=True, slots=True)
class LampReport:
    """All figures; None where nothing tells.

    Attributes:
        scores: of each scene.
    """

    scores: tuple[LampScore, ...]

    def to_json(self) -> dict[str, Any]:
        """Figures by name, and the scores that they come from."""
        near, far = ([s for s in self.scores if s.is_near is is_near] for is_near in (True, False))
        angles = [s.direction_deg for s in near]
        known = [p for s in near if (p := s.distance_percent) is not None]
        return {
            "lamp_tasks": len(near),
            **_figures("lamp_direction_deg", angles),
            **_figures("lamp_distance_percent", known),
            "lamp_undetermined": sum(s.distance_m is None for s in near),
            "lamp_diffuse": sum(s.is_diffuse for s in near),
            "lamp_within_5deg": _mean([a <= _RIGHT_DEG for a in angles]),
            "lamp_within_15percent": _mean([p <= _RIGHT_PERCENT for p in known]),
            "distant_tasks": len(far),
            **_figures("distant_direction_deg", [s.direction_deg for s in far]),
            "distant_undetermined": sum(s.distance_m is None for s in far),
            "poses_total": sum(s.poses for s in self.scores),
            "poses_15mm_10deg": sum(s.right_poses for s in self.scores) / max(sum(s.poses for s in self.scores), 1),
            "lamp_s_median": float(np.median([s.seconds for s in self.scores])) if self.scores else None,
            "scores": [asdict(s) for s in self.scores],
        }


@dataclass(frozen=True, slots=True)
class LampsStep:
    """How far an evaluation is; the last step brings the report."""

    done: int
    total: int
    note: str
    report: LampReport | None = None


def evaluate_lamps(config: EvaluateLamps, library: AssetLibrary, fields: FieldLibrary) -> Iterator[LampsStep]:
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
        yield LampsStep(done, len(cases), f"A {'near' if is_near else 'distant'} lamp")
        wooden = bool(number % 2)
        scene = lamp_scene(library, names, config.seed, number, config.views, is_near=is_near, is_wooden=wooden)
        rng = stream_rng(config.seed, Stream.PHOTO_SEARCH, number, int(is_near))
        scores.append(_score(models, scene, number, rng, is_wooden=wooden))
    report = LampReport(tuple(scores))
    write_json(config.folder / "report.json", report.to_json())
    yield LampsStep(len(cases), len(cases), "Everything is measured", report)


def _score(
    models: PhotoModels, scene: LampScene, number: int, rng: np.random.Generator, *, is_wooden: bool
) -> LampScore:
    *_, last = estimate_photo(models, scene.photos, tuple(scene.poses), rng)
    surfels = [models.surfels(name, FINE_ACROSS) for name in scene.poses]
    start = time.perf_counter()
    found = photo_lamp(scene.photos, last.found, surfels)
    seconds = time.perf_counter() - start
    angle = float(np.rad2deg(np.arccos(np.clip(found.direction @ scene.direction, -1, 1))))
    true_m = None if scene.spot is None else scene.spot.distance
    distance_m = found.distance if found.distance_known else None
    std_deg = float(np.rad2deg(found.std))
    is_near, right = scene.spot is not None, sum(_is_right(one, scene.poses[one.name]) for one in last.found)
    return LampScore(number, is_near, is_wooden, angle, std_deg, true_m, distance_m, found.is_diffuse,
                     len(last.found), right, seconds)  # fmt: skip


def _is_right(found: PhotoObject, truth: Pose) -> bool:
    pose = found.best.pose
    turn_rad = float(rotation_error(CATALOGUE[found.name].symmetry, pose.quaternion, truth.quaternion))
    return bool(np.linalg.norm(pose.position - truth.position) <= _CLOSE_M and np.rad2deg(turn_rad) <= _CLOSE_DEG)


def _figures(name: str, values: Sequence[float]) -> dict[str, float | None]:
    """Mean, median, 90th percentile and the largest."""
    if not values:
        return {f"{name}_{what}": None for what in ("mean", "median", "p90", "max")}
    mean, median, p90 = np.mean(values), np.median(values), np.quantile(values, 0.9)
    return {f"{name}_mean": float(mean), f"{name}_median": float(median), f"{name}_p90": float(p90),
            f"{name}_max": float(max(values))}  # fmt: skip


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
