"""Measure poses in real photographs against masks, measured depth and reference poses; and lamps.

A photographed scene is a folder with photo.json:

    {"image": file, "encoding": "sRGB" or "linear", "K": 3 x 3 [px], pixel centres at +0.5,
     "masks": {object: file}, in which more than 127 is the object,
     "depth": file, 16 bit, and "depth_unit_m"; may be missing,
     "T_table_camera": 4 x 4, pose over the table's plane z = 0; may be missing,
     "table": text; photographs with the same one show one table, and are looked at together; may be missing,
     "poses_camera_object": {source: {object: {"position": [3], "quaternion": [w, x, y, z]}}}}

The source "ground_truth" is the truth; without one, "posecnn_refined_with_depth" stands for it. A folder of lamps
holds folders chrome, gray and others, each with NAME.mask.png and linear images NAME.K.png; those with the same K
show the same lamp. Its direction is that of the highlight on the chrome ball.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, FiniteFloat

from osfcore.errors import CorruptFile, InvalidInput, check_ranges, check_seed
from osfcore.estimation.camera_response import linear_from_encoded
from osfcore.experiments.harness import EvaluationStep
from osfcore.experiments.statistics import mean, quantile
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, unit_quaternion
from osfcore.inspection.contact_sheet import write_sheet
from osfcore.io.files import read_json, write_json
from osfcore.io.json_codec import Entry, Matrix3, Matrix4, Text, Vector3, Vector4, decode
from osfcore.metrics.pose_errors import pose_error
from osfcore.objects.catalogue import CATALOGUE
from osfcore.photo.lamp import ShadedPixels, fit_lamp
from osfcore.photo.photograph import Photograph
from osfcore.photo.pose_loss import LossKind, object_windows
from osfcore.photo.poses import PhotoConfig, PhotoModels, PhotoObject, estimate_photo, table_from_points
from osfcore.photo.segmentation import Box, outline_doubt, propose_masks
from osfcore.random_streams import Stream, stream_rng
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch

PHOTO_FILE = "photo.json"
GROUND_TRUTH, REFINED = "ground_truth", "posecnn_refined_with_depth"
_MIRROR, _MASK_LEVEL = "chrome", 127
_HIGHLIGHT, _SATURATED = 0.9, 0.985  # of the brightest pixel; of full scale
_SEEN = 0.2  # least cosine to the view of a sphere's pixels


class _PoseJson(Entry):
    position: Vector3
    quaternion: Vector4


class _PhotoJson(Entry):
    image: Text
    encoding: Text = "sRGB"
    K: Matrix3
    masks: dict[Text, Text]
    depth: Text | None = None
    depth_unit_m: FiniteFloat = Field(1e-3, gt=0)
    T_table_camera: Matrix4 | None = None
    table: Text | None = None
    poses_camera_object: dict[Text, dict[Text, _PoseJson]] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class PhotoFolder:
    """One photographed scene.

    Attributes:
        name: of the folder.
        encoded: the photograph as it is.
        photo: linear; the world is the camera's frame.
        depth: measured, along the camera's z axis [m]; 0 where nothing was measured. None without one.
        poses: `T_camera_object` by source and object.
        T_table_camera: pose over the table; None if it is not written.
        table: what photographs of one table share; the folder's name if nothing is written.
    """

    name: str
    encoded: np.ndarray
    photo: Photograph
    depth: Float[np.ndarray, "h w"] | None
    poses: Mapping[str, Mapping[str, Pose]]
    T_table_camera: Pose | None
    table: str

    @property
    def reference(self) -> Mapping[str, Pose]:
        """Poses that stand for the truth; empty if there are none."""
        return self.poses.get(GROUND_TRUTH) or self.poses.get(REFINED) or {}

    def table_points(self) -> Float[np.ndarray, "P 3"]:
        """Return the measured points around the objects, in the camera's frame [m]; depth has to be known."""
        assert self.depth is not None
        objects = np.any(list(self.photo.masks.values()), axis=0).astype(np.uint8)
        around, margin = (cv2.dilate(objects, np.ones((side, side), np.uint8)) > 0 for side in (81, 13))
        rows, columns = np.nonzero(around & ~margin & (self.depth > 0))
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
        return pixels @ np.linalg.inv(self.photo.intrinsics).T * self.depth[rows, columns, None]


