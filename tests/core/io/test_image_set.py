import json
import os
import shutil
import struct

import cv2
import numpy as np
import pytest

import osfcore.io.image_set as module
from osfcore.errors import CorruptFile
from osfcore.io.image_set import read_image_set, read_splits
from osfcore.world.collect_images import CollectTable, collect_table
from tests.support.ellipsoid_sets import edit
from tests.support.errors import about


@pytest.fixture(scope="module")
def table_set(tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "table"
    list(collect_table(CollectTable(out, images=60, size=16)))
    return out


RT = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2]]


def pixels(path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def refused(folder, datum):
    with pytest.raises(CorruptFile, check=about(datum)) as caught:
        read_splits(folder)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(folder)) + 350


def test_public_sets_are_read_whatever_their_unit_lights_and_further_keys(image_set):
    shutil.rmtree(image_set / "val")
    train, test = read_splits(image_set)
    assert (train.rgba.shape, test.rgba.shape, train.is_opaque) == ((12, 32, 32, 4), (4, 32, 32, 4), False)
    np.testing.assert_allclose(np.linalg.norm(train.light_directions, axis=1), 1, atol=1e-6)
    entries = json.loads((image_set / "train" / "anno.json").read_text())
    np.testing.assert_allclose(train.light_directions[5], np.array(entries[5]["light_pos"]) / 15, atol=1e-6)
    distances = [np.linalg.norm(camera.T_world_camera.position) for camera in train.cameras]
    np.testing.assert_allclose(distances, 2.5)
    bgra = pixels(image_set / "train" / "r_2.png")
    np.testing.assert_array_equal(train.rgba[2], bgra[..., [2, 1, 0, 3]])
    assert [camera.name for camera in test.cameras] == [f"test/r_{i}.png" for i in range(4)]


def test_resolution_is_optional_and_images_may_lie_in_folders(image_set):
    (image_set / "train" / "rgba").mkdir()
    (image_set / "train" / "r_3.png").rename(image_set / "train" / "rgba" / "a.png")
    edit(image_set, lambda e: e.update(filename="rgba/a.png", resolution=None))
    edit(image_set, lambda e: e.update(resolution=[32, 32]), number=4)
    assert read_image_set(image_set, "train").cameras[3].name == "train/rgba/a.png"


@pytest.mark.parametrize(
    ("datum", "changes"),
    [
        ("light_pos", [{"light_pos": v} for v in (..., [0, 0, 0], [np.nan, 0, 1], [10**400, 0, 0], "up")]),
        ("RT", [{"RT": v} for v in ((2 * np.eye(3, 4)).tolist(), np.diag([1.0, 1, -1, 0])[:3].tolist())]),
        ("RT", [{"RT": v} for v in (np.zeros((3, 4)).tolist(), np.eye(4).tolist(), [[np.inf] * 4] * 3)]),
        ("RT", [{"RT": np.pad(np.eye(3), ((0, 0), (0, 1)), constant_values=1e300).tolist()}]),
        ("K", [{"K": v} for v in (..., np.zeros((3, 3)).tolist())]),
        ("resolution", [{"resolution": v} for v in (64, [32, 16], [10**4000, 32], "large")]),
        ("gone.png", [{"filename": "gone.png"}]),
        ("entries 3 and 4", [{"filename": "r_4.png"}, {"filename": "./" * 500 + "r_4.png"}]),
        ("filename", [{"filename": v} for v in (..., 7, "a\0.png", "r_3\ud800.png", "r_\udc80.png")]),
        ("entry 3", [{"filename": v} for v in ("../test/r_1.png", "/etc/passwd", "x" * 5000, "y/" * 3000 + "\t.png")]),
        ("entry 3", [{"filename": v, "light_pos": "up"} for v in ("\x1b[31mred\n.png", "../" + "\n" * 5000)]),
    ],
)
def test_broken_entries_are_refused_with_their_place_in_one_short_line(image_set, datum, changes):
    path = image_set / "train" / "anno.json"
    sound = path.read_text()
    for change in changes:
        path.write_text(sound)
        edit(image_set, lambda e, c=change: [e.pop(k) if v is ... else e.update({k: v}) for k, v in c.items()])
        refused(image_set, datum)
    path.write_text(json.dumps([*json.loads(sound), 7]))
    refused(image_set, "entry 12")


@pytest.mark.parametrize("change", ["light", "camera", "pixel"])
def test_digests_differ_by_lights_cameras_and_pixels(image_set, change):
    before = read_image_set(image_set, "train").digest()
    assert read_image_set(image_set, "train").digest() == before
    if change == "pixel":
        bgra = pixels(image_set / "train" / "r_3.png")
        bgra[16, 16, 0] ^= 1
        cv2.imwrite(str(image_set / "train" / "r_3.png"), bgra)
    else:
        edit(image_set, lambda e: e.update({"light_pos": [0, 0, 1]} if change == "light" else {"RT": RT}))
    assert read_image_set(image_set, "train").digest() != before


