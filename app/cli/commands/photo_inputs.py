"""What `osf photo estimate` is given: photographs with their cameras, masks of objects, poses to begin with."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from osfcore.contrib.bop import PoseChoice, read_masks, read_poses
from osfcore.errors import InvalidInput, UnknownName, shown
from osfcore.geometry.poses import Pose
from osfcore.photo.calibration import KnownCamera, read_camera
from osfcore.photo.read_photograph import RawPhotograph, read_photograph, to_photograph
from osfcore.photo.segmentation import Box, propose_mask
from osfcore.photo.summary import locate, locate_calibrated

if TYPE_CHECKING:
    from osfcore.photo.photograph import Photograph

_FORM = "[PHOTO:]NAME:LEFT,TOP,RIGHT,BOTTOM, such as 025_mug:120,80,260,210"


@dataclass(frozen=True, slots=True)
class Asked:
    """What a person asks for.

    Attributes:
        photos: files, of one scene.
        boxes: [PHOTO:]NAME:LEFT,TOP,RIGHT,BOTTOM in pixels of a photo.
        masks: folders, one for each photo.
        poses: file of another program, whose camera is the first photo's.
        choice: which poses of that file.
        images: numbers of the photos in files of BOP.
        focal: length in pixels of the photos.
        camera: file of the calibrated camera that took the photos.
    """

    photos: tuple[Path, ...]
    boxes: tuple[str, ...] = ()
    masks: tuple[Path, ...] = ()
    poses: Path | None = None
    choice: PoseChoice = field(default_factory=PoseChoice)
    images: tuple[int, ...] = ()
    focal: float | None = None
    camera: Path | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Ready:
    """What the estimation takes.

    Attributes:
        photos: with masks.
        names: of the objects.
        starts: poses in the world, by name.
        notes: sentences for the person.
    """

    photos: tuple[Photograph, ...]
    names: tuple[str, ...]
    starts: Mapping[str, Pose]
    notes: tuple[str, ...]


def read_inputs(asked: Asked, known: Collection[str]) -> Ready:
    """Read everything, cheap checks first.

    Args:
        asked: what is asked for.
        known: names of objects that can be found.

    Raises:
        OsfError: with a sentence that says what is wrong.
    """
    if not asked.photos:
        raise InvalidInput("number of photos", 0, "1 or more")
    for what, given in (("folders of masks", asked.masks), ("numbers of images", asked.images)):
        if len(given) not in (0, len(asked.photos)):
            raise InvalidInput(f"number of {what}", len(given), f"{len(asked.photos)}, one for each photo")
    if not asked.boxes and not asked.masks:
        raise InvalidInput("number of boxes", 0, "1 or more, or --masks given: an object needs a box or a mask")
    if asked.camera is not None and asked.focal is not None:
        raise InvalidInput("--focal", asked.focal, "left out, since --camera tells the focal length")
    camera = None if asked.camera is None else read_camera(asked.camera)
    raws = [read_photograph(path) for path in asked.photos]
    boxes: list[dict[str, Box]] = [{} for _ in raws]
    for text in asked.boxes:
        number, name, box = _box(text, asked.photos, raws)
        if name not in known:
            raise UnknownName("object", name, known)
        boxes[number][name] = box
    image = asked.images[0] if asked.images else asked.choice.image
    choice = PoseChoice(image, asked.choice.scene, asked.choice.source, asked.choice.frame)
    poses = {} if asked.poses is None else read_poses(asked.poses, choice)
    masks = [_masks(asked, known, raws[k], boxes[k], k) for k in range(len(raws))]
    names = tuple(dict.fromkeys(name for its in masks for name in its))
    photos, notes = [], []
    for path, raw, its in zip(asked.photos, raws, masks, strict=True):
        photo, its_notes = _located(path, raw, its, asked.focal, camera, is_alone=len(raws) == 1)
        photos.append(photo)
        notes += its_notes if len(raws) == 1 else [f"{path.name}: {note}" for note in its_notes]
    starts = {name: photos[0].T_world_camera @ pose for name, pose in poses.items() if name in names}
    if asked.poses is not None:
        notes += _about_poses(poses, names)
    return Ready(tuple(photos), names, starts, tuple(notes))


def _about_poses(poses: Mapping[str, Pose], names: Collection[str]) -> list[str]:
    """What became of poses that were given."""
    left, missing = (", ".join(sorted(found)) for found in (set(poses) - set(names), set(names) - set(poses)))
    told = [f"Poses of {left} were not used: nothing says which pixels show them."] if left else []
    return told + ([f"{missing} had no pose to begin with; all orientations were tried."] if missing else [])


def _box(text: str, paths: Sequence[Path], raws: Sequence[RawPhotograph]) -> tuple[int, str, Box]:
    """Number of the photo, name, and box in pixels of the photo as it was read."""
    owner, _, numbers = text.rpartition(":")
    file, _, name = owner.rpartition(":")
    try:
        left, top, right, bottom = (float(number) for number in numbers.split(","))
    except ValueError:
        raise InvalidInput("box", text, _FORM) from None
    fitting = [k for k, path in enumerate(paths) if file in (str(path), path.name)] if file else [0]
    if len(fitting) != 1:
        raise InvalidInput("photo of a box", shown(file), f"one of {', '.join(map(str, paths))}")
    raw = raws[fitting[0]]
    width, height = raw.sent_size
    if not (max(left, 0) < min(right, width) and max(top, 0) < min(bottom, height)):  # also false for NaN
        allowed = f"within the photo's {width} x {height} pixels, told as LEFT,TOP,RIGHT,BOTTOM"
        raise InvalidInput(f"box of {shown(name)} [px]", numbers, allowed)
    scale = max(raw.encoded.shape[:2]) / max(raw.sent_size)
    return fitting[0], name, (scale * left, scale * top, scale * right, scale * bottom)


def _masks(
    asked: Asked, known: Collection[str], raw: RawPhotograph, boxes: Mapping[str, Box], number: int
) -> dict[str, Any]:
    """Masks of one photo: from its folder, and where there is a box from that and a click in its middle."""
    masks: dict[str, Any] = {}
    if asked.masks:
        height, width = raw.encoded.shape[:2]
        image = asked.images[number] if asked.images else None
        masks |= read_masks(asked.masks[number], known, (raw.sent_size, (width, height)), image)
    for name, (left, top, right, bottom) in boxes.items():
        middle = np.array([[(left + right) / 2, (top + bottom) / 2]])
        masks[name] = propose_mask(raw.eight_bit, (left, top, right, bottom), middle)
    return masks


def _located(
    path: Path,
    raw: RawPhotograph,
    masks: Mapping[str, Any],
    focal: float | None,
    camera: KnownCamera | None,
    *,
    is_alone: bool,
) -> tuple[Photograph, list[str]]:
    """The photograph with its camera, free of distortion: over the board if it shows one, or as it was calibrated."""
    found = locate(raw, focal) if camera is None else locate_calibrated(raw, camera)
    if found.T_world_camera is None and not is_alone:
        allowed = f"to be seen, since there are several photos ({found.missing.rstrip('.')})"
        raise InvalidInput(f"board in {shown(path.name)}", "missing", allowed)
    straight = {name: found.straightened(mask) for name, mask in masks.items()}
    photo = to_photograph(found.raw, found.intrinsics, found.T_world_camera, straight)
    return photo, list(found.notes)