@dataclass(frozen=True, eq=False, slots=True)
class LampSubject:
    """One thing under several lamps.

    Attributes:
        name: of the thing.
        images: linear.
        mask: its pixels.
        directions: unit vectors toward the lamps, in the camera's frame.
    """

    name: str
    images: Float[np.ndarray, "K h w 3"]
    mask: Bool[np.ndarray, "h w"]
    directions: Float[np.ndarray, "K 3"]


def read_scene(folder: Path) -> PhotoFolder:
    """Read a photographed scene.

    Raises:
        CorruptFile: if a file is missing or not what it should be.
    """
    known = read_json(folder / PHOTO_FILE, lambda data: decode(_PhotoJson, data, PHOTO_FILE))
    image = _read(folder / known.image)[..., 2::-1]
    masks = {name: _read(folder / file, cv2.IMREAD_GRAYSCALE) > _MASK_LEVEL for name, file in known.masks.items()}
    values = (image / np.float32(np.iinfo(image.dtype).max)).astype(np.float32)
    linear = linear_from_encoded(values, "linear" if known.encoding == "linear" else "srgb").astype(np.float32)
    exposed = np.all(values < _SATURATED, axis=-1)
    photo = Photograph(linear, exposed, np.array(known.K), Pose.identity(), False, masks)
    depth = None if known.depth is None else _read(folder / known.depth, cv2.IMREAD_UNCHANGED) * known.depth_unit_m
    poses = {
        source: {name: Pose(np.array(p.position), unit_quaternion(np.array(p.quaternion))) for name, p in its.items()}
        for source, its in known.poses_camera_object.items()
    }
    over = None if known.T_table_camera is None else Pose.from_matrix(np.array(known.T_table_camera))
    return PhotoFolder(folder.name, image, photo, depth, poses, over, known.table or folder.name)


def read_lamps(folder: Path) -> tuple[LampSubject, ...]:
    """Read all things of a folder of lamps but the chrome ball.

    Raises:
        CorruptFile: as files are.
    """
    mirror, mask = _images(folder / _MIRROR)
    normals, _ = sphere_normals(mask)
    directions = {}
    for number, image in mirror.items():
        shine = image.mean(axis=-1) * mask
        normal = normals[shine > _HIGHLIGHT * shine.max()].mean(axis=0)
        normal /= np.linalg.norm(normal)
        view = np.array([0.0, 0.0, -1.0])
        directions[number] = 2 * (normal @ view) * normal - view
    subjects = []
    for path in sorted(p for p in folder.iterdir() if p.is_dir() and p.name != _MIRROR):
        images, mask = _images(path)
        both = sorted(images.keys() & directions.keys(), key=lambda number: (len(number), number))
        lamps = np.array([directions[number] for number in both])
        subjects.append(LampSubject(path.name, np.stack([images[number] for number in both]), mask, lamps))
    return tuple(subjects)