def test_links_out_of_the_set_are_refused_and_links_inside_are_not(image_set, tmp_path):
    image = image_set / "train" / "r_3.png"
    image.rename(image_set / "kept.png")
    image.symlink_to(image_set / "kept.png")
    read_splits(image_set)
    shutil.move(image_set / "kept.png", tmp_path / "secret.png")
    image.unlink()
    image.symlink_to(tmp_path / "secret.png")
    refused(image_set, "link")
    image.unlink()
    image.symlink_to(image)
    refused(image_set, "r_3.png")
    image.unlink()
    os.mkfifo(image)  # is not waited for
    refused(image_set, "r_3.png")


def test_truncated_and_damaged_images_are_refused(image_set):
    path = image_set / "test" / "r_1.png"
    sound = path.read_bytes()
    for share in (0.0, 0.02, 0.5, 0.9):
        path.write_bytes(sound[: int(share * len(sound))])
        refused(image_set, "test/r_1.png")
    rng = np.random.default_rng(0)
    count = 0
    for _ in range(40):
        data = bytearray(sound)
        for place in rng.integers(8, len(data), 3):
            data[place] = rng.integers(256)
        path.write_bytes(data)
        try:
            read_image_set(image_set, "test")
        except CorruptFile:
            count += 1
    assert count > 30  # a few changes hit nothing that matters


@pytest.mark.parametrize("side", [1025, 10_000, 60_000])
def test_images_that_would_fill_the_memory_are_refused_by_their_header(image_set, side):
    path = image_set / "test" / "r_1.png"
    data = path.read_bytes()
    path.write_bytes(data[:16] + struct.pack(">II", side, side) + data[24:])
    refused(image_set, f"{side} x {side}")


def test_images_of_another_kind_or_size_are_refused(image_set):
    path = image_set / "train" / "r_3.png"
    bgra = pixels(path)
    cv2.imwrite(str(path), bgra[..., :3])
    refused(image_set, "r_3.png")  # no transparency
    cv2.imwrite(str(path), cv2.resize(bgra, (48, 48)))
    edit(image_set, lambda e: e.update(resolution=48))
    refused(image_set, "r_3.png")
    cv2.imwrite(str(path), bgra)
    edit(image_set, lambda e: e.update(resolution=32))
    edit(image_set, lambda e: e.update(resolution=48), "test", None)
    for path in (image_set / "test").glob("*.png"):
        cv2.imwrite(str(path), cv2.resize(pixels(path), (48, 48)))
    refused(image_set, "48 x 48")


def set_alpha(paths, alpha):
    for path in paths:
        cv2.imwrite(str(path), np.dstack([pixels(path)[..., :3], np.full((32, 32), alpha, np.uint8)]))


def test_images_without_a_silhouette_are_refused_among_those_of_an_object(image_set):
    one = image_set / "train" / "r_6.png"
    sound = one.read_bytes()
    for alpha in (0, 255):
        set_alpha([one], alpha)
        refused(image_set, "train/r_6.png")
    one.write_bytes(sound)
    set_alpha((image_set / "test").glob("*.png"), 255)
    refused(image_set, "train and test")


def test_sets_with_too_few_images_or_without_a_list_are_refused(image_set):
    train, test = image_set / "train" / "anno.json", image_set / "test" / "anno.json"
    sound = train.read_text()
    for text in (json.dumps(json.loads(sound)[:7]), "[" * 100_000, "{", "\xff", '{"a": 1}'):
        train.write_text(text, encoding="latin-1")
        refused(image_set, "train/anno.json")
    train.write_text(sound)
    test.write_text("[]")
    refused(image_set, "test/anno.json")
    shutil.rmtree(image_set / "test")
    refused(image_set, "test/anno.json")


def test_huge_annotations_and_sets_are_refused_before_they_fill_the_memory(image_set, monkeypatch):
    monkeypatch.setattr(module, "MAX_SPLIT_BYTES", 12 * 32 * 32 * 4 - 1)
    refused(image_set, "12 images")
    monkeypatch.setattr(module, "MAX_ANNOTATION_BYTES", 1000)
    refused(image_set, "anno.json")


def test_a_test_image_that_is_a_training_one_is_refused_even_if_encoded_anew(image_set):
    bgra = pixels(image_set / "train" / "r_2.png")
    cv2.imwrite(str(image_set / "test" / "r_1.png"), bgra, [cv2.IMWRITE_PNG_COMPRESSION, 0])
    assert (image_set / "test" / "r_1.png").read_bytes() != (image_set / "train" / "r_2.png").read_bytes()
    refused(image_set, "test/r_1.png is train/r_2")


def test_a_table_seen_twice_under_equal_lights_is_no_leak_but_a_copy_is(table_set, tmp_path):
    copy = shutil.copytree(table_set, tmp_path / "table")
    shutil.copyfile(copy / "train" / "0004.png", copy / "test" / "0007.png")
    assert all(split.is_opaque for split in read_splits(copy))
    entry = json.loads((copy / "train" / "anno.json").read_text())[4]
    edit(copy, lambda e: e.update({**entry, "filename": e["filename"]}), "test", 7)
    refused(copy, "1 of 40")
