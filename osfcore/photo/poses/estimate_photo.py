"""Poses of known objects in photographs: from masks and fields alone, or from poses that another program gives.

For each object: candidates (all rotations, put where the mask is, or poses around a given one) are ranked in a small
window by outline, shading and texture (`PoseLoss`); CMA-ES refines the best that differ, in the small window and then
in a finer one; Gauss-Newton aligns the best of these (`pose_alignment`). Cameras and masks are given, the light need
not be known.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.objective.resting_orientations import resting_orientations
from osfcore.fields.kiloosf import KiloOSF
from osfcore.geometry.poses import Pose
from osfcore.photo.photograph import Photograph
from osfcore.photo.poses.object_window import object_windows
from osfcore.photo.poses.occlusion import without_others
from osfcore.photo.poses.photo_doubt import doubt_of, fits_outline
from osfcore.photo.poses.photo_steps import PhotoObject, PhotoPose, PhotoStep
from osfcore.photo.poses.pose_alignment import align
from osfcore.photo.poses.pose_loss import LossKind, PoseLoss
from osfcore.photo.poses.pose_search import cma_search, distinct, poses_around, poses_from_mask, super_fibonacci
from osfcore.photo.poses.surfels import Surfels, surfels_of
from osfcore.photo.poses.table_from_objects import TableGuess, table_from_objects
from osfcore.photo.poses.table_prior import TablePrior
from osfcore.progress import Progress

_COARSE_SIDE, _FINE_SIDE, _SHARP_SIDE = 44, 130, 240  # of a mask [px]
COARSE_ACROSS, FINE_ACROSS = 36, 110  # surfels along an object's diameter
_LEAST_SPACING_M = 1.2e-3
_ROTATIONS = 3000
_AROUND = 400
_RANKED, _ALIKE_DEG = 40, 12.0
_KEPT, _APART_DEG = 8, 15.0
_NEAR_DEG = 6.0  # between candidates around a given pose
_GENERATIONS, _POPULATION = 14, 14
_ALIGNED = 4


@dataclass(frozen=True, eq=False, slots=True)
class PhotoConfig:
    """How objects are looked for.

    Attributes:
        starts: poses in the world to begin with, by object name; objects without one are looked for in all rotations.
        loss: "all", or "iou" for the outline alone, as in the paper.
    """

    starts: Mapping[str, Pose] = field(default_factory=dict)
    loss: LossKind = "all"


class PhotoModels:
    """Surfels and stable orientations of fields, made when first asked for.

    Args:
        fields: by name of the object.
    """

    def __init__(self, fields: Mapping[str, KiloOSF]) -> None:
        self._fields = dict(fields)
        self._surfels: dict[tuple[str, int], Surfels] = {}
        self._priors: dict[str, TablePrior] = {}

    def check(self, name: str) -> None:
        """Refuse an object without a field.

        Raises:
            UnknownName: if it has none.
        """
        if name not in self._fields:
            raise UnknownName("field", name, sorted(self._fields))

    def surfels(self, name: str, across: int) -> Surfels:
        """Of an object, about `across` of them along its diameter."""
        key = name, across
        if key not in self._surfels:
            self.check(name)
            box = self._fields[name].extent
            diameter = float(np.linalg.norm(box[1] - box[0]))
            self._surfels[key] = surfels_of(self._fields[name], max(diameter / across, _LEAST_SPACING_M))
        return self._surfels[key]

    def table_prior(self, name: str) -> TablePrior:
        """What a table tells of an object's pose."""
        if name not in self._priors:
            self.check(name)
            self._priors[name] = TablePrior(resting_orientations(self._fields[name]))
        return self._priors[name]


def estimate_photo(
    models: PhotoModels,
    photos: Sequence[Photograph],
    names: Sequence[str],
    rng: np.random.Generator,
    config: PhotoConfig | None = None,
) -> Iterator[PhotoStep]:
    """Find objects one after the other; the last step holds all.

    Args:
        models: of the objects.
        photos: of one scene; each object has a mask in at least one.
        names: of the objects.
        rng: of the searches.
        config: how to look.

    Raises:
        UnknownName: if an object has no field.
        InvalidInput: without photographs or masks, or with several photographs that do not share a table.
    """
    config = config or PhotoConfig()
    on_table = [photo.on_table for photo in photos]
    if not photos or not (all(on_table) or len(photos) == 1):
        given = f"{len(photos)}, {sum(on_table)} of them with a known table"
        raise InvalidInput("number of photos", given, "1, or more that all show the board on the table")
    for name in names:
        models.check(name)
        object_windows(photos, name, _COARSE_SIDE)
    found: list[PhotoObject] = []
    for number, name in enumerate(names):
        yield PhotoStep(Progress(number, len(names) + 1, f"Looking for {name}"), tuple(found))
        found.append(find_object(models, photos, name, rng, config))
    again = [number for number, one in enumerate(found) if not fits_outline(one.best)] if len(found) > 1 else []
    total, seen = len(names) + len(again) + 1, {name: photos for name in names}
    for done, number in enumerate(again, len(names)):
        yield PhotoStep(Progress(done, total, f"Looking for {names[number]} behind the others"), tuple(found))
        found[number], seen[names[number]] = _found_behind(models, photos, found, number, rng, config)
    yield PhotoStep(Progress(total - 1, total, "The table that they lie on"), tuple(found))
    table = None
    if not on_table[0]:
        table = table_from_objects([models.table_prior(name) for name in names], [o.best.pose for o in found])
        if table is not None:
            lying = set(table.supported)
            found = [
                _on_table(models, seen[o.name][0], o, table, config) if k in lying else o for k, o in enumerate(found)
            ]
    yield PhotoStep(Progress(total, total, "All objects were looked for"), tuple(found), table)