def sphere_normals(mask: Bool[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Return the normals of a sphere in the frame of a distant camera, and the pixels not seen at a grazing angle."""
    rows, columns = np.nonzero(mask)
    centre = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
    radius = (np.ptp(rows) + np.ptp(columns) + 2) / 4
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]] + 0.5
    x, y = (x - centre[0]) / radius, (y - centre[1]) / radius
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return np.stack([x, y, -z], axis=-1), mask & (z > _SEEN)


def _images(folder: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    mask = _read(folder / f"{folder.name}.mask.png", cv2.IMREAD_GRAYSCALE) > _MASK_LEVEL
    images = {}
    for path in sorted(folder.glob(f"{folder.name}.*.png")):
        if (number := path.name.split(".")[-2]) != "mask":
            image = _read(path)[..., 2::-1]
            images[number] = image / float(np.iinfo(image.dtype).max)
    return images, mask


def _read(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise CorruptFile(path, "it is missing, or no image")
    return image


# Figures of photographs.


_RIGHT_MM, _RIGHT_DEG, _DEPTH_MM = 15.0, 10.0, 10.0


@dataclass(frozen=True, slots=True)
class PhotoScore:
    """Errors of one object in one photograph.

    Attributes:
        scene: the photograph's folder.
        name: of the object.
        is_true: the reference is the truth, not another program's answer.
        iou: of the field's silhouette and the mask.
        depth_mm: median of rendered minus measured depth; None without measured depth.
        position_mm: distance from the reference; None without one.
        rotation_deg: angle to it, symmetries counted.
        doubt: why the pose should not be trusted; "" where it may be.
        margin: by how much the best other orientation scores worse; None if there is no other.
        explained: mean log odds that pixels show the object.
        match: share of its print that is found again.
        coarse_s: of the search over rotations.
        refine_s: of the refinement.
        mask_iou: of the mask that was searched with and the given one.
        fills_box: whether the mask that was searched with fills the box around the given one.
    """

    scene: str
    name: str
    is_true: bool
    iou: float
    depth_mm: float | None
    position_mm: float | None
    rotation_deg: float | None
    doubt: str
    margin: float | None
    explained: float
    match: float
    coarse_s: float
    refine_s: float
    mask_iou: float = 1.0
    fills_box: bool = True

    @property
    def is_turned_right(self) -> bool:
        """Whether the rotation is within 10 degrees of the reference."""
        return self.rotation_deg is not None and self.rotation_deg <= _RIGHT_DEG

    @property
    def is_right(self) -> bool:
        """Whether the position is within 15 mm as well."""
        return self.is_turned_right and self.position_mm is not None and self.position_mm <= _RIGHT_MM


def photo_report(
    scores: Sequence[PhotoScore], lamps_deg: Mapping[str, Sequence[float]], without_field: int
) -> dict[str, Any]:
    """Return figures by name, None where nothing is known, and the scores that they come from.

    Args:
        scores: of each search.
        lamps_deg: error of each lamp, by what it shone on.
        without_field: number of objects that have no field and were left out.
    """
    referred = [s for s in scores if s.rotation_deg is not None]
    depths = [abs(s.depth_mm) for s in scores if s.depth_mm is not None]
    lamps = [error for errors in lamps_deg.values() for error in errors]
    refine_s, coarse_s = [s.refine_s for s in scores], [s.coarse_s for s in scores]
    return {
        "objects_total": len(scores),
        "objects_without_field": without_field,
        "iou_median": quantile([s.iou for s in scores], 0.5),
        "iou_mean": mean(s.iou for s in scores),
        "iou_min": min((s.iou for s in scores), default=None),
        "mask_iou_median": quantile([s.mask_iou for s in scores], 0.5),
        "mask_iou_min": min((s.mask_iou for s in scores), default=None),
        "boxes_unfilled": sum(not s.fills_box for s in scores),
        "depth_within_10mm": mean(d <= _DEPTH_MM for d in depths),
        "depth_mm_median": quantile(depths, 0.5),
        "frac_15mm_10deg": mean(s.is_right for s in scores if s.is_true),
        "frac_10deg": mean(s.is_turned_right for s in referred),
        "wrong_unflagged": sum(not s.is_turned_right and not s.doubt for s in referred),
        "right_flagged": sum(s.is_turned_right and bool(s.doubt) for s in referred),
        "light_deg_median": quantile(lamps, 0.5),
        "light_deg_max": max(lamps, default=None),
        "light_deg": {name: [round(e, 2) for e in errors] for name, errors in lamps_deg.items()},
        "refine_s_median": quantile(refine_s, 0.5),
        "refine_s_p95": quantile(refine_s, 0.95),
        "coarse_s_median": quantile(coarse_s, 0.5),
        "coarse_s_p95": quantile(coarse_s, 0.95),
        "scores": [asdict(s) for s in scores],
    }


# How far estimated lamps are from true ones, on things of known shape.
#
# A ball called "gray" has the normals of a sphere and one albedo. Of anything else, normals and albedo come from
# all its other images and their lamps (photometric stereo; Woodham 1980, the three darkest and the brightest value
# of each pixel left out), and the lamp of the image that was left out is estimated.


BALL = "gray"
_EVERY = 7  # of a thing's pixels
_DARKEST, _BRIGHTEST = 3, 1
_SATURATED_PIXEL, _LEAST_ALBEDO = 0.98, 0.05


def lamp_errors_deg(subject: LampSubject) -> list[float]:
    """Return the angle between estimated and true lamp of each image [deg]."""
    errors = []
    for number, (image, direction) in enumerate(zip(subject.images, subject.directions, strict=True)):
        albedo, normals, shown = _surface(subject, number)
        usable = shown & (image.max(axis=-1) < _SATURATED_PIXEL)
        pixels = ShadedPixels(*(a[usable][::_EVERY] for a in (image, albedo, normals)))
        cosine = float(fit_lamp(pixels).direction @ direction)
        errors.append(float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))))
    return errors


def _surface(subject: LampSubject, left_out: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return albedo, normals and usable pixels of a thing, from all its images but one."""
    if subject.name == BALL:
        normals, shown = sphere_normals(subject.mask)
        return np.ones_like(normals), normals, shown
    others = np.arange(len(subject.images)) != left_out
    images, lamps = subject.images[others], subject.directions[others]
    values = images[:, subject.mask].mean(axis=-1)
    order = np.argsort(values, axis=0)
    weights = np.ones_like(values)
    np.put_along_axis(weights, np.concatenate([order[:_DARKEST], order[-_BRIGHTEST:]]), 0, axis=0)
    normal = np.einsum("kp,ki,kj->pij", weights, lamps, lamps) + 1e-6 * np.eye(3)
    right = np.einsum("kp,ki,kp->pi", weights, lamps, values)
    scaled = np.linalg.solve(normal, right[..., None])[..., 0]
    grey = np.linalg.norm(scaled, axis=1)
    colour = images[:, subject.mask].mean(axis=0)
    colour /= np.maximum(colour.mean(axis=-1, keepdims=True), 1e-6)
    albedo, normals = np.zeros((*subject.mask.shape, 3)), np.zeros((*subject.mask.shape, 3))
    albedo[subject.mask] = grey[:, None] * colour
    normals[subject.mask] = scaled / np.maximum(grey[:, None], 1e-6)
    return albedo, normals, albedo.mean(axis=-1) > _LEAST_ALBEDO


# Masks as a person would get them: from a box around the object and one click on it.


LOOSE = 0.04  # of the box's sides, on each side: people do not draw to the pixel


def box_and_click(mask: Bool[np.ndarray, "h w"]) -> tuple[Box, Float[np.ndarray, "1 2"]]:
    """Return a loose box around a mask, and the point of the mask that is farthest from its border [px]."""
    rows, columns = np.nonzero(mask)
    left, top, right, bottom = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    across, down = LOOSE * (right - left), LOOSE * (bottom - top)
    height, width = mask.shape
    box = max(left - across, 0.0), max(top - down, 0.0), min(right + across, width), min(bottom + down, height)
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), mask.shape)
    return (float(box[0]), float(box[1]), float(box[2]), float(box[3])), np.array([[column + 0.5, row + 0.5]])


