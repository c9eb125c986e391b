"""Masks in folders: by name, and as BOP numbers them."""

import json

import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.io.image_file import write_png
from osfcore.photo.bop import read_masks

KNOWN = ("025_mug", "003_cracker_box", "009_gelatin_box")
SENT, KEPT = (80, 60), (40, 30)


def mask_at(left, value=255, size=SENT):
    image = np.zeros((size[1], size[0]), np.uint8)
    image[10:30, left : left + 20] = value
    return image


@pytest.mark.parametrize("name", ["025_mug.png", "mask_025_mug.png"])
@pytest.mark.parametrize("value", [1, 255])
def test_masks_by_name(tmp_path, name, value):
    write_png(tmp_path / name, mask_at(10, value))
    write_png(tmp_path / "photo.png", mask_at(0))
    (masks,) = (read_masks(tmp_path, KNOWN, (SENT, SENT)),)
    assert list(masks) == ["025_mug"]
    np.testing.assert_array_equal(masks["025_mug"], mask_at(10) > 0)


def test_masks_of_the_photo_as_it_was_sent_are_reduced_with_it(tmp_path):
    write_png(tmp_path / "025_mug.png", mask_at(10))
    mask = read_masks(tmp_path, KNOWN, (SENT, KEPT))["025_mug"]
    assert mask.shape == KEPT[::-1]
    assert mask[5:15, 5:15].all()
    assert mask.sum() == 100


@pytest.mark.parametrize("place", [".", ".."])
def test_masks_of_bop(tmp_path, place):
    folder = tmp_path / "mask_visib"
    for image, index, left in ((1, 0, 0), (1, 1, 20), (2, 0, 40)):
        write_png(folder / f"{image:06d}_{index:06d}.png", mask_at(left))
    entry = {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 900.0]}
    with pytest.raises(InvalidInput, match="scene_gt.json of the masks is missing"):
        read_masks(folder, KNOWN, (SENT, SENT), 1)
    content = {"1": [{**entry, "obj_id": 14}, {**entry, "obj_id": 2}], "2": [{**entry, "obj_id": 8}]}
    (folder / place / "scene_gt.json").write_text(json.dumps(content))
    masks = read_masks(folder, KNOWN, (SENT, SENT), 1)
    assert list(masks) == ["025_mug", "003_cracker_box"]
    assert masks["003_cracker_box"][20, 30]
    assert list(read_masks(folder, KNOWN, (SENT, SENT), 2)) == ["009_gelatin_box"]
    with pytest.raises(InvalidInput, match="image of the masks is not told, but it must be one of 1, 2"):
        read_masks(folder, KNOWN, (SENT, SENT))


def test_mistakes_are_told(tmp_path):
    with pytest.raises(InvalidInput, match="a folder that exists"):
        read_masks(tmp_path / "none", KNOWN, (SENT, SENT))
    with pytest.raises(InvalidInput, match="number of masks of known objects in the folder is 0"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))
    write_png(tmp_path / "025_mug.png", mask_at(0, 0))
    with pytest.raises(InvalidInput, match="number of masks of known objects in the folder is 0"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))
    write_png(tmp_path / "025_mug.png", mask_at(10, size=(64, 48)))
    with pytest.raises(InvalidInput, match="is 64 x 48 pixels, but it must be the photo's, 80 x 60 pixels"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))
    (tmp_path / "025_mug.png").write_text("no picture")
    with pytest.raises(CorruptFile, match="it is no picture"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))