def _found_behind(
    models: PhotoModels,
    photos: Sequence[Photograph],
    found: Sequence[PhotoObject],
    number: int,
    rng: np.random.Generator,
    config: PhotoConfig,
) -> tuple[PhotoObject, Sequence[Photograph]]:
    """An object in masks without the others, and these masks; as before if its outline fits them no better."""
    before = found[number]
    surfels = {other.name: models.surfels(other.name, FINE_ACROSS) for other in found}
    without = without_others(photos, before.name, found, surfels)
    try:
        now = find_object(models, without, before.name, rng, config)
    except InvalidInput:  # hardly anything is left of its mask
        return before, photos
    return (now, without) if now.best.iou > before.best.iou else (before, photos)


def _on_table(
    models: PhotoModels, photo: Photograph, found: PhotoObject, table: TableGuess, config: PhotoConfig
) -> PhotoObject:
    """An object aligned once more, now that it is known to lie on a table; its pose stays in the camera's frame."""
    start = time.perf_counter()
    seen = replace(photo, T_world_camera=table.T_world_camera, on_table=True)
    sharp, plain = (
        PoseLoss(
            object_windows([shown], found.name, side),
            models.surfels(found.name, FINE_ACROSS),
            table=prior,
            kind=config.loss,
        )
        for shown, side, prior in ((seen, _SHARP_SIDE, models.table_prior(found.name)), (photo, _FINE_SIDE, None))
    )
    pose = table.T_world_camera.inverse() @ align(sharp, table.T_world_camera @ found.best.pose)[0]
    best = _photo_poses(pose[None], plain)[0]
    doubt = doubt_of(found.name, best, found.rivals, plain)
    return replace(found, best=best, doubt=doubt, refine_s=found.refine_s + time.perf_counter() - start)


def _photo_poses(poses: Pose, loss: PoseLoss) -> list[PhotoPose]:
    """Poses with what the loss says of each."""
    terms = loss.terms(poses)
    parts = zip(terms.losses, terms.iou, terms.residual, terms.correlation, strict=True)
    return [PhotoPose(poses[k], *(float(v) for v in values)) for k, values in enumerate(parts)]


def find_object(
    models: PhotoModels, photos: Sequence[Photograph], name: str, rng: np.random.Generator, config: PhotoConfig
) -> PhotoObject:
    """Look for one object in its masks; arguments as of `estimate_photo`."""
    on_table = all(photo.on_table for photo in photos)
    table = models.table_prior(name) if on_table else None
    coarse, fine, sharp = (
        PoseLoss(object_windows(photos, name, side), models.surfels(name, across), table=table, kind=config.loss)
        for side, across in ((_COARSE_SIDE, COARSE_ACROSS), (_FINE_SIDE, FINE_ACROSS), (_SHARP_SIDE, FINE_ACROSS))
    )
    start = time.perf_counter()
    given = config.starts.get(name)
    if given is None:
        candidates, alike = poses_from_mask(coarse, super_fibonacci(_ROTATIONS)), _ALIKE_DEG
    else:
        candidates, alike = poses_around(given, coarse.windows[0], _AROUND, rng), _NEAR_DEG
    ranked = candidates[distinct(candidates, coarse(candidates), _RANKED if given is None else _KEPT, alike)]
    poses, losses = cma_search(coarse, ranked, generations=_GENERATIONS, population=_POPULATION, spread=1.0, rng=rng)
    poses = poses[distinct(poses, losses, _KEPT, _APART_DEG if given is None else _NEAR_DEG)]
    middle = time.perf_counter()
    poses, losses = cma_search(
        fine,
        poses[np.arange(min(len(poses.position), _ALIGNED))],
        generations=_GENERATIONS,
        population=_POPULATION,
        spread=0.35,
        rng=rng,
    )
    poses = poses[distinct(poses, losses, _ALIGNED, _NEAR_DEG)]
    ends = [align(sharp, poses[k])[0] for k in range(len(poses.position))]
    poses = Pose.stacked(ends)
    ready = _photo_poses(poses, fine)
    best, *rivals = (ready[k] for k in distinct(poses, np.array([p.loss for p in ready]), _ALIGNED, _APART_DEG))
    doubt = doubt_of(name, best, rivals, fine)
    return PhotoObject(name, best, tuple(rivals), doubt, middle - start, time.perf_counter() - middle)