# The evaluation.


NONE, PERTURBED = "none", "perturbed"
_SHIFT_M, _TURN_DEG = 0.03, 20.0
_MOST_MASK_PX = 10
_MOST_REPEATS = 100


@dataclass(frozen=True, slots=True)
class EvaluatePhotos:
    """What to measure.

    Attributes:
        folder: for report.json and contact sheets.
        data: folder of folders of photographs, see `folders`.
        start: "none"; "perturbed": 3 cm and 20 deg off the ground truth, in random directions; or the name of a source
            of poses. Scenes that lack it are left out.
        plane: "known": the one that is written, or fitted to the measured depth around the objects; "free".
        masks: "given"; "boxes": proposed from the given mask's bounding box, a little looser, and a click at the point
            farthest from its border, as a person would mark the object.
        mask_error_px: masks are grown and shrunk by that much in turn.
        repeats: random starts of each object.
        loss: of the search.
        seed: of everything random.
    """

    folder: Path
    data: Path
    start: str = NONE
    plane: Literal["known", "free"] = "free"
    mask_error_px: int = 0
    repeats: int = 1
    loss: LossKind = "all"
    seed: int = 0
    masks: Literal["given", "boxes"] = "given"


def evaluate_photos(config: EvaluatePhotos, fields: FieldLibrary) -> Iterator[EvaluationStep]:
    """Look for every object of every folder, then for the lamps; report.json and sheets go to `config.folder`.

    Args:
        config: what to measure.
        fields: of the objects; those without one are left out and counted.

    Raises:
        InvalidInput: if there is nothing to measure, or a number is out of range.
        CorruptFile, CannotWrite: as files are.
    """
    check_seed(config.seed)
    check_ranges(
        ("error of masks [px]", config.mask_error_px, 0, _MOST_MASK_PX),
        ("starts of each object", config.repeats, 1, _MOST_REPEATS),
    )
    scenes = [read_scene(path.parent) for path in described(config.data)]
    lamps = sorted(path.parents[1] for path in config.data.glob(f"**/{_MIRROR}/{_MIRROR}.mask.png"))
    known = set(fields.names())
    tables: dict[str, list[PhotoFolder]] = {}
    for scene in scenes:  # poses to begin with belong to one photograph
        tables.setdefault(scene.table if config.start == NONE else scene.name, []).append(scene)
    asked = [
        (its, list(dict.fromkeys(n for each in its for n in _names(config, each, known)))) for its in tables.values()
    ]
    cases = [(its, names, number) for its, names in asked if names for number in range(config.repeats)]
    without = sum(name not in known for scene in scenes for name in scene.photo.masks)
    if not cases and not lamps:
        allowed = f"a folder of photographs with photo.json that have poses named {config.start!r}"
        raise InvalidInput("data", config.data, allowed)
    loaded = {name: fields.load(name) for name in sorted({name for _, names in asked for name in names})}
    models, renderer = PhotoModels(loaded), SceneRenderer(loaded, None)
    scores: list[PhotoScore] = []
    for done, (its, names, number) in enumerate(cases):
        yield EvaluationStep(done, len(cases), f"{len(names)} objects in {its[0].name}")
        rng = stream_rng(config.seed, Stream.PHOTO_SEARCH, zlib.crc32(its[0].name.encode()), number)
        photos = [_photo(config, scene) for scene in its]
        starts = {name: _start(config, its[0], name, rng) for name in names}
        placed = {name: photos[0].T_world_camera @ start for name, start in starts.items() if start is not None}
        *_, last = estimate_photo(models, photos, names, rng, PhotoConfig(placed, config.loss))
        seen = {name: [k for k, photo in enumerate(last.photos) if name in photo.masks] for name in names}
        for found in last.found:
            scene, photo = its[seen[found.name][0]], last.photos[seen[found.name][0]]
            moved = replace(found, best=replace(found.best, pose=photo.T_world_camera.inverse() @ found.best.pose))
            write_sheet(config.folder / f"{scene.name}-{found.name}-{number}.png", models, scene.photo, moved)
            used, given = photo.masks[found.name], scene.photo.masks[found.name]
            mask_iou = float((used & given).sum() / (used | given).sum())
            fills_box = not outline_doubt(found.name, box_and_click(given)[0], used)
            scores.append(replace(_score(renderer, scene, moved), mask_iou=mask_iou, fills_box=fills_box))
        scores += [_not_found(its, name) for name in names if not seen[name]]
    lamp_errors = {subject.name: lamp_errors_deg(subject) for path in lamps for subject in read_lamps(path)}
    report = photo_report(scores, lamp_errors, without)
    write_json(config.folder / "report.json", report)
    yield EvaluationStep(len(cases), len(cases), "Everything is measured", report)


