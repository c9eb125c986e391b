"""Masks that another program or a person drew: a folder of PNG files, by name of the object or as BOP numbers them.

NAME.png or mask_NAME.png       what is brighter than half of the brightest is the object
IMAGE_INDEX.png (000059_000002.png)   BOP's mask_visib; INDEX counts the objects of IMAGE in scene_gt.json beside it
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from osfcore.errors import CorruptFile, InvalidInput, shown
from osfcore.photo.other_programs.pose_file import scene_gt_names

_BOP_NAME = re.compile(r"(\d{6})_(\d{6})\.png")
_SCENE_GT = "scene_gt.json"


def read_masks(
    folder: Path, known: Collection[str], sizes: tuple[tuple[int, int], tuple[int, int]], image: int | None = None
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Masks by name of the object; files of others are left alone, and so are masks without a pixel.

    Args:
        folder: that holds them.
        known: names of objects that are looked for.
        sizes: width and height of the photo as it was sent, which masks must have, and as it is worked on [px].
        image: number of the image, for masks as BOP numbers them.

    Raises:
        InvalidInput: if the folder holds no mask of a known object, a mask has another size than the photo, or BOP's
            masks lack scene_gt.json or the image's number.
        CorruptFile: if a file is no picture.
    """
    if not folder.is_dir():
        raise InvalidInput("folder of masks", folder, "a folder that exists")
    files = _bop_files(folder, image)
    if not files:
        named = [(name, folder / f"{start}{name}.png") for name in known for start in ("", "mask_")]
        files = {name: path for name, path in named if path.is_file()}
    masks = {name: _read(path, *sizes) for name, path in files.items() if name in known}
    masks = {name: mask for name, mask in masks.items() if mask.any()}
    if not masks:
        raise InvalidInput("number of masks of known objects in the folder", 0, "1 or more, such as 025_mug.png")
    return masks


def _bop_files(folder: Path, image: int | None) -> dict[str, Path]:
    """Files as BOP numbers them, by object; none if there are none."""
    numbered = [match for path in folder.iterdir() if (match := _BOP_NAME.fullmatch(path.name))]
    if not numbered:
        return {}
    images = sorted({int(match[1]) for match in numbered})
    if image is None and len(images) == 1:
        image = images[0]
    if image not in images:
        given = "not told" if image is None else image
        raise InvalidInput("image of the masks", given, f"one of {shown(', '.join(map(str, images)))}")
    table = next((f / _SCENE_GT for f in (folder, folder.parent) if (f / _SCENE_GT).is_file()), None)
    if table is None:
        raise InvalidInput(f"{_SCENE_GT} of the masks", "missing", "in the folder above them: it tells what they show")
    names = scene_gt_names(table, image)
    its = {int(match[2]): folder / match[0] for match in numbered if int(match[1]) == image}
    return {name: its[index] for index, name in enumerate(names) if index in its}


def _read(path: Path, sent: tuple[int, int], kept: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    try:
        values = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error):
        values = None
    if values is None:
        raise CorruptFile(shown(path), "it is no picture")
    size = values.shape[1], values.shape[0]
    if size not in (sent, kept):
        given, wanted = (f"{width} x {height} pixels" for width, height in (size, sent))
        raise InvalidInput(f"size of the mask {shown(path.name)}", given, f"the photo's, {wanted}")
    share = (values > values.max() / 2).astype(np.float32)
    return share > 0 if size == kept else cv2.resize(share, kept, interpolation=cv2.INTER_AREA) > 0.5
