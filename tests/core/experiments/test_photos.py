import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.photos import EvaluatePhotos, box_and_click, evaluate_photos, read_lamps, read_scene, starts_of
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import rotate
from osfcore.io.image_file import write_png
from tests.support.errors import about
from tests.support.photographs import INTRINSICS, NAME, take, write_photo

SIDE = 96
AZIMUTHS = np.arange(10) * 2.4
LAMPS = np.stack([0.7 * np.cos(AZIMUTHS), 0.7 * np.sin(AZIMUTHS), -np.full(10, 0.75) - 0.3 * (AZIMUTHS % 1)], axis=1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    library = FieldLibrary(None)
    taken = take({NAME: library.load(NAME)})
    folder = tmp_path_factory.mktemp("photos") / "desk"
    folder.mkdir()
    depth = np.where(taken.photo.masks[NAME], taken.depth, depth_of_table(taken, library.load(NAME)))
    cv2.imwrite(str(folder / "depth.png"), np.round(depth * 1e4).astype(np.uint16))
    write_photo(folder, taken, depth="depth.png", depth_unit_m=1e-4)
    return folder


def depth_of_table(taken, field):
    """Along z, of the plane that the box lies on with its widest side [m]."""
    up = rotate(taken.pose.quaternion, np.array([0.0, 0.0, 1.0]))
    up *= -np.sign(up @ taken.pose.position)
    below = taken.pose.position - up * (field.extent[1, 2] - field.extent[0, 2]) / 2
    y, x = np.mgrid[: taken.depth.shape[0], : taken.depth.shape[1]] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(INTRINSICS).T
    return (up @ below) / (rays @ up)


@pytest.fixture(scope="module")
def lamps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lamps")
    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2) / (SIDE / 2 - 4)
    ball = x**2 + y**2 < 1
    normals = np.stack([x, y, -np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    stripes = np.where(np.sin(20 * x) > 0, 0.7, 0.4)
    for name in ("chrome", "gray", "striped"):
        (folder / name).mkdir()
        write_png(folder / name / f"{name}.mask.png", 255 * ball.astype(np.uint8))
        for number, lamp in enumerate(LAMPS / np.linalg.norm(LAMPS, axis=1, keepdims=True)):
            half = lamp + [0, 0, -1]
            shine = (normals @ (half / np.linalg.norm(half))) ** 2000
            shade = np.maximum(normals @ lamp, 0) * (stripes if name == "striped" else 0.8)
            value = ball * (shine if name == "chrome" else shade)
            write_png(folder / name / f"{name}.{number}.png", np.uint8(255 * np.repeat(value[..., None], 3, -1)))
    return folder


def test_lamps_by_the_highlight_and_by_shading(lamps, tmp_path):
    gray, _ = sorted(read_lamps(lamps), key=lambda s: s.name)
    unit = LAMPS / np.linalg.norm(LAMPS, axis=1, keepdims=True)
    assert np.rad2deg(np.arccos(np.clip((gray.directions * unit).sum(axis=1), -1, 1))).max() < 1.5
    *_, last = evaluate_photos(EvaluatePhotos(tmp_path, lamps), FieldLibrary(None))
    assert last.report["objects_total"] == 0
    assert max(last.report["light_deg"]["gray"]) < 2
    assert np.median(last.report["light_deg"]["striped"]) < 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "plane", "masks"), [("perturbed", "free", "given"), ("none", "known", "given"), ("none", "free", "boxes")]
)
def test_an_object_is_measured_against_its_truth(scene, tmp_path, start, plane, masks):
    config = EvaluatePhotos(tmp_path, scene.parent, start, plane, masks=masks)
    *_, last = evaluate_photos(config, FieldLibrary(None))
    report = last.report
    assert report["objects_total"] == 1
    assert report["iou_median"] == report["iou_min"] > 0.9
    assert (report["mask_iou_min"] == 1) == (masks == "given")
    assert report["boxes_unfilled"] == 0
    assert report["mask_iou_median"] == report["mask_iou_min"] > 0.85
    assert report["frac_10deg"] == report["depth_within_10mm"] == 1
    assert report["wrong_unflagged"] == 0
    assert report["light_deg_median"] is None
    assert json.loads((tmp_path / "report.json").read_text())["objects_total"] == 1
    assert (tmp_path / f"desk-{NAME}-0.png").exists()


def test_a_box_holds_the_mask_and_the_click_is_on_it():
    rng = np.random.default_rng(0)
    for _ in range(20):
        mask = np.zeros((60, 80), bool)
        for _ in range(4):
            x, y = rng.integers(0, 50, 2)
            mask[y : y + rng.integers(5, 12), x : x + rng.integers(5, 30)] = True
        (left, top, right, bottom), click = box_and_click(mask)
        rows, columns = np.nonzero(mask)
        assert 0 <= left <= columns.min() < columns.max() + 1 <= right <= 80
        assert 0 <= top <= rows.min() < rows.max() + 1 <= bottom <= 60
        assert mask[int(click[0, 1]), int(click[0, 0])]


def test_the_table_is_where_depth_says(scene):
    points = read_scene(scene).table_points()
    centred = points - points.mean(axis=0)
    assert np.linalg.svd(centred, compute_uv=False)[2] / np.sqrt(len(points)) < 1e-3


def test_searches_may_begin_with_any_source_but_the_references(scene, tmp_path):
    shutil.copytree(scene, tmp_path / "desk")
    assert starts_of(tmp_path) == ("none",)
    known = json.loads((scene / "photo.json").read_text())
    poses = known["poses_camera_object"]["ground_truth"]
    known["poses_camera_object"] |= {"posecnn_raw": poses, "posecnn_refined_with_depth": poses}
    (tmp_path / "desk" / "photo.json").write_text(json.dumps(known))
    assert starts_of(tmp_path) == ("none", "posecnn_raw")


def test_what_cannot_be_measured_is_refused(scene, tmp_path):
    config = EvaluatePhotos(tmp_path, scene.parent)
    for what, change in (
        ("data", {"data": tmp_path}),
        ("data", {"start": "guesses"}),
        ("error of masks", {"mask_error_px": 50}),
    ):
        with pytest.raises(InvalidInput, check=about(what)):
            list(evaluate_photos(replace(config, **change), FieldLibrary(None)))
    (tmp_path / "photo.json").write_text((scene / "photo.json").read_text())
    with pytest.raises(CorruptFile, check=about("photo.png")):
        read_scene(tmp_path)