def starts_of(data: Path) -> tuple[str, ...]:
    """Return what searches in a folder of photographs may begin with: "none", then all sources but the references.

    Raises:
        CorruptFile: as files are.
    """
    sources = {source for path in described(data) for source in read_scene(path.parent).poses}
    return (NONE, *sorted(sources - {GROUND_TRUTH, REFINED}))


def described(data: Path) -> list[Path]:
    """Return the photo.json of a folder of photographs, and those of the folders in it."""
    return sorted([*data.glob(PHOTO_FILE), *data.glob(f"*/{PHOTO_FILE}")])


def _names(config: EvaluatePhotos, scene: PhotoFolder, known: set[str]) -> list[str]:
    """Return the objects of a scene that are looked for."""
    source = GROUND_TRUTH if config.start == PERTURBED else config.start
    return [n for n in scene.photo.masks if n in known and (config.start == NONE or n in scene.poses.get(source, {}))]


def _score(renderer: SceneRenderer, scene: PhotoFolder, found: PhotoObject) -> PhotoScore:
    """Compare an object, its pose in the camera's frame, with mask, depth and reference pose."""
    name, pose = found.name, found.best.pose
    iou, depth_mm = _fit(renderer, scene, name, pose)
    position_mm = rotation_deg = None
    if (reference := scene.reference.get(name)) is not None:
        position_mm, rotation_deg = pose_error(CATALOGUE[name].symmetry, pose, reference)
    margin = found.rivals[0].score - found.best.score if found.rivals else None
    return PhotoScore(
        scene=scene.name,
        name=name,
        is_true=GROUND_TRUTH in scene.poses,
        iou=iou,
        depth_mm=depth_mm,
        position_mm=position_mm,
        rotation_deg=rotation_deg,
        doubt=found.doubt,
        margin=margin,
        explained=found.best.explained,
        match=found.best.match,
        coarse_s=found.coarse_s,
        refine_s=found.refine_s,
    )


def _not_found(scenes: Sequence[PhotoFolder], name: str) -> PhotoScore:
    """Return the score of an object that is in no photograph that could be used."""
    scene = next(each for each in scenes if name in each.photo.masks)
    is_true, turn_deg = GROUND_TRUTH in scene.poses, 180.0 if name in scene.reference else None
    return PhotoScore(
        scene.name, name, is_true, 0.0, None, None, turn_deg, f"{name} was not found.", None, 0.0, 0.0, 0.0, 0.0
    )


def _photo(config: EvaluatePhotos, scene: PhotoFolder) -> Photograph:
    photo = scene.photo
    if config.masks == "boxes":
        encoded = scene.encoded if scene.encoded.dtype == np.uint8 else (scene.encoded // 257).astype(np.uint8)
        marks = {name: box_and_click(mask) for name, mask in photo.masks.items()}
        boxes = {name: box for name, (box, _) in marks.items()}
        clicks = {name: click for name, (_, click) in marks.items()}
        photo = photo.with_masks(propose_masks(np.ascontiguousarray(encoded), boxes, clicks), boxes)
    if config.mask_error_px:
        kernel = np.ones((2 * config.mask_error_px + 1,) * 2, np.uint8)
        change = (cv2.dilate, cv2.erode)
        masks = {name: change[k % 2](m.astype(np.uint8), kernel) > 0 for k, (name, m) in enumerate(photo.masks.items())}
        photo = replace(photo, masks=masks)
    if config.plane == "known" and scene.T_table_camera is not None:
        photo = replace(photo, T_world_camera=scene.T_table_camera, on_table=True)
    elif config.plane == "known" and scene.depth is not None:
        T_world_camera = table_from_points(scene.table_points(), stream_rng(config.seed, Stream.PHOTO_PLANE))
        photo = replace(photo, T_world_camera=T_world_camera, on_table=True)
    return photo


def _start(config: EvaluatePhotos, scene: PhotoFolder, name: str, rng: np.random.Generator) -> Pose | None:
    if config.start == NONE:
        return None
    if config.start != PERTURBED:
        return scene.poses[config.start][name]
    true = scene.poses[GROUND_TRUTH][name]
    shift, axis = rng.standard_normal((2, 3))
    shift, axis = shift / np.linalg.norm(shift), axis / np.linalg.norm(axis)
    turn = quaternion_exp(np.deg2rad(_TURN_DEG) * axis)
    return Pose(true.position + _SHIFT_M * shift, quaternion_multiply(turn, true.quaternion))


def _fit(renderer: SceneRenderer, scene: PhotoFolder, name: str, pose: Pose) -> tuple[float, float | None]:
    """Return IoU of the field's silhouette with the mask, where that is known, and median depth error [mm]."""
    window = object_windows([scene.photo], name, max(scene.photo.image.shape))[0]
    camera = window.camera(name)
    toward_camera = -pose.position[None] / np.linalg.norm(pose.position)
    batch = SceneBatch((name,), pose.position[None, None], pose.quaternion[None, None], toward_camera, None)
    drawn = renderer.render(batch, [camera], outputs={"rgb", "masks", "depth"})
    assert drawn.masks is not None
    assert drawn.depth is not None
    shown = drawn.masks[0, 0, 0]
    both, either = shown & window.mask & window.known, (shown | window.mask) & window.known
    iou = float(both.sum() / either.sum())
    if scene.depth is None:
        return iou, None
    measured = window.frame.cut(scene.depth.astype(np.float32))
    common = shown & window.mask & (measured > 0)
    return iou, float(1e3 * np.median(drawn.depth[0, 0][common] - measured[common])) if common.any() else None
